"""What several tests of the agent share."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from famle_agent import FAMLE, OnlineState, Transitions

Array = npt.NDArray[Any]


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
