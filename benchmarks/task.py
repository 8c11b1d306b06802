"""Test robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

import famle_envs  # noqa: F401 (registers the robots)
from famle_agent.agents.presets import known_robots
from famle_envs import Situation
from famle_envs.profile import Profile


@dataclass(frozen=True)
class Task:
    """The test robot of one replicate.

    Attributes:
        robot: The robot's name.
        seed: Of the robot and the planner, and of what the method learns for itself.
        situation: What is wrong with the robot.
        cache: Folder of the agents that are learnt in simulation, which replicates and methods share.
        profile: What else differs from the simulator.
        later: What goes wrong on the way, if anything does.
        strikes_at: The action before which it does.
        device: Where the agent computes.
    """

    robot: str
    seed: int
    situation: Situation
    cache: Path
    profile: str | Profile = ""
    later: Situation | None = None
    strikes_at: int = 0
    device: str = "cpu"

    @property
    def env_id(self) -> str:
        """The Gymnasium id."""
        return known_robots()[self.robot].env_id

    def make(self) -> gym.Env[Any, Any]:
        """Makes the test robot."""
        kwargs: dict[str, Any] = {"profile": self.profile} if self.profile else {}
        return gym.make(self.env_id, situation=self.situation, **kwargs)
