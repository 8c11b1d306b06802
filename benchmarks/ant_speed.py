"""What the ant's parts cost, each beside the raw cost of the same work in one run.

python -m benchmarks.ant_speed
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import numpy as np
import pybullet
import torch
from rich.console import Console
from rich.table import Table
from torch import nn

from benchmarks import command
from benchmarks.ant import ENV_ID
from benchmarks.harness import provenance, write_json
from benchmarks.methods import shipped
from benchmarks.speed import in_turn
from famle_agent import FAMLEWrapper
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.rollout import rollout
from famle_agent.training.multitask import JointTraining

SITUATIONS, BATCH = 20, 32
HIDDEN = (200, 200, 100)  # the paper's network


@dataclass(frozen=True)
class Args:
    """Times the parts of the ant's agent."""

    repeats: int = 30
    """Timings of each figure; the median counts."""
    steps: int = 1000
    """Control steps of which the mean and the 99th percentile are taken."""
    threads: tuple[int, ...] = (1, 2)
    """Threads of torch for the gradient and control steps; the other figures are of one thread."""
    out: Path = Path("benchmarks/results/ant-speed.json")
    """Where the result goes."""


def environment(repeats: int) -> dict[str, float]:
    """A step of the environment, and the ``stepSimulation`` of the same states and torques alone, in a twin."""
    robot, twin = (gym.make(ENV_ID).unwrapped for _ in range(2))
    for env in (robot, twin):
        env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (repeats * 20, 8))
    step, bare = [], []
    for action in actions:
        start = time.perf_counter()
        robot.step(action)
        step.append(time.perf_counter() - start)
        twin.actuate(action)  # type: ignore[attr-defined]
        start = time.perf_counter()
        pybullet.stepSimulation(physicsClientId=twin.client)  # type: ignore[attr-defined]
        bare.append(time.perf_counter() - start)
    robot.close()
    twin.close()
    a, b = float(np.median(step)), float(np.median(bare))
    return {"environment step (us)": 1e6 * a, "bare stepSimulation (us)": 1e6 * b, "ratio": a / b}


def control_step(steps: int, threads: int) -> dict[str, float]:
    """A whole control step on an ant that breaks in mid-run: plan, inference and simulation."""
    torch.set_num_threads(threads)
    agent = shipped("ant", seed=0)
    env = FAMLEWrapper(gym.make(ENV_ID, max_episode_steps=steps), agent)
    run = rollout(env, 0, "joint 2 dead, yaw sensor off by 60 deg", steps // 3)
    milliseconds = 1e3 * run.step_seconds[10:]
    period = 1e3 * env.get_wrapper_attr("control_period")
    env.close()
    torch.set_num_threads(1)
    return {
        "mean (ms)": float(milliseconds.mean()),
        "median (ms)": float(np.median(milliseconds)),
        "99th percentile (ms)": float(np.percentile(milliseconds, 99)),
        "control period (ms)": period,
        "within the period": float((milliseconds <= period).mean()),
    }


def planning(repeats: int) -> dict[str, float]:
    """Our plan against the paper's 10,000 random candidates, on the shipped model."""
    ours, paper = shipped("ant", 0), shipped("ant", 0, planner="random_shooting", candidates=10_000)
    obs, _ = gym.make(ENV_ID).reset(seed=0)
    plan, shooting = in_turn(max(3, repeats // 10), lambda: ours.predict(obs), lambda: paper.predict(obs))
    return {"our plan (ms)": 1e3 * plan, "random shooting 10,000 (ms)": 1e3 * shooting, "ratio": shooting / plan}


def sgd(repeats: int) -> dict[str, float]:
    """Steps of the paper's network on 32 transitions: one situation at a time in plain PyTorch, and ours at once.

    Each situation has a network of its own in Reptile's inner loop; in joint training they share one.
    """
    model = Dynamics(27, 8, SITUATIONS, 5, HIDDEN, gate_actions=False)
    x, y = torch.randn(SITUATIONS, BATCH, 35), torch.randn(SITUATIONS, BATCH, 27)
    batch = Batch(x, y, torch.ones(SITUATIONS, BATCH))
    theta, h = model.theta_of(SITUATIONS), model.embeddings_of(torch.arange(SITUATIONS))
    steps = 10

    def batched() -> None:
        InnerLoop(steps, 1e-3, 1e-3)(model, theta, h, lambda: batch)

    sizes = [40, *HIDDEN, 27]
    layers = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.SiLU())][:-1]
    network = nn.Sequential(*layers)
    embedding = nn.Parameter(torch.randn(5))
    optimizer = torch.optim.SGD([*network.parameters(), embedding], lr=1e-3)

    def plain() -> None:
        for _ in range(steps):
            inputs = torch.cat([x[0], embedding.expand(BATCH, -1)], dim=1)
            loss = (network(inputs) - y[0]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

    data = Batch(torch.randn(SITUATIONS, 500, 35), torch.randn(SITUATIONS, 500, 27), torch.ones(SITUATIONS, 500))
    joint = JointTraining(steps, 1e-3, 1e-3, SITUATIONS * BATCH)
    generator = torch.Generator().manual_seed(0)

    together, jointly, alone = in_turn(repeats, batched, lambda: list(joint.steps(model, data, generator)), plain)
    reptile, shared, theirs = SITUATIONS * steps / together, SITUATIONS * steps / jointly, steps / alone
    return {
        "Reptile (situation-steps / s)": reptile,
        "joint training (situation-steps / s)": shared,
        "plain PyTorch (steps / s)": theirs,
        "ratio, Reptile": reptile / theirs,
        "ratio, joint training": shared / theirs,
    }


def main(args: Args) -> None:
    """Measures, prints and stores."""
    torch.set_num_threads(1)
    figures: dict[str, dict[str, float]] = {
        "environment": environment(args.repeats),
        "planning": planning(args.repeats),
    }
    for threads in args.threads:
        torch.set_num_threads(threads)
        figures[f"gradient step, {threads} thread(s)"] = sgd(args.repeats)
        figures[f"control step, {threads} thread(s)"] = control_step(args.steps, threads)
    table = Table("part", "figure", "value")
    for part, values in figures.items():
        for name, value in values.items():
            table.add_row(part, name, f"{value:.4g}")
    Console().print(table)
    write_json(args.out, {**figures, **provenance(sys.argv)})


if __name__ == "__main__":
    command.run(main, Args)
