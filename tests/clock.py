"""An environment whose transitions tell where they are from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.data.transitions import EnvSource, Transitions

Array = npt.NDArray[Any]
LOW, HIGH = np.array([2.0, -6.0], dtype=np.float32), np.array([5.0, -4.0], dtype=np.float32)


class Clock(gym.Env[Array, Array]):
    """Observes the episode and the step; its actions are far from [-1, 1]."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,))
    action_space = spaces.Box(LOW, HIGH)

    def __init__(self, length: int = 4, terminates: bool = True, reuses: bool = False) -> None:
        self.length, self.terminates, self.reuses = length, terminates, reuses
        self.episode, self.seeds = -1, []
        self.buffer = np.zeros(3, dtype=np.float32)

    def observe(self) -> Array:
        self.buffer[:] = (self.episode, self.clock, self.np_random.random())
        return self.buffer if self.reuses else self.buffer.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.episode, self.clock = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.clock += 1
        over = self.clock == self.length
        return self.observe(), 10.0 * self.clock, over and self.terminates, over and not self.terminates, {}


def collected(
    n: int = 9, seed: int = 0, hold: int = 1, envs: Sequence[EnvSource] | None = None, **kwargs: Any
) -> Transitions:
    """What a random policy sees in one clock per situation."""
    envs = envs or [Clock(), Clock()]
    return collect(envs, [f"situation {i}" for i in range(len(envs))], n, make_held_uniform(hold), seed, **kwargs)
