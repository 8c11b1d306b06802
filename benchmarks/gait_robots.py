"""What the benchmarks of the quadruped and the Minitaur share: the agents, and one replicate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.harness import Result
from benchmarks.methods import shipped
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.hyperparameters import known_robots
from famle_agent.journey import run_journey
from famle_agent.policies import make_held_uniform
from famle_agent.transitions import collect
from famle_envs import Situation

__all__ = ["METHODS", "Task", "run"]


@dataclass(frozen=True)
class Task:
    """One replicate.

    Attributes:
        robot: The robot's name.
        seed: Of the robot and the planner.
        situation: What is wrong with the robot from the start.
        profile: What else differs from the simulator.
        cache: Folder of the agents that are trained here.
        later: What goes wrong on the way, if anything does.
        strikes_at: The action before which it does.
    """

    robot: str
    seed: int
    situation: Situation
    profile: str
    cache: Path
    later: Situation | None = None
    strikes_at: int = 0

    def make(self) -> gym.Env[Any, Any]:
        """The test robot."""
        return gym.make(known_robots()[self.robot].env_id, situation=self.situation, profile=self.profile)


def oracle(task: Task) -> FAMLE:
    """The upper line: its model is of 2,000 random gaits of the test robot itself, and it adapts all the same."""
    path = task.cache / f"{task.robot}-oracle-{task.profile}-{str(task.situation).replace(' ', '_')}.zip"
    if not path.exists():
        agent = FAMLE(task.robot, seed=0, device="cpu", pretrained=False, compose=False)
        # Collected by hand: no agent meta-learns on a profile, and this one is not to be had on a real robot.
        hold = make_held_uniform(agent.hyperparameters.action_hold)
        agent.meta_learn(collect([task.make], [task.situation.label], 2000, hold, seed=0)).save(path)
    return FAMLE.load(path, device="cpu")


def one_simulator(task: Task) -> FAMLE:
    """An agent that knows only the intact robot in its simulator, four times as long as FAMLE knows each situation."""
    path = task.cache / f"{task.robot}-one-simulator.zip"
    if not path.exists():
        n = 4 * known_robots()[task.robot].hyperparameters("ours").transitions_per_situation
        agent = FAMLE(task.robot, seed=0, device="cpu", pretrained=False, compose=False, transitions_per_situation=n)
        agent.meta_learn(["intact"]).save(path)
    return FAMLE.load(path, device="cpu", adapt_every=0)


VARIANTS: Mapping[str, dict[str, Any]] = {
    "famle": {},
    "famle-frozen": {"adapt_every": 0},
    "famle-likeliest": {"spread_members": False},
    "famle-nearest": {"adapt_steps": 0, "compose": False, "spread_members": False},
}
"""The shipped agent with settings changed."""

METHODS: dict[str, Callable[[Task], FAMLE]] = {
    **{
        name: partial(lambda task, overrides: shipped(task.robot, task.seed, **overrides), overrides=o)
        for name, o in VARIANTS.items()
    },
    "one-simulator": one_simulator,
    "oracle": oracle,
}
"""Agents by name."""


def run(method: str, task: Task) -> Result:
    """One replicate: an episode of the test robot."""
    agent = METHODS[method](task)
    agent.set_random_seed(task.seed)
    env = FAMLEWrapper(task.make(), agent)
    journey = run_journey(env, task.seed, task.later, task.strikes_at)
    profile = str(env.get_wrapper_attr("profile"))
    env.close()
    return {
        "situation": str(task.situation),
        "later": None if task.later is None else str(task.later),
        "profile": profile,
        "gaits": journey.gaits,
        "reached": journey.reached,
        "fell": journey.fell,
        "distance": round(float(journey.path[-1, 0]), 3),
        "believed": journey.believed[-1],
        "path": np.round(journey.path, 3).tolist(),
        "ms_per_plan": round(1e3 * float(np.median(journey.seconds)), 1),
    }
