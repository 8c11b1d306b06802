from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import FAMLE, NotLearnedError, OnlineState, Transitions

Array = npt.NDArray[Any]
Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]


def some_observations(transitions: Transitions, n: int) -> Array:
    return transitions.obs[0, :n].copy()


def run(agent: FAMLE, env: gym.Env[Any, Any], steps: int, seed: int = 0) -> OnlineState:
    """Lives in an environment with the memory in the state."""
    obs, _ = env.reset(seed=seed)
    state, start = None, np.array([True])
    for _ in range(steps):
        action, state = agent.predict(obs, state, start)
        obs, _, terminated, truncated, _ = env.step(action)
        start[:] = terminated or truncated
        if start[0]:
            obs, _ = env.reset()
    assert state is not None
    return state


# --- predict ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robots", [None, 1, 3])
def test_actions_have_the_shape_of_the_observations(
    quick_agent: FAMLE, transitions: Transitions, robots: int | None
) -> None:
    obs = some_observations(transitions, robots or 1)
    action, state = quick_agent.predict(obs[0] if robots is None else obs)
    space = quick_agent.action_space
    assert action.shape == (space.shape if robots is None else (robots, *space.shape))
    assert action.dtype == space.dtype
    assert all(space.contains(one) for one in np.atleast_2d(action))
    assert state.robots == (robots or 1)


def test_predict_without_a_state_learns_nothing(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = make_env()
    obs, _ = env.reset(seed=0)
    for _ in range(12):
        action, _ = quick_agent.predict(obs)
        obs, *_ = env.step(action)
    assert quick_agent.belief.adaptations == 0


def test_memory_travels_in_the_state_and_leaves_the_agent_as_it_is(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    state = run(quick_agent, make_env(situation="joint 3 dead"), steps=11)
    assert state.belief.adaptations == 2
    assert state.memory.weight.sum() == 10
    assert quick_agent.belief.adaptations == 0
    assert list(quick_agent.posterior().values()) == pytest.approx([1 / 11] * 11)


def test_states_are_immutable(quick_agent: FAMLE, transitions: Transitions) -> None:
    first, second, third = some_observations(transitions, 3)
    _, state = quick_agent.predict(first)
    before = {name: value.clone() for name, value in state.to_tensors().items()}
    quick_agent.predict(second, state)
    quick_agent.predict(third, state)
    assert all(torch.equal(value, before[name]) for name, value in state.to_tensors().items())


def test_transition_across_a_reset_is_dropped(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs = some_observations(transitions, 2)
    _, state = quick_agent.predict(obs)
    _, state = quick_agent.predict(obs + 0.1, state, np.array([True, False]))
    assert state.memory.weight.sum(dim=1).tolist() == [0, 1]
    np.testing.assert_array_equal(state.memory.next_obs[1, -1], obs[1] + np.float32(0.1))


def test_arrays_that_the_caller_changes_afterwards_do_not_matter(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs, start = some_observations(transitions, 1), np.array([False])
    original = obs.copy()
    _, state = quick_agent.predict(obs, None, start)
    obs += 0.3
    start[:] = True
    _, state = quick_agent.predict(obs.copy(), state, np.array([False]))
    start[:] = False
    np.testing.assert_array_equal(state.memory.obs[0, -1:], original)
    assert state.memory.weight.sum() == 1


def test_transition_in_the_memory_is_the_one_that_happened(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = make_env()
    obs, _ = env.reset(seed=0)
    action, state = quick_agent.predict(obs)
    next_obs, *_ = env.step(action)
    _, state = quick_agent.predict(next_obs, state)
    np.testing.assert_array_equal(state.memory.obs[0, -1], obs)
    np.testing.assert_allclose(state.memory.action[0, -1], action, atol=1e-6)
    np.testing.assert_array_equal(state.memory.next_obs[0, -1], next_obs)


def test_new_episode_keeps_the_memory_unless_asked_to_forget(load_agent: Load, transitions: Transitions) -> None:
    obs = some_observations(transitions, 4)
    for forgets in (False, True):
        agent = load_agent(adapt_every=1, adapt_steps=1, candidates=5, forget_at_reset=forgets)
        _, state = agent.predict(obs[0])
        _, state = agent.predict(obs[1], state)
        assert state.memory.weight.sum() == 1
        assert agent.posterior(state) != agent.posterior()
        _, state = agent.predict(obs[2], state, np.array([True]))
        assert state.memory.weight.sum() == (0 if forgets else 1)
        assert (agent.posterior(state) == agent.posterior()) == forgets


def test_deterministic_prediction_repeats_itself(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs = some_observations(transitions, 2)
    first, _ = quick_agent.predict(obs, deterministic=True)
    quick_agent.predict(obs)
    again, _ = quick_agent.predict(obs, deterministic=True)
    drawn = [quick_agent.predict(obs)[0] for _ in range(2)]
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(drawn[0], drawn[1])


def test_robots_plan_for_their_own_observations(agent: FAMLE, transitions: Transitions) -> None:
    obs = some_observations(transitions, 1)
    mirrored = obs * [[-1] * 5 + [-1] * 5 + [1, -1]]
    together, _ = agent.predict(np.concatenate([obs, mirrored]).astype(np.float32), deterministic=True)
    assert not np.allclose(together[0], together[1], atol=0.1)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(11, np.float32), "shape"),
        (np.zeros((2, 3, 12), np.float32), "shape"),
        (np.float32(0.0), "shape"),
        (np.full(12, np.nan, np.float32), "NaN"),
        (np.full((2, 12), np.inf, np.float32), "NaN or infinite"),
        ((np.zeros(12, np.float32), {}), "give obs alone"),
        ({"arm": np.zeros(12)}, "array of numbers"),
        ("left", "array of numbers"),
        (None, "array of numbers|shape"),
    ],
)
def test_wrong_observations_are_refused(quick_agent: FAMLE, observation: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        quick_agent.predict(observation)


def test_state_of_another_number_of_robots_is_refused(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs = some_observations(transitions, 2)
    _, state = quick_agent.predict(obs)
    with pytest.raises(ValueError, match="robots"):
        quick_agent.predict(obs[0], state)


@pytest.mark.parametrize("episode_start", [np.array([True, False]), np.zeros(3, dtype=bool)])
def test_episode_start_of_another_number_of_robots_is_refused(
    quick_agent: FAMLE, transitions: Transitions, episode_start: Array
) -> None:
    with pytest.raises(ValueError, match="episode_start"):
        quick_agent.predict(some_observations(transitions, 1), None, episode_start)


# --- evaluate_policy ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("situation", ["joint 3 dead", "joint 0 reversed"])
def test_evaluate_policy_adapts_without_a_wrapper(agent: FAMLE, make_env: MakeEnv, situation: str) -> None:
    states = []
    env = make_env(situation=situation)
    mean, _ = evaluate_policy(
        agent,
        env,
        n_eval_episodes=1,
        deterministic=False,
        warn=False,
        callback=lambda local, _: states.append(local["states"]),
    )
    assert [state.belief.adaptations for state in states[:5]] == [0, 0, 1, 1, 2]
    assert states[-1].belief.adaptations == 24
    posterior = agent.posterior(states[-1])
    assert max(posterior, key=lambda name: posterior[name]) == situation
    assert sum(posterior.values()) == pytest.approx(1.0)
    assert 0 < mean <= 50


def test_each_robot_of_a_vec_env_finds_its_own_situation(agent: FAMLE) -> None:
    broken = ["joint 3 dead", "joint 0 reversed"]
    env = DummyVecEnv([lambda name=name: gym.make("FamleReacher-v0", situation=name) for name in broken])
    states: list[OnlineState] = []
    evaluate_policy(agent, env, n_eval_episodes=2, warn=False, callback=lambda local, _: states.append(local["states"]))
    env.close()
    likely = states[-1].belief.posterior.argmax(dim=1)
    assert [agent.situations[i] for i in likely] == broken


# --- observe ------------------------------------------------------------------------------------------------


def test_observed_transitions_change_what_the_agent_believes(quick_agent: FAMLE, transitions: Transitions) -> None:
    dead = transitions.situations.index("joint 3 dead")
    for i in range(50):
        quick_agent.observe(transitions.obs[dead, i], transitions.action[dead, i], transitions.next_obs[dead, i])
    assert quick_agent.belief.adaptations == 10
    assert quick_agent.posterior()["joint 3 dead"] > 0.9
    quick_agent.forget()
    assert quick_agent.belief.adaptations == 0


def test_agent_acts_on_what_it_was_told(agent: FAMLE, transitions: Transitions) -> None:
    reversed_ = transitions.situations.index("joint 0 reversed")
    obs = transitions.obs[0, 0]
    before, _ = agent.predict(obs, deterministic=True)
    for i in range(50):
        agent.observe(
            transitions.obs[reversed_, i], transitions.action[reversed_, i], transitions.next_obs[reversed_, i]
        )
    after, _ = agent.predict(obs, deterministic=True)
    assert before[0] * after[0] < 0  # the base joint is driven the other way


def test_observe_takes_several_robots(quick_agent: FAMLE, transitions: Transitions) -> None:
    for i in range(5):
        quick_agent.observe(transitions.obs[:3, i], transitions.action[:3, i], transitions.next_obs[:3, i])
    assert quick_agent.belief.posterior.shape == (3, 11)
    assert quick_agent.belief.adaptations == 1


@pytest.mark.parametrize(
    ("obs", "action", "next_obs", "message"),
    [
        (np.zeros(12), np.zeros(4), np.zeros(12), "action must have shape"),
        (np.zeros(12), np.full(5, np.nan), np.zeros(12), "action holds NaN"),
        (np.zeros(12), np.zeros(5), np.zeros(3), "observation must have shape"),
        (np.zeros(12), np.zeros(5), np.full(12, np.inf), "observation holds NaN"),
        (np.zeros((2, 12)), np.zeros((3, 5)), np.zeros((2, 12)), "2 observations, 3 actions"),
    ],
)
def test_wrong_transitions_are_refused(
    quick_agent: FAMLE, obs: Array, action: Array, next_obs: Array, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        quick_agent.observe(obs, action, next_obs)
    assert quick_agent.belief.adaptations == 0


# --- learn --------------------------------------------------------------------------------------------------


class Recorder(BaseCallback):
    """Counts, and remembers how many steps were done when it began and ended."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[int] = []
        self.ended = False

    def _on_step(self) -> bool:
        self.calls.append(self.model.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.ended = True


def test_learn_lives_and_adapts(quick_agent: FAMLE) -> None:
    recorder = Recorder()
    quick_agent.get_env().env_method("set_situation", "joint 3 dead")
    assert quick_agent.learn(60, callback=recorder) is quick_agent
    assert recorder.calls == list(range(1, 61))
    assert recorder.ended
    assert quick_agent.num_timesteps == 60
    assert quick_agent.belief.adaptations == 11  # 59 transitions: the one across the reset is none
    assert max(quick_agent.posterior().items(), key=lambda item: item[1])[0] == "joint 3 dead"


def test_learning_goes_on_where_it_stopped(quick_agent: FAMLE) -> None:
    quick_agent.learn(10)
    quick_agent.learn(10, reset_num_timesteps=False)
    assert quick_agent.num_timesteps == 20
    assert quick_agent.belief.adaptations == 4


def test_function_that_returns_false_stops_learning(quick_agent: FAMLE) -> None:
    quick_agent.learn(50, callback=lambda local, _: local["self"].num_timesteps < 7)
    assert quick_agent.num_timesteps == 7


@pytest.mark.slow
def test_stable_baselines_callbacks_work(quick_agent: FAMLE, make_env: MakeEnv, tmp_path: Path) -> None:
    evaluation = EvalCallback(
        make_env(),
        eval_freq=10,
        n_eval_episodes=1,
        best_model_save_path=str(tmp_path / "best"),
        log_path=str(tmp_path / "log"),
        verbose=0,
        warn=False,
    )
    checkpoint = CheckpointCallback(10, save_path=str(tmp_path / "checkpoints"))
    quick_agent.learn(20, callback=[evaluation, checkpoint])
    assert np.load(tmp_path / "log" / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    assert FAMLE.load(tmp_path / "best" / "best_model", device="cpu").belief.adaptations in (2, 4)
    saved = FAMLE.load(tmp_path / "checkpoints" / "rl_model_10_steps", device="cpu")
    assert saved.belief.adaptations == 2


def test_progress_bar(quick_agent: FAMLE, capsys: pytest.CaptureFixture[str]) -> None:
    quick_agent.learn(5, progress_bar=True)
    assert "5/5" in capsys.readouterr().out


def test_learn_meta_learns_first() -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", transitions_per_situation=20, meta_iterations=2, candidates=5)
    agent.learn(3)
    assert len(agent.situations) == 11
    assert agent.num_timesteps == 3
    agent.get_env().close()


def test_learning_on_several_robots(quick_agent: FAMLE) -> None:
    quick_agent.get_env().close()
    quick_agent.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0") for _ in range(2)]))
    assert quick_agent.n_envs == 2
    quick_agent.learn(24)
    assert quick_agent.num_timesteps == 24
    assert quick_agent.belief.posterior.shape == (2, 11)
    assert quick_agent.belief.adaptations == 2
    quick_agent.get_env().close()
    quick_agent.set_env(gym.make("FamleReacher-v0"))
    quick_agent.learn(6)
    assert quick_agent.belief.posterior.shape == (1, 11)


def test_environment_with_other_spaces_is_refused(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    before = quick_agent.get_env()
    with pytest.raises(ValueError, match=r"[Ss]pace"):
        quick_agent.set_env(make_env("Pendulum-v1"))
    assert quick_agent.get_env() is before
    assert quick_agent.n_envs == 1


# --- meta_learn ---------------------------------------------------------------------------------------------


def meta_learned(transitions: Transitions, seed: int = 0, **overrides: Any) -> FAMLE:
    few = replace(transitions, **{n: getattr(transitions, n)[:, :50] for n in ("obs", "action", "reward", "next_obs")})
    agent = FAMLE("reacher", seed=seed, device="cpu", **{"meta_iterations": 5, "inner_steps": 3, **overrides})
    agent.get_env().close()
    return agent.meta_learn(few)


def test_same_seed_same_agent(transitions: Transitions) -> None:
    one = meta_learned(transitions)
    torch.manual_seed(99)
    np.random.seed(99)
    same, other = meta_learned(transitions), meta_learned(transitions, seed=1)
    obs = some_observations(transitions, 1)
    for _ in range(2):
        actions = [agent.predict(obs)[0] for agent in (one, same, other)]
        np.testing.assert_array_equal(actions[0], actions[1])
        assert not np.array_equal(actions[0], actions[2])
    for name, value in one.dynamics.state_dict().items():
        assert torch.equal(value, same.dynamics.state_dict()[name])


def test_collected_transitions_follow_the_seed() -> None:
    collected = []
    for seed in (3, 3, 4):
        agent = FAMLE("reacher", seed=seed, device="cpu", transitions_per_situation=5)
        collected.append(agent.collect(["intact", "joint 3 dead"]))
        agent.get_env().close()
    one, same, other = collected
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert not np.array_equal(one.action, other.action)
    assert not np.array_equal(one.action[0], one.action[1])


def test_meta_learning_leaves_the_global_generators_alone(transitions: Transitions) -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", meta_iterations=2, inner_steps=2, candidates=5)
    agent.get_env().close()
    state = torch.get_rng_state()
    agent.meta_learn(transitions)
    agent.predict(some_observations(transitions, 1))
    assert torch.equal(torch.get_rng_state(), state)


def test_callback_counts_the_meta_iterations_and_stops_them(transitions: Transitions) -> None:
    recorder = Recorder()
    agent = FAMLE("reacher", seed=0, device="cpu", meta_iterations=4, inner_steps=1)
    agent.get_env().close()
    agent.meta_learn(transitions, callback=recorder)
    assert recorder.calls == [1, 2, 3, 4]
    assert recorder.ended
    calls: list[int] = []
    agent.meta_learn(transitions, callback=lambda local, _: calls.append(1) or len(calls) < 2)
    assert len(calls) == 2
    assert agent.num_timesteps == 0


def test_meta_learning_again_forgets_the_robot(quick_agent: FAMLE, transitions: Transitions) -> None:
    for i in range(5):
        quick_agent.observe(transitions.obs[3, i], transitions.action[3, i], transitions.next_obs[3, i])
    assert quick_agent.belief.adaptations == 1
    quick_agent.hyperparameters = replace(quick_agent.hyperparameters, meta_iterations=1)
    quick_agent.meta_learn(transitions)
    assert quick_agent.belief.adaptations == 0


@pytest.mark.parametrize("mode", ["ours", "paper"])
@pytest.mark.parametrize("planner", ["icem", "mppi", "random_shooting"])
def test_every_mode_and_planner_runs(transitions: Transitions, make_env: MakeEnv, mode: str, planner: str) -> None:
    agent = FAMLE(
        "reacher",
        mode,
        seed=0,
        device="cpu",
        planner=planner,
        candidates=20,
        inner_steps=2,
        meta_iterations=3,
    )
    agent.meta_learn(transitions)
    agent.get_env().close()
    assert run(agent, make_env(), steps=11).belief.adaptations == 10 // agent.hyperparameters.adapt_every


def test_transitions_of_another_robot_are_refused(transitions: Transitions) -> None:
    agent = FAMLE("Pendulum-v1", seed=0, device="cpu")
    with pytest.raises(ValueError, match="The transitions have observations"):
        agent.meta_learn(transitions)


def test_agent_without_a_model_says_what_to_do(transitions: Transitions) -> None:
    agent = FAMLE("reacher", device="cpu")
    obs, action = transitions.obs[0, 0], transitions.action[0, 0]
    for call in (
        lambda: agent.predict(obs),
        lambda: agent.observe(obs, action, obs),
        agent.posterior,
        lambda: agent.belief,
    ):
        with pytest.raises(NotLearnedError, match=r"meta_learn\(\)"):
            call()
    agent.forget()
    agent.begin_episode()
    agent.get_env().close()


# --- parameters ---------------------------------------------------------------------------------------------


def test_parameters_can_be_taken_and_given(load_agent: Load, transitions: Transitions) -> None:
    one, other = load_agent(), load_agent()
    with torch.no_grad():
        for value in other.dynamics.parameters():
            value.add_(0.1)
    obs = some_observations(transitions, 1)
    before = other.predict(obs, deterministic=True)[0]
    assert list(one.get_parameters()) == ["dynamics"]
    other.set_parameters(one.get_parameters())
    after = other.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(after, one.predict(obs, deterministic=True)[0])
    assert not np.array_equal(before, after)


def test_seeding_again_repeats_the_actions(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs, actions = some_observations(transitions, 1), []
    for seed in (5, 5, 6, None):
        quick_agent.set_random_seed(seed)
        actions.append(quick_agent.predict(obs)[0])
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.array_equal(actions[0], actions[2])
    assert not np.array_equal(actions[2], actions[3])
