from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor

from famle_agent import FAMLE
from famle_agent.data.envs import EnvLike
from famle_envs import Situation

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]
GRAVITIES = (2.0, 10.0)
SMALL: dict[str, Any] = {
    "hidden": (32,),
    "policy_steps": 0,
    "transitions_per_situation": 200,
    "joint_iterations": 0,
    "meta_iterations": 40,
    "inner_steps": 10,
    "candidates": 30,
    "planner_iterations": 3,
    "init_std": 0.5,
    "adapt_every": 5,
    "adapt_steps": 2,
}


def pendulum(**kwargs: Any) -> FAMLE:
    return FAMLE("Pendulum-v1", seed=0, device="cpu", **{**SMALL, **kwargs})


@pytest.fixture(scope="module")
def learned() -> FAMLE:
    """An agent for an environment that knows nothing of situations and does not say how it rewards."""
    agent = pendulum(meta_iterations=100, memory_size=20)
    return agent.meta_learn([lambda g=g: gym.make("Pendulum-v1", g=g) for g in GRAVITIES])


# --- environments that know nothing of us -----------------------------------------------------------------


def test_situations_are_numbered_where_they_have_no_name(learned: FAMLE) -> None:
    assert learned.situations == ("situation 0", "situation 1")


def test_reward_is_learned(learned: FAMLE) -> None:
    data = pendulum(transitions_per_situation=100).collect([lambda: gym.make("Pendulum-v1")])
    obs, action, next_obs = (torch.from_numpy(getattr(data, name)) for name in ("obs", "action", "next_obs"))
    predicted = learned.policy.unit_reward_fn()(obs, action / 2.0, next_obs)
    assert predicted.shape == (1, 100)
    correlation = np.corrcoef(predicted.flatten().numpy(), data.reward.flatten())[0, 1]
    assert correlation > 0.9
    assert np.abs(predicted.numpy() - data.reward).mean() < 0.5 * data.reward.std()


def test_actions_are_in_the_units_of_the_environment(learned: FAMLE, make_env: MakeEnv) -> None:
    env = make_env("Pendulum-v1", g=10.0)
    obs, _ = env.reset(seed=0)
    state, actions = None, []
    for _ in range(20):
        action, state = learned.predict(obs, state)
        assert env.action_space.contains(action)
        obs, *_ = env.step(action)
        actions.append(action)
    assert 1.0 < np.abs(actions).max() <= 2.0
    memory = state.memory.action[0, -19:]  # of a model, actions lie in [-1, 1]
    np.testing.assert_allclose(2.0 * memory, actions[:-1], atol=1e-5)


def test_evaluate_policy_on_any_environment(learned: FAMLE) -> None:
    states: list[Any] = []
    env = DummyVecEnv([pendulum_robot(g) for g in GRAVITIES * 6])
    env.seed(0)
    evaluate_policy(learned, env, 12, warn=False, callback=lambda local, _: states.append(local["states"]))
    env.close()
    belief = states[-1].belief
    assert belief.adaptations == 5
    heavy = belief.posterior[:, 1]  # in 30 random steps one pendulum or another may be mistaken
    assert heavy[1::2].mean() > heavy[0::2].mean() + 0.3


def pendulum_robot(g: float) -> Callable[[], gym.Env[Any, Any]]:
    """Makes a pendulum whose episodes have 30 steps."""
    return lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1", g=g).unwrapped, 30)


@pytest.mark.parametrize("in_vec_env", [False, True])
def test_environments_may_be_given_as_they_are(make_env: MakeEnv, in_vec_env: bool) -> None:
    own: Any = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2) if in_vec_env else make_env("Pendulum-v1")
    envs = [make_env("Pendulum-v1", g=g) for g in GRAVITIES]
    agent = FAMLE(
        own,
        reward_fn=lambda obs, action, next_obs: next_obs[..., 0],
        seed=0,
        device="cpu",
        **{**SMALL, "meta_iterations": 2},
    )
    agent.meta_learn(envs)
    assert agent.n_envs == (2 if in_vec_env else 1)
    assert len(agent.situations) == 2
    envs[0].reset()  # the user's environments stay open
    envs[0].step(envs[0].action_space.sample())


def test_reward_function_of_the_user_is_used() -> None:
    seen: list[Tensor] = []

    def spin(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        seen.append(action)
        assert obs.shape[:-1] == action.shape[:-1] == next_obs.shape[:-1]
        return action[..., 0]

    agent = pendulum(reward_fn=spin, meta_iterations=2)
    agent.meta_learn([lambda: gym.make("Pendulum-v1")])
    assert agent.policy.world.reward is None
    action, _ = agent.predict(np.array([1.0, 0.0, 0.0], np.float32))
    assert action[0] > 1.5  # the reward is the torque, and the largest one is 2
    largest = torch.stack([value.abs().max() for value in seen]).max()
    assert 1.5 < largest <= 2.0


def test_reward_function_of_the_user_comes_before_the_environments(make_env: MakeEnv) -> None:
    agent = FAMLE(make_env(), reward_fn=lambda obs, action, next_obs: action[..., 2], device="cpu", seed=0)
    action, obs = torch.rand(1, 3, 5), torch.zeros(1, 3, 12)
    torch.testing.assert_close(agent.policy.unit_reward_fn()(obs, action, obs), action[..., 2])


def test_environment_reward_is_used(make_env: MakeEnv) -> None:
    env = make_env()
    agent = FAMLE(env, device="cpu")
    obs, action, next_obs = torch.rand(2, 3, 12), torch.rand(2, 3, 5), torch.rand(2, 3, 12)
    expected = env.unwrapped.reward_fn(obs, action, next_obs)
    torch.testing.assert_close(agent.policy.unit_reward_fn()(obs, action, next_obs), expected)


def test_angles_are_those_of_the_environment_or_of_the_user(make_env: MakeEnv) -> None:
    assert FAMLE(make_env(), device="cpu").dims["angle_dims"] == (0, 1, 2, 3, 4)
    assert FAMLE(make_env(), device="cpu", angle_dims=(1,)).dims["angle_dims"] == (1,)
    assert FAMLE("Pendulum-v1", device="cpu").dims["angle_dims"] == ()


def test_quaternions_are_those_of_the_environment_or_of_the_user(make_env: MakeEnv) -> None:
    ant = make_env("FamleAnt-v0")
    assert FAMLE(ant, device="cpu", pretrained=False).dims["quaternion_dims"] == (1, 2, 3, 4)
    own = FAMLE(ant, device="cpu", pretrained=False, quaternion_dims=())
    assert own.dims["quaternion_dims"] == ()
    assert own.policy.builder.dynamics(1).n_features == 27
    assert FAMLE(make_env(), device="cpu").dims["quaternion_dims"] == ()
    turned = FAMLE(make_env(), device="cpu", angle_dims=(0,), quaternion_dims=(4, 3, 2, 1))
    assert turned.policy.builder.dynamics(1).n_features == 7 + 2 + 10


@pytest.mark.parametrize(
    ("dims", "message"),
    [
        ({"quaternion_dims": (1, 2, 3)}, "4 dimensions or none"),
        ({"quaternion_dims": (1, 2, 3, 3), "angle_dims": ()}, "twice"),
        ({"quaternion_dims": (1, 2, 3, 4), "angle_dims": (4,)}, "twice"),
        ({"angle_dims": (5, 5)}, "twice"),
        ({"angle_dims": (12,)}, "has not"),
        ({"quaternion_dims": (-1, 2, 3, 4), "angle_dims": ()}, "has not"),
    ],
)
def test_dimensions_that_make_no_sense_are_refused(make_env: MakeEnv, dims: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FAMLE(make_env(), device="cpu", **dims)


# --- situations -------------------------------------------------------------------------------------------


SITUATIONS: list[tuple[EnvLike, str]] = [
    (Situation(partial=True, motor_gain=(1, 1, 0)), "joint 2 dead"),
    ({"locked_joints": [1]}, "joint 1 locked"),
    ("joint 4 at gain 0.5", "joint 4 at gain 0.5"),
    ("paper", "paper"),
    (lambda: gym.make("FamleReacher-v0", situation="joint 0 reversed"), "joint 0 reversed"),
]


def test_situation_may_be_said_in_many_ways(make_env: MakeEnv) -> None:
    agent = FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=4)
    given, names = zip(*SITUATIONS, strict=True)
    assert agent.collect(given).situations == names


def test_same_situation_twice_has_two_names(make_env: MakeEnv) -> None:
    agent = FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=4)
    assert agent.collect(["intact", "intact"]).situations == ("intact", "intact (1)")


def test_situations_leave_the_rest_of_the_environment_as_it_is(make_env: MakeEnv) -> None:
    """The goal, which decides the reward, is the one of the agent's own robot."""
    agent = FAMLE(make_env(goal=(1.5, 0.0)), seed=0, device="cpu", transitions_per_situation=1)
    reward = agent.collect(["joint 2 dead"]).reward[0, 0]
    assert reward > 0.9  # the arm begins at this goal


def test_wrappers_of_the_environment_are_not_lost(make_env: MakeEnv) -> None:
    """Where a situation cannot be put into the wrapped environment, this is said."""
    wrapped = gym.wrappers.TransformReward(make_env(), lambda reward: reward + 100.0)
    agent = FAMLE(wrapped, seed=0, device="cpu", transitions_per_situation=1)
    try:
        reward = agent.collect(["joint 2 dead"]).reward[0, 0]
    except ValueError as error:
        assert "factor" in str(error)  # noqa: PT017
    else:
        assert reward > 99


def test_environment_without_situations_says_what_to_do() -> None:
    with pytest.raises(ValueError, match=r"Call meta_learn\(envs\) with a list.*actuator_faults"):
        pendulum().meta_learn()


class Unregistered(gym.Env[Array, Array]):
    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))


def not_an_env() -> str:
    return "Pendulum-v1"


@pytest.mark.parametrize(
    ("own", "envs", "message"),
    [
        ("FamleReacher-v0", [], "at least one environment"),
        ("FamleReacher-v0", "joint 3 dead", "needs a list .* got str"),
        ("FamleReacher-v0", {"motor_gain": [1, 0]}, "needs a list .* got dict"),
        ("FamleReacher-v0", Situation(), "needs a list .* got Situation"),
        ("FamleReacher-v0", [None], "got NoneType"),
        ("FamleReacher-v0", [lambda: gym.make("Pendulum-v1")], "must have the agent's spaces"),
        ("FamleReacher-v0", [not_an_env], "factory must return a Gymnasium environment, got str"),
        ("FamleReacher-v0", ["joint 9 dead"], "joints"),
        ("FamleReacher-v0", ["no such thing"], "No situation is called"),
        (None, ["joint 0 dead"], "Situations need a registered environment"),
    ],
)
def test_situations_that_make_no_sense_are_refused(make_env: MakeEnv, own: str | None, envs: Any, message: str) -> None:
    agent = FAMLE(Unregistered() if own is None else make_env(own), device="cpu")
    with pytest.raises(ValueError, match=message):
        agent.meta_learn(envs)


def test_mistake_in_a_situation_is_said_as_it_is() -> None:
    with pytest.raises(TypeError, match="motor_gain"):
        FAMLE("reacher", device="cpu").meta_learn([{"motor_gain": 3}])


def test_environments_made_for_the_situations_are_closed(make_env: MakeEnv) -> None:
    made: list[gym.Env[Any, Any]] = []

    def factory() -> gym.Env[Any, Any]:
        made.append(gym.make("FamleReacher-v0"))
        return made[-1]

    FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=2).collect([factory, factory])
    assert len(made) == 4  # asked for their situation, and run
    for env in made:
        with pytest.raises(RuntimeError, match="closed"):
            env.unwrapped.reset()


def test_environment_of_the_user_stays_open(make_env: MakeEnv) -> None:
    agent = FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=2)
    own, listed = make_env(), [make_env()]

    def takes(env: gym.Env[Any, Any] = own) -> gym.Env[Any, Any]:
        return env

    for factory in (lambda: own, takes, lambda: listed[0], lambda: gym.wrappers.TimeLimit(own, 3), partial(takes, own)):
        with pytest.raises(ValueError, match="environment that was there before"):
            agent.collect([factory])
    for env in (own, *listed):
        env.reset()


def test_one_environment_has_one_situation(make_env: MakeEnv) -> None:
    agent, env = FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=2), make_env()
    same: list[Any] = [[env, env], [env, gym.wrappers.TimeLimit(env, 3)], {"a": env, "b": env.unwrapped}]
    for envs in same:
        with pytest.raises(ValueError, match="holds the same one twice"):
            agent.collect(envs)
    env.reset()


def test_factories_that_are_bound_too_late_are_one(make_env: MakeEnv) -> None:
    agent = FAMLE(make_env(), seed=0, device="cpu", transitions_per_situation=2)
    names, late = ("intact", "joint 0 dead"), list[Any]()
    for name in names:
        late.append(lambda: gym.make("FamleReacher-v0", situation=name))  # noqa: B023 (the mistake in question)
    with pytest.raises(ValueError, match=r"do the same.*lambda situation=situation"):
        agent.collect(late)

    def bound(name: str) -> Callable[[], gym.Env[Any, Any]]:
        return lambda: gym.make("FamleReacher-v0", situation=name)

    early = [lambda name=name: gym.make("FamleReacher-v0", situation=name) for name in names]
    for envs in (
        early,
        [bound(name) for name in names],
        [partial(gym.make, "FamleReacher-v0", situation=n) for n in names],
    ):
        assert agent.collect(envs).situations == names


def test_environments_with_other_spaces_are_closed(make_env: MakeEnv) -> None:
    made: list[gym.Env[Any, Any]] = []

    class Closing(Odd):
        closed = False

        def close(self) -> None:
            self.closed = True

    def factory() -> gym.Env[Any, Any]:
        made.append(Closing(BOX, BOX))
        return made[-1]

    with pytest.raises(ValueError, match="must have the agent's spaces"):
        FAMLE(make_env(), device="cpu").collect([factory, factory])
    assert [env.closed for env in made] == [True]


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["reachr", "NoSuchRobot-v3"])
def test_unknown_name_lists_the_robots(name: str) -> None:
    with pytest.raises(ValueError, match=rf"'{name}'.*reacher"):
        FAMLE(name)


class Odd(Unregistered):
    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation_space, action_space


BOX = spaces.Box(-1, 1, (2,))


@pytest.mark.parametrize(
    ("observation_space", "action_space", "message"),
    [
        (BOX, spaces.Discrete(2), "discrete actions are not supported"),
        (spaces.Dict({"arm": BOX}), BOX, "FlattenObservation"),
        (spaces.Box(0, 255, (8, 8, 3), np.uint8), BOX, "FlattenObservation"),
        (BOX, spaces.Box(-1, 1, (2, 2)), "one-dimensional"),
        (BOX, spaces.Box(-np.inf, np.inf, (2,)), "TransformAction"),
        (BOX, spaces.Box(np.float32([-1, 0]), np.float32([1, np.inf])), "must be bounded"),
    ],
)
def test_spaces_that_no_model_predicts_are_refused(
    observation_space: spaces.Space[Any], action_space: spaces.Space[Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        FAMLE(Odd(observation_space, action_space))


@pytest.mark.parametrize(
    "action_space",
    [
        spaces.Box(-np.inf, np.inf, (2,)),
        spaces.Box(-np.inf, np.inf, (2,), np.float64),
        spaces.Box(np.float32([-1, 0]), np.float32([1, np.inf])),
        spaces.Box(np.float32([5, -np.inf]), np.float32([np.inf, -5])),
        spaces.Box(np.float32([-3, 5]), np.float32([np.inf, 9])),
        spaces.Discrete(3),
        spaces.Discrete(3, start=4),
    ],
)
def test_advice_on_actions_is_code_that_works(action_space: spaces.Space[Any]) -> None:
    env = Odd(BOX, action_space)
    with pytest.raises(ValueError, match=r"not supported|must be bounded") as refused:
        FAMLE(env, device="cpu")
    advice = str(refused.value)
    code = advice[advice.index("gymnasium.wrappers") :].removesuffix(".")
    wrapped = eval(code, {"env": env, "gymnasium": gym, "np": np})  # the advice itself
    assert FAMLE(wrapped, device="cpu", reward_fn=lambda s, a, s_next: s[..., 0]).action_space == wrapped.action_space
    for _ in range(5):
        assert action_space.contains(wrapped.action(wrapped.action_space.sample()))


def test_discrete_actions_of_a_registered_environment_are_refused() -> None:
    with pytest.raises(ValueError, match="discrete actions are not supported"):
        FAMLE("CartPole-v1")


@pytest.mark.parametrize("mode", ["paper", "original"])
def test_wrapped_robot_has_the_settings_of_the_robot(make_env: MakeEnv, mode: str) -> None:
    wrapped = FAMLE(gym.wrappers.TimeLimit(make_env(), 20), mode, device="cpu")
    assert wrapped.config == FAMLE("reacher", mode, device="cpu").config


def test_agent_of_a_wrapped_robot_is_loaded_with_and_without_it(make_env: MakeEnv, tmp_path: Path) -> None:
    wrapped = FAMLE(gym.wrappers.TimeLimit(make_env(), 20), "original", device="cpu", candidates=7)
    wrapped.save(tmp_path / "agent.zip")
    for env in (None, gym.wrappers.TimeLimit(make_env(), 20)):
        loaded = FAMLE.load(tmp_path / "agent.zip", env, device="cpu")
        assert (loaded.mode, loaded.config) == ("original", wrapped.config)
