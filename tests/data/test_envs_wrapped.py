from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from famle_agent import FAMLE

MakeEnv = Callable[..., gym.Env[Any, Any]]


def first(obs: Any, action: Any, next_obs: Any) -> Any:
    """A reward that can be given to any agent."""
    return next_obs[..., 0]


def rescaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    return gym.wrappers.RescaleObservation(env, np.float32(0.0), np.float32(1.0))


@pytest.mark.parametrize("wrap", [rescaled, gym.wrappers.NormalizeObservation], ids=["rescaled", "normalised"])
def test_what_is_said_of_other_observations_is_not_taken(make_env: MakeEnv, wrap: Any) -> None:
    env = wrap(make_env())
    with pytest.raises(ValueError, match=r"reward_fn.*Observation.*reward_fn=\.\.\."):
        FAMLE(env, device="cpu", angle_dims=())
    with pytest.raises(ValueError, match=r"angle_dims.*Observation.*angle_dims=\.\.\."):
        FAMLE(env, device="cpu", reward_fn=first)
    agent = FAMLE(env, device="cpu", angle_dims=(), reward_fn=first)
    assert agent.dims["angle_dims"] == ()


def test_stacked_observations_are_others(make_env: MakeEnv) -> None:
    stacked = VecFrameStack(DummyVecEnv([make_env]), 2)
    with pytest.raises(ValueError, match="VecFrameStack"):
        FAMLE(stacked, device="cpu")


def test_rescaled_actions_leave_observations_as_they_are(make_env: MakeEnv) -> None:
    env = gym.wrappers.RescaleAction(make_env(), np.float32(-2.0), np.float32(2.0))
    with pytest.raises(ValueError, match="RescaleAction"):
        FAMLE(env, device="cpu")
    agent = FAMLE(env, device="cpu", reward_fn=first)
    assert agent.dims["angle_dims"] == FAMLE("reacher", device="cpu").dims["angle_dims"]


def test_wrapper_that_looks_on_costs_nothing(make_env: MakeEnv) -> None:
    agent = FAMLE(gym.wrappers.RecordEpisodeStatistics(make_env("FamleAnt-v0")), device="cpu")
    assert agent.dynamics is not None


def test_robots_with_different_goals_need_a_reward_that_knows_them(make_env: MakeEnv) -> None:
    goals = [(-1.0, 1.0), (1.0, -1.0)]
    robots = DummyVecEnv([lambda goal=goal: make_env(goal=goal) for goal in goals])
    with pytest.raises(ValueError, match="different tasks"):
        FAMLE(robots, device="cpu")
    FAMLE(robots, device="cpu", reward_fn=first)
    broken = DummyVecEnv([lambda s=s: make_env(situation=s, goal=goals[0]) for s in ("intact", "joint 3 dead")])
    FAMLE(broken, device="cpu")
