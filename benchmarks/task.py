"""Test robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym

import famle_envs  # noqa: F401 (registers the robots)
from famle_agent.agents.presets import known_robots
from famle_envs import Situation
from famle_envs.profile import Profile

Engine = Literal["pybullet", "mujoco"]


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
        engine: What the test robot runs in, whatever else is installed.
        simulator: The engine that agents learn in before that. The cache is of this one alone.
        meta_trainings: Independent ones that replicates take turns with, where the package ships no model; None gives
            each replicate its own.
    """

    robot: str
    seed: int
    situation: Situation
    cache: Path
    profile: str | Profile = ""
    later: Situation | None = None
    strikes_at: int = 0
    device: str = "cpu"
    engine: Engine = "pybullet"
    simulator: Engine = "pybullet"
    meta_trainings: int | None = None

    @property
    def env_id(self) -> str:
        """The Gymnasium id."""
        return known_robots()[self.robot].env_id

    @property
    def is_shipped(self) -> bool:
        """Whether the package ships a model of the robot, learnt in this simulator."""
        return self.simulator == "pybullet" and known_robots()[self.robot].pretrained is not None

    @property
    def meta_seed(self) -> int:
        """The seed of the meta-training of a model that is not shipped."""
        return self.seed if self.meta_trainings is None else self.seed % self.meta_trainings

    def make(self, **kwargs: Any) -> gym.Env[Any, Any]:
        """Makes the test robot; with further arguments of :func:`gymnasium.make`."""
        if self.profile:
            kwargs["profile"] = self.profile
        return gym.make(self.env_id, situation=self.situation, engine=self.engine, **kwargs)

    def simulated(self) -> gym.Env[Any, Any]:
        """Makes the robot that agents learn on: intact, in the simulator."""
        return gym.make(self.env_id, engine=self.simulator)
