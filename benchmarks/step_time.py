"""What a control step of each method costs, adaptation or learning and the simulated robot included.

python -m benchmarks.step_time

All methods take turns in one run on one thread. `famle-original` is measured inside an episode, without its adaptation
at the end, which grows with the number of episodes. What a step costs does not depend on what the networks know, so
that they are hardly trained. The raw cost is the robot's own step with random actions.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

import famle_envs  # noqa: F401 (registers the robots)
from benchmarks import command
from benchmarks.harness import Result, provenance, write_json
from benchmarks.ppo import SETTINGS
from benchmarks.reporting.study import StepTime
from famle_agent import AMPC, AMPCMAML, FAMLE
from famle_agent.agents.presets import known_robots

HARDLY: Mapping[str, Any] = {
    "rounds": 0,
    "joint_iterations": 1,
    "meta_iterations": 1,
    "transitions_per_situation": 200,
    "pretrained": False,
    "device": "cpu",
    "seed": 0,
}
"""Settings of an agent that is as slow as a trained one."""

AGENTS: Mapping[str, Callable[[str], BaseAlgorithm]] = {
    "famle": lambda robot: FAMLE(robot, **HARDLY),
    "famle-paper": lambda robot: FAMLE(robot, "paper", **HARDLY),
    "famle-original": lambda robot: FAMLE(robot, "original", **HARDLY),
    "ampc": lambda robot: AMPC(robot, **HARDLY),
    "ampc-reptile": lambda robot: AMPCMAML(robot, **HARDLY),
    "ampc-fomaml": lambda robot: AMPCMAML(robot, meta_learner="first-order-maml", **HARDLY),
    "ampc-maml": lambda robot: AMPCMAML(robot, meta_learner="maml", **HARDLY),
    "ppo": lambda robot: PPO("MlpPolicy", known_robots()[robot].env_id, device="cpu", **SETTINGS.get(robot, {})),
}
"""Agents by method, for a robot."""


@dataclass(frozen=True)
class Args:
    """Measures control steps."""

    robots: tuple[str, ...] = ("reacher", "ant")
    """Robots with all modes."""
    rounds: int = 5
    """How often each method has its turn."""
    steps: int = 50
    """Robot steps of a turn."""
    slow_steps: int = 25
    """Robot steps of a turn of the methods that judge 10,000 candidates; the paper's settings adapt once in so many."""
    out: Path = Path("benchmarks/results")
    """Folder of the result."""


class Stopwatch(BaseCallback):
    """Notes when each step of an agent ended."""

    def __init__(self) -> None:
        super().__init__()
        self.ends: list[float] = []

    def _on_step(self) -> bool:
        self.ends.append(time.perf_counter())
        return True


def milliseconds(agent: BaseAlgorithm, steps: int) -> float:
    """The mean of a turn, in which an agent lives on its robot, in ms a step."""
    start, watch = time.perf_counter(), Stopwatch()
    agent.learn(steps, callback=watch, reset_num_timesteps=False)
    return 1e3 * (time.perf_counter() - start) / len(watch.ends)


def bare_milliseconds(env: gym.Env[Any, Any], steps: int) -> float:
    """The mean of a turn of the robot alone, in ms a step."""
    env.reset()
    start = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return 1e3 * (time.perf_counter() - start) / steps


def measure(robot: str, args: Args) -> dict[str, list[float]]:
    """The means of all turns of each method, in ms a step."""
    agents = {name: make(robot) for name, make in AGENTS.items()}
    for agent in agents.values():
        if isinstance(agent, FAMLE | AMPC | AMPCMAML):
            agent.meta_learn()
    env = gym.make(known_robots()[robot].env_id)
    env.reset(seed=0)
    turns: dict[str, list[float]] = {name: [] for name in ("robot alone", *agents)}
    for _ in range(args.rounds):
        turns["robot alone"].append(bare_milliseconds(env, args.steps))
        for name, agent in agents.items():
            slow = isinstance(agent, FAMLE) and agent.hyperparameters.planner == "random_shooting"
            # A turn of PPO is one rollout, and the learning from it.
            steps = agent.n_steps if isinstance(agent, PPO) else args.slow_steps if slow else args.steps
            turns[name].append(milliseconds(agent, steps))
    return turns


def table(times: Mapping[str, Mapping[str, list[float]]]) -> Table:
    """Medians over the turns, and of the ratios within a turn."""
    result = Table("method", *times, title="ms a control step (times the robot alone), median over turns")
    for name in next(iter(times.values())):
        each = [StepTime.of(turns[name], turns["robot alone"]) for turns in times.values()]
        result.add_row(name, *(f"{time.milliseconds:.2f} (x {time.times_robot_alone:.1f})" for time in each))
    return result


def main(args: Args) -> None:
    """Measures, prints and stores."""
    torch.set_num_threads(1)
    times = {robot: measure(robot, args) for robot in args.robots}
    Console().print(table(times))
    result: Result = {"title": "Milliseconds a control step, mean of each turn", "times": times}
    write_json(args.out / "step-time.json", result | provenance(sys.argv))


if __name__ == "__main__":
    command.run(main, Args)
