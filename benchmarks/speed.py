"""What the parts cost, each beside the raw cost of the same work in one run.

python -m benchmarks.speed
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pybullet
import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command
from benchmarks.harness import provenance, write_json
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.rollout import rollout


@dataclass(frozen=True)
class Args:
    """Times the parts of the reacher's agent."""

    repeats: int = 30
    """Timings of each figure; the median counts."""
    threads: int = 2
    """Threads of torch."""
    out: Path = Path("benchmarks/results/speed.json")
    """Where the result goes."""


def in_turn(repeats: int, *calls: Callable[[], Any]) -> list[float]:
    """Median seconds of each call; they take turns, so that a slow moment of the machine meets all of them."""
    times: list[list[float]] = [[] for _ in calls]
    for repeat in range(repeats + 2):
        for call, seconds in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if repeat >= 2:  # the first two warm up
                seconds.append(time.perf_counter() - start)
    return [statistics.median(seconds) for seconds in times]


def planning(agent: FAMLE, repeats: int) -> dict[str, float]:
    """The paper's plan, 10,000 candidates x 10, against the bare matrix products of the same shapes; and our plan."""
    big = FAMLE("reacher", "paper", device="cpu", meta_iterations=1, inner_steps=1, transitions_per_situation=50)
    big.meta_learn()
    obs, _ = gym.make("FamleReacher-v0").reset(seed=0)
    settings, model = big.hyperparameters, big.model
    sizes = [model.n_features + model.action_dim, *settings.hidden, model.obs_dim]
    x = [torch.randn(settings.candidates, size) for size in sizes[:-1]]
    weights = [torch.randn(a, b) for a, b in pairwise(sizes)]

    def bare() -> None:
        for _ in range(settings.horizon):
            for rows, weight in zip(x, weights, strict=True):
                torch.mm(rows, weight)

    plan, raw, ours = in_turn(repeats, lambda: big.predict(obs), bare, lambda: agent.predict(obs))
    return {
        "plan 10,000 x 10 (ms)": 1e3 * plan,
        "bare products (ms)": 1e3 * raw,
        "ratio": plan / raw,
        "our plan (ms)": 1e3 * ours,
    }


def control_step(agent: FAMLE, episodes: int = 2) -> dict[str, float]:
    """A whole control step on the broken arm: plan, adaptation averaged over K, and simulation."""
    env = FAMLEWrapper(gym.make("FamleReacher-v0", situation="paper"), agent)
    seconds = statistics.median(rollout(env, seed=0).step_seconds.mean() for _ in range(episodes))
    env.close()
    return {"control step (ms)": 1e3 * seconds, "control period (ms)": 100.0}


def environment(repeats: int) -> dict[str, float]:
    """A step of the environment against its bare ``stepSimulation`` calls."""
    env = gym.make("FamleReacher-v0")
    env.reset(seed=0)
    robot, action = env.unwrapped, np.full(5, 0.3)

    def bare() -> None:
        for _ in range(robot.physics_steps):  # type: ignore[attr-defined]
            pybullet.stepSimulation(physicsClientId=robot.client)  # type: ignore[attr-defined]

    step, raw = in_turn(repeats * 10, lambda: robot.step(action), bare)
    env.close()
    return {"environment step (ms)": 1e3 * step, "bare stepSimulation (ms)": 1e3 * raw, "ratio": step / raw}


def meta_training() -> tuple[FAMLE, dict[str, float]]:
    """``FAMLE("reacher").meta_learn()`` from scratch."""
    agent = FAMLE("reacher", seed=0, device="cpu")
    start = time.perf_counter()
    transitions = agent.collect()
    collected = time.perf_counter()
    agent.meta_learn(transitions)
    end, settings = time.perf_counter(), agent.hyperparameters
    steps = settings.meta_iterations * settings.inner_steps * len(agent.situations)
    return agent, {
        "simulation (s)": collected - start,
        "meta-learning (s)": end - collected,
        "situation-steps / s": steps / (end - collected),
    }


def main(args: Args) -> None:
    """Measures, prints and stores."""
    torch.set_num_threads(args.threads)
    agent, training = meta_training()
    figures = {
        "meta-training": training,
        "planning": planning(agent, args.repeats),
        "control": control_step(agent),
        "environment": environment(args.repeats),
    }
    table = Table("part", "figure", "value")
    for part, values in figures.items():
        for name, value in values.items():
            table.add_row(part, name, f"{value:.3g}")
    Console().print(table)
    write_json(args.out, figures | {"threads": args.threads} | provenance(sys.argv))


if __name__ == "__main__":
    command.run(main, Args)
