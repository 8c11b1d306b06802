from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.rollout import Rollout, rollout, running_mean

MakeEnv = Callable[..., gym.Env[Any, Any]]


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=30), st.integers(1, 40))
def test_running_mean_is_the_mean_of_the_last_values(values: list[float], window: int) -> None:
    expected = [np.mean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))]
    np.testing.assert_allclose(running_mean(np.array(values), window), expected, atol=1e-9)


def record(reward: list[float], breaks_at: int | None = None) -> Rollout:
    n = len(reward)
    return Rollout(np.array(reward), np.zeros((n + 1, 0)), np.ones(n), np.ones(n), ["intact"] * n, 1.0, breaks_at)


@pytest.mark.parametrize(
    ("reward", "recovery"),
    [
        ([2.0] * 8, 0),
        ([2.0] * 4 + [0.0] * 4, None),
        ([2.0] * 4 + [0.0, 0.0] + [2.0] * 6, 4),
        ([2.0] * 4 + [0.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0], 4),
        ([0.0] * 4 + [2.0] * 8, 2),
    ],
    ids=["never slow", "never again", "recovers", "slow again at the end", "slow only before"],
)
def test_recovery_counts_from_the_break(reward: list[float], recovery: int | None) -> None:
    assert record(reward, breaks_at=4).recovery(threshold=1.0, window=2) == recovery


# --- an arm, which breaks on the way --------------------------------------------------------------------------


def watched(env: FAMLEWrapper) -> list[str]:
    """The situation in each step, which is rewarded by its number."""
    seen: list[str] = []
    robot: Any = env.unwrapped
    robot.reward_fn = lambda *_: seen.append(str(robot.situation)) or float(len(seen))
    return seen


@pytest.mark.parametrize("breaks_at", [None, 0, 2])
def test_robot_breaks_before_the_named_step(quick_agent: FAMLE, make_env: MakeEnv, breaks_at: int | None) -> None:
    env = FAMLEWrapper(make_env(max_episode_steps=6, render_mode="rgb_array"), quick_agent)
    seen, called = watched(env), list[tuple[int, float]]()
    run = rollout(env, 0, "joint 3 dead", breaks_at, 3, lambda step, reward: called.append((step, reward)))
    intact = 6 if breaks_at is None else breaks_at
    assert seen == ["intact"] * intact + ["joint 3 dead"] * (6 - intact)
    assert run.reward.tolist() == [1, 2, 3, 4, 5, 6]
    assert called == list(enumerate(run.reward.tolist()))
    assert (run.steps, run.total, run.breaks_at) == (6, 21.0, breaks_at)
    assert set(run.situations) <= set(quick_agent.situations)
    assert 0.0 < run.probability <= 1.0
    assert (run.plan_seconds > 0).all()
    assert (run.step_seconds > run.plan_seconds).all()
    assert run.position.shape == (7, 0)  # an arm stays where it is
    assert [frame.shape for frame in run.frames] == [(480, 480, 3)] * 2


def test_same_seed_same_episode(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env, rewards = FAMLEWrapper(make_env(max_episode_steps=5), quick_agent), []
    for _ in range(2):
        quick_agent.forget()
        quick_agent.set_random_seed(3)
        rewards.append(rollout(env, 1).reward.tolist())
    assert rewards[0] == rewards[1]


# --- a quadruped, which goes somewhere --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walker() -> FAMLE:
    """An agent of the quadruped that has seen next to nothing."""
    small = {"transitions_per_situation": 4, "joint_iterations": 2, "candidates": 5, "members": 1, "adapt_steps": 1}
    learner = FAMLE("quadruped", seed=0, device="cpu", pretrained=False, **small)
    return learner.meta_learn(["intact", "joint 3 locked"])


def walk(agent: FAMLE, steps: int, **kwargs: Any) -> Rollout:
    env = gym.make("FamleQuadruped-v0", max_episode_steps=steps, **kwargs)
    agent.set_env(env)  # whose goal is the one to plan for
    agent.forget()
    run = rollout(FAMLEWrapper(env, agent), seed=0)
    env.close()
    return run


def test_position_is_that_of_the_body(walker: FAMLE) -> None:
    run = walk(walker, 3)
    assert run.position.shape == (4, 2)
    np.testing.assert_allclose(run.position[0], 0.0, atol=1e-3)
    assert np.abs(np.diff(run.position, axis=0)).max() > 1e-3
    assert run.steps == 3
    assert (run.success, run.terminated, run.fell) == (False, False, False)


def test_position_is_where_the_body_is_whatever_the_sensors_say(walker: FAMLE) -> None:
    run = walk(walker, 1, profile={"name": "blind", "position_noise": 100.0})
    assert np.abs(run.position).max() < 0.5


def test_episode_ends_at_the_goal(walker: FAMLE) -> None:
    run = walk(walker, 5, goal=(0.3, 0.0), success_radius=5.0)
    assert (run.steps, run.success, run.terminated, run.fell) == (1, True, True, False)
