from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import FAMLE, FAMLEWrapper, NotLearnedError, OnlineState, Transitions
from tests.helpers import run, some_observations

Array = npt.NDArray[Any]
Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]


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


def test_a_loaded_agent_imports_nothing_while_the_robot_waits(agent_file: Path) -> None:
    live = f"""
import sys
from famle_agent import FAMLE

agent = FAMLE.load({str(agent_file)!r}, device="cpu", adapt_every=1)
imported, state = set(sys.modules), None
for _ in range(3):
    _, state = agent.predict([0.1] * 12, state)
assert state.belief.adaptations == 2
print(len(set(sys.modules) - imported))
"""
    done = subprocess.run([sys.executable, "-c", live], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) < 20


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
        (None, "holds NaN"),
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
    env.reset(seed=0)
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
    env.seed(0)
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
        (np.zeros((2, 12)), np.zeros((3, 5)), np.zeros((2, 12)), "2 observations, 3 actions"),
    ],
)
def test_wrong_transitions_are_refused(
    quick_agent: FAMLE, obs: Array, action: Array, next_obs: Array, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        quick_agent.observe(obs, action, next_obs)
    assert quick_agent.belief.adaptations == 0


def test_action_is_remembered_as_the_robot_applied_it(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    robot = FAMLEWrapper(make_env(), quick_agent)
    robot.reset(seed=0)
    robot.step(np.array([100.0, -100.0, 0.5, 0.0, 1.0]))
    np.testing.assert_array_equal(quick_agent.state_of(1).memory.action[0, -1].numpy(), [1.0, -1.0, 0.5, 0.0, 1.0])


def test_agent_without_an_environment_says_what_to_do(make_env: MakeEnv) -> None:
    nobody = FAMLE(None, device="cpu")
    with pytest.raises(NotLearnedError, match="meta_learn"):
        nobody.predict(np.zeros(12))
    with pytest.raises(NotLearnedError, match="meta_learn"):
        FAMLEWrapper(make_env(), nobody)
    with pytest.raises(ValueError, match="nothing to save"):
        nobody.save(io.BytesIO())
