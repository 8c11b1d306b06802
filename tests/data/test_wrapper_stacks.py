"""What an environment says of itself is not taken through a wrapper that changes what it speaks of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces, wrappers
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecMonitor,
    VecNormalize,
)

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.data.wrappers import Change, layers, robot_layers
from famle_envs.faults import FaultWrapper

Array = npt.NDArray[Any]
Env = gym.Env[Any, Any]
MakeEnv = Callable[..., Env]
LITTLE: dict[str, Any] = {
    "policy_steps": 0,
    "transitions_per_situation": 40,
    "hidden": (8,),
    "joint_iterations": 2,
    "candidates": 4,
    "planner_iterations": 1,
    "device": "cpu",
    "seed": 0,
}


class Point(gym.Env[Any, Any]):
    """Moves on a plane towards a goal in m, and says so."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.x = np.zeros(2, np.float32)
        return self.x.copy(), {}

    def step(self, action: Any) -> Any:
        self.x = self.x + np.float32(0.1) * np.asarray(action, np.float32)
        return self.x.copy(), float(self.reward_fn(None, None, self.x)), False, False, {}

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return -abs(next_obs[..., 0] - 1.0)


class Turning(Point):
    """Has an angle too, and falls."""

    angle_dims = (1,)

    def termination_fn(self, next_obs: Any) -> Any:
        return next_obs[..., 0] > 3.0


# --- wrappers -------------------------------------------------------------------------------------------------


class Centimetres(gym.ObservationWrapper[Any, Any, Any]):
    def observation(self, observation: Any) -> Any:
        return 100 * observation


class Halved(gym.ActionWrapper[Any, Any, Any]):
    def action(self, action: Any) -> Any:
        return 0.5 * np.asarray(action)


class Negated(gym.RewardWrapper[Any, Any]):
    def reward(self, reward: Any) -> Any:
        return -reward


class Both(gym.ObservationWrapper[Any, Any, Any], gym.RewardWrapper[Any, Any]):
    def observation(self, observation: Any) -> Any:
        return observation + 1

    def reward(self, reward: Any) -> Any:
        return reward + 1


class Steps(gym.Wrapper[Any, Any, Any, Any]):
    """Does as it likes."""

    def step(self, action: Any) -> Any:
        return self.env.step(action)


class Starts(gym.Wrapper[Any, Any, Any, Any]):
    def reset(self, **kwargs: Any) -> Any:
        return self.env.reset(**kwargs)


class Draws(gym.Wrapper[Any, Any, Any, Any]):
    """Touches nothing that passes."""

    def render(self) -> Any:
        return None

    @property
    def weight(self) -> float:
        return 3.0


class Hasty(wrappers.TimeLimit):
    """Derived from a wrapper that is known, with code of its own."""

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = super().step(action)
        return 100 * obs, reward, terminated, truncated, info


class Short(wrappers.TimeLimit):
    """Derived from one, without."""

    def __init__(self, env: Env) -> None:
        super().__init__(env, 3)


class Monitor2(gym.ObservationWrapper[Any, Any, Any]):
    def observation(self, observation: Any) -> Any:
        return 100 * observation


Monitor2.__name__ = "Monitor"  # what it is called says nothing

HARMLESS: list[Callable[[Env], Env]] = [
    lambda env: wrappers.TimeLimit(env, 20),
    wrappers.OrderEnforcing,
    wrappers.PassiveEnvChecker,
    wrappers.Autoreset,
    wrappers.RecordEpisodeStatistics,
    Monitor,
    Draws,
    Short,
    FaultWrapper,
    lambda env: wrappers.DelayObservation(env, 2),
    lambda env: wrappers.DtypeObservation(env, np.float32),
    wrappers.FlattenObservation,
]
CHANGING: dict[str, tuple[Callable[[Env], Env], Change]] = {
    "Centimetres": (Centimetres, Change.OBSERVATION),
    "Monitor": (Monitor2, Change.OBSERVATION),
    "TransformObservation": (
        lambda env: wrappers.TransformObservation(env, lambda obs: 100 * obs, None),
        Change.OBSERVATION,
    ),
    "NormalizeObservation": (wrappers.NormalizeObservation, Change.OBSERVATION),
    "Halved": (Halved, Change.ACTION),
    "RescaleAction": (lambda env: wrappers.RescaleAction(env, np.float32(-2), np.float32(2)), Change.ACTION),
    "Negated": (Negated, Change.REWARD),
    "TransformReward": (lambda env: wrappers.TransformReward(env, lambda reward: -reward), Change.REWARD),
    "NormalizeReward": (wrappers.NormalizeReward, Change.REWARD),
    "RepeatAction": (lambda env: wrappers.RepeatAction(env, 2), Change.REWARD),
    "Both": (Both, Change.OBSERVATION | Change.REWARD),
}
DOUBTFUL: dict[str, Callable[[Env], Env]] = {
    "Steps": Steps,
    "Starts": Starts,
    "Hasty": lambda env: Hasty(env, 100),
}


@given(st.data())
def test_wrappers_are_known_by_what_they_are_in_any_order(data: st.DataObject) -> None:
    env: Env = Point()
    expected = Change.NOTHING
    for _ in range(data.draw(st.integers(0, 4))):
        wrap, change = data.draw(st.sampled_from([*CHANGING.values(), *((wrap, Change.NOTHING) for wrap in HARMLESS)]))
        if wrap is FaultWrapper and env.has_wrapper_attr("set_situation"):
            continue
        env, expected = wrap(env), expected | change
    found = Change.NOTHING
    for layer in robot_layers(env, "reward_fn"):
        assert layer.is_known
        found |= layer.change
    assert found == expected
    in_doubt = robot_layers(data.draw(st.sampled_from(list(DOUBTFUL.values())))(env), "reward_fn")
    assert not in_doubt[0].is_known
    assert in_doubt[0].change is Change.ANYTHING


def test_what_is_below_who_says_it_does_not_matter() -> None:
    class Translated(Centimetres):
        def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
            return self.env.get_wrapper_attr("reward_fn")(obs / 100, action, next_obs / 100)

    agent = FAMLE(Monitor(Translated(Steps(Point()))), **LITTLE)
    obs = torch.rand(2, 3, 2)
    expected = -(obs[..., 0] / 100 - 1).abs()
    torch.testing.assert_close(agent.policy.unit_reward_fn()(obs, obs, obs), expected)


@pytest.mark.filterwarnings("error:.*may change")
@pytest.mark.parametrize("wrap", HARMLESS)
def test_harmless_wrapper_costs_nothing(wrap: Callable[[Env], Env]) -> None:
    agent = FAMLE(wrap(Turning()), **LITTLE)
    assert agent.dims["angle_dims"] == (1,)
    assert agent.policy.env_reward_fn is not None
    assert agent.policy.env_termination_fn is not None
    assert not agent.policy.learns_reward


@pytest.mark.parametrize(
    "name", [name for name, (_, change) in CHANGING.items() if change & (Change.OBSERVATION | Change.ACTION)]
)
def test_reward_of_other_units_is_refused(name: str) -> None:
    wrap, change = CHANGING[name]
    with pytest.raises(ValueError, match=rf"reward_fn is of what {name} changes.*reward_fn=\.\.\."):
        FAMLE(wrap(Point()), **LITTLE)
    FAMLE(wrap(Point()), reward_fn=lambda o, a, n: n[..., 0], **LITTLE)
    if change & Change.OBSERVATION:
        with pytest.raises(ValueError, match=rf"angle_dims are of what {name} changes"):
            FAMLE(wrap(Turning()), reward_fn=lambda o, a, n: n[..., 0], **LITTLE)
        with pytest.raises(ValueError, match=rf"termination_fn is of what {name} changes"):
            FAMLE(wrap(Turning()), reward_fn=lambda o, a, n: n[..., 0], angle_dims=(), **LITTLE)


@pytest.mark.parametrize("name", [name for name, (_, change) in CHANGING.items() if change is Change.REWARD])
def test_wrapped_reward_is_what_counts(name: str) -> None:
    wrap, _ = CHANGING[name]
    agent = FAMLE(wrap(Turning()), **LITTLE)
    assert agent.dims["angle_dims"] == (1,)
    assert agent.policy.learns_reward


def test_wrapped_reward_is_learnt() -> None:
    agent = FAMLE(Negated(Point()), **LITTLE)
    data = agent.collect([lambda: Negated(Point())])
    agent.meta_learn(data)
    obs, action, next_obs = (torch.from_numpy(values) for values in (data.obs, data.action, data.next_obs))
    learnt = agent.policy.unit_reward_fn()(obs, action, next_obs).numpy()
    assert np.corrcoef(learnt.ravel(), data.reward.ravel())[0, 1] > 0.95


def test_reward_in_doubt_is_learnt() -> None:
    with pytest.warns(UserWarning, match=r"may change what the environment's reward_fn is of.*reward_fn=env\."):
        agent = FAMLE(Steps(Point()), **LITTLE)
    agent.meta_learn([lambda: Steps(Point())], check=False)
    assert agent.policy.world.reward is not None
    assert agent.policy.known_reward_fn is None


@pytest.mark.parametrize("wrap", DOUBTFUL.values(), ids=DOUBTFUL.keys())
def test_what_is_in_doubt_is_not_taken(wrap: Callable[[Env], Env]) -> None:
    with pytest.warns(UserWarning, match="may change"):
        assert FAMLE(wrap(Point()), **LITTLE).policy.learns_reward
    with pytest.raises(ValueError, match=r"angle_dims are of what \w+ changes, or may change"):
        FAMLE(wrap(Turning()), **LITTLE)
    with pytest.warns(UserWarning, match="may change"):
        assert FAMLE(wrap(Turning()), angle_dims=(), **LITTLE).policy.env_termination_fn is None


@pytest.mark.filterwarnings("error:.*may change")
def test_user_may_say_that_nothing_is_changed() -> None:
    env = Steps(Turning())
    said = {name: env.get_wrapper_attr(name) for name in ("reward_fn", "termination_fn", "angle_dims")}
    assert not FAMLE(env, **said, **LITTLE).policy.learns_reward


def test_agent_that_has_learnt_takes_what_is_in_doubt() -> None:
    agent = FAMLE(Point(), **LITTLE).meta_learn([Point], check=False)
    with pytest.warns(UserWarning, match="may change"):
        agent.set_env(Steps(Point()))
    agent.learn(3)
    assert agent.policy.known_reward_fn is not None


def test_shipped_model_has_no_reward_of_a_wrapper(make_env: MakeEnv) -> None:
    with pytest.warns(UserWarning, match="is not taken: it has another environment, reward"):
        agent = FAMLE(wrappers.TransformReward(make_env("FamleAnt-v0"), lambda reward: -reward), device="cpu")
    assert agent.dynamics is None


# --- vector environments --------------------------------------------------------------------------------------


class VecCentimetres(VecEnvWrapper):
    def reset(self) -> Any:
        return 100 * self.venv.reset()

    def step_wait(self) -> Any:
        obs, rewards, dones, infos = self.venv.step_wait()
        return 100 * obs, rewards, dones, infos


def test_vector_wrappers_are_known_by_what_they_are() -> None:
    robots = DummyVecEnv([Turning])
    assert layers(VecMonitor(VecCheckNan(robots)), "reward_fn") == []
    assert layers(VecNormalize(robots, norm_obs=False), "reward_fn") == []
    assert layers(VecNormalize(robots, norm_reward=False), "reward_fn")[0].change is Change.OBSERVATION
    with pytest.warns(UserWarning, match="VecCentimetres may change what the environment's reward_fn is of"):
        assert FAMLE(VecCentimetres(DummyVecEnv([Point])), **LITTLE).policy.learns_reward
    with pytest.raises(ValueError, match="angle_dims are of what VecCentimetres changes, or may change"):
        FAMLE(VecCentimetres(robots), **LITTLE)


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        (lambda env: Monitor(wrappers.TimeLimit(env, 3)), []),
        (Centimetres, ["Centimetres"]),
        (lambda env: wrappers.RescaleAction(env, np.float32(-2), np.float32(2)), ["RescaleAction"]),
    ],
)
@pytest.mark.parametrize("robot", ["Point", "FamleReacher-v0"])
def test_wrappers_in_another_process_are_known_by_name(robot: str, wrap: Any, expected: list[str]) -> None:
    env = SubprocVecEnv([lambda: wrap(Point() if robot == "Point" else gym.make(robot))])
    assert [layer.name for layer in layers(env, "reward_fn")] == expected
    env.close()


def test_vector_wrapper_of_its_own_kind_is_no_part_of_a_file(make_env: MakeEnv) -> None:
    class Passing(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            return self.venv.step_wait()

    with pytest.warns(UserWarning, match="may change"):
        agent = FAMLE(Passing(DummyVecEnv([make_env])), angle_dims=(), **LITTLE)
    with pytest.raises(ValueError, match="Situations need a registered environment without wrappers"):
        agent.collect(["joint 0 dead"])


# --- rounds ---------------------------------------------------------------------------------------------------


def test_planning_in_simulation_takes_no_reward_through_a_wrapper() -> None:
    rounds = {"rounds": 1, "round_transitions": 10, "round_iterations": 2, "horizon": 2}
    agent = FAMLE(Point(), **LITTLE, **rounds)
    with pytest.raises(ValueError, match=r"reward_fn of the simulated environment .* is of what Centimetres changes"):
        agent.meta_learn([lambda: Centimetres(Point())], check=False)


# --- whose task it is -----------------------------------------------------------------------------------------


def test_robot_with_another_goal_is_refused(make_env: MakeEnv) -> None:
    agent = FAMLE("quadruped", seed=0, device="cpu")
    other = make_env("FamleQuadruped-v0", goal=(0.0, 2.5))
    with pytest.raises(ValueError, match=r"gives other rewards.*set_env"):
        FAMLEWrapper(other, agent)
    FAMLEWrapper(make_env("FamleQuadruped-v0", goal=np.array([2.5, 0.0]), situation="joint 0 locked"), agent)
    agent.set_env(other)
    FAMLEWrapper(other, agent)
    own = FAMLE("quadruped", seed=0, device="cpu", reward_fn=lambda o, a, n: n[..., 0])
    FAMLEWrapper(other, own)


def test_robots_of_one_vec_env_have_one_task_however_it_is_said(make_env: MakeEnv) -> None:
    goals: list[dict[str, Any]] = [{}, {"goal": (-1, 1)}, {"goal": np.array([-1.0, 1.0])}, {"goal": [-1.0, 1.0]}]
    FAMLE(DummyVecEnv([lambda goal=goal: make_env(**goal) for goal in goals]), device="cpu")
    with pytest.raises(ValueError, match=r"different tasks \({\"goal\": \[-1.0, 1.0\]}; {\"goal\": \[1.0, 1.0\]}\)"):
        FAMLE(DummyVecEnv([make_env, lambda: make_env(goal=np.ones(2))]), device="cpu")
