"""What a control step of each method costs; benchmarks.performance measures what FAMLE's own parts cost.

python -m benchmarks.timing                                # on the arm and the ant

Methods take turns in one run, so that a slow moment of the machine meets all of them. Networks are hardly trained,
since a step costs the same whatever they know; `famle-original` is measured inside an episode, without its adaptation
at the end, which grows with the number of episodes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.ppo import from_scratch
from benchmarks.reporting.study import ROBOT_ALONE, STEPS_IN_TURNS
from benchmarks.results import provenance, store
from benchmarks.runner import launch
from benchmarks.task import Task
from benchmarks.untrained import robot_of
from famle_agent import AMPC, AMPCMAML, FAMLE, ModelBasedAgent
from famle_agent.planning import RandomShooting
from famle_envs import Situation

HARDLY_TRAINED: Mapping[str, Any] = {
    "rounds": 0,
    "transitions_per_situation": 200,
    "pretrained": False,
    "device": "cpu",
    "seed": 0,
}
"""Settings of an agent that is as slow as a trained one."""

HARDLY: Mapping[str, Any] = {**HARDLY_TRAINED, "joint_iterations": 1, "meta_iterations": 1}
"""The same for those that learn in simulation."""

ROBOTS = ("reacher", "ant")
"""Robots with all modes."""


@dataclass(frozen=True)
class Args:
    """Times control steps of all methods."""

    robots: tuple[str, ...] = ROBOTS
    """Robots with all modes."""
    turns: int = 5
    """Turns of each method; the median counts."""
    turn_steps: int = 50
    """Robot steps of a turn, half as many of methods that judge 10,000 candidates: these adapt once in so many."""
    threads: int = 1
    """Threads of torch."""
    out: Path = Path("benchmarks/results")
    """Folder of timing.csv."""

    def __post_init__(self) -> None:
        if unknown := set(self.robots) - set(ROBOTS):
            raise ValueError(f"There is nothing to time of {', '.join(unknown)}. Known: {', '.join(ROBOTS)}.")


def in_turns(robot: str, args: Args) -> dict[str, list[float]]:
    """Times control steps of all methods, adaptation or learning and the robot included; ms a step in each turn."""
    agents = _hardly_trained(robot)
    env = robot_of(robot)
    turns: dict[str, list[float]] = {name: [] for name in (ROBOT_ALONE, *agents)}
    for _ in range(args.turns):
        turns[ROBOT_ALONE].append(_robot_alone(env, args.turn_steps))
        for name, agent in agents.items():
            slow = isinstance(agent, ModelBasedAgent) and isinstance(agent.config.planner, RandomShooting)
            steps = args.turn_steps // 2 if slow else args.turn_steps
            # A turn of PPO is one rollout, and the learning from it.
            steps, before = agent.n_steps if isinstance(agent, PPO) else steps, agent.num_timesteps
            start = time.perf_counter()
            agent.learn(steps, reset_num_timesteps=False)
            turns[name].append(1e3 * (time.perf_counter() - start) / (agent.num_timesteps - before))
    return turns


def main(args: Args) -> None:
    """Measures, stores and prints."""
    torch.set_num_threads(args.threads)
    for robot in args.robots:
        turns = in_turns(robot, args)
        about = {"robot": robot, "part": STEPS_IN_TURNS, "threads": args.threads} | provenance(sys.argv)
        rows = [{"figure": name, "value": milliseconds} | about for name, milliseconds in turns.items()]
        store(args.out / "timing.csv", rows, keys=("robot", "part", "threads"))
        medians = pd.Series({name: np.median(milliseconds) for name, milliseconds in turns.items()})
        print(f"\n{robot}, {STEPS_IN_TURNS}, {args.threads} thread(s), medians:", medians.to_string(), sep="\n")


def _hardly_trained(robot: str) -> dict[str, BaseAlgorithm]:
    task = Task(robot, 0, Situation(), Path())
    agents: dict[str, BaseAlgorithm] = {
        "famle": FAMLE(task.simulated(), **HARDLY),
        "famle-paper": FAMLE(task.simulated(), "paper", **HARDLY),
        "famle-original": FAMLE(task.simulated(), "original", **HARDLY),
        "ampc": AMPC(task.simulated(), **HARDLY_TRAINED),
        "ampc-reptile": AMPCMAML(task.simulated(), **HARDLY),
        "ampc-fomaml": AMPCMAML(task.simulated(), meta_learner="first-order-maml", **HARDLY),
        "ampc-maml": AMPCMAML(task.simulated(), meta_learner="maml", **HARDLY),
        "ppo": from_scratch(task),
    }
    for agent in agents.values():
        if isinstance(agent, ModelBasedAgent):
            agent.meta_learn()
    return agents


def _robot_alone(env: gym.Env[Any, Any], steps: int) -> float:
    """Returns the mean milliseconds of a step with random actions."""
    env.reset()
    start = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return 1e3 * (time.perf_counter() - start) / steps


if __name__ == "__main__":
    launch(main, Args)
