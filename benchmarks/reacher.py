"""The arm: the paper's figure 3, and the same over damages drawn at random.

python -m benchmarks.reacher                      # the paper's test damage
python -m benchmarks.reacher --damage random --replicates 20 --steps 300
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console

from benchmarks.harness import Replicate, Result, load_results, run_replicates
from benchmarks.methods import METHODS, Task
from benchmarks.report import plot_curves, summary
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv

SOLVED = 30.0
ENV_ID = "FamleReacher-v0"


@dataclass(frozen=True)
class Args:
    """Runs replicates that are not stored yet, then reports on all that are."""

    damage: Literal["paper", "random"] = "paper"
    """The paper's (-1, 1, 1, 0, 1), or two faults drawn anew for each replicate."""
    methods: tuple[str, ...] = ("famle", "famle-frozen", "oracle", "ppo")
    """Entries of benchmarks.methods.METHODS."""
    replicates: int = 10
    """Seeds; each has its own data, meta-training and robot."""
    steps: int = 1000
    """Robot steps of the model-based methods."""
    ppo_steps: int = 20_000
    """Robot steps of PPO."""
    jobs: int = 2
    """Parallel processes."""
    out: Path = Path("benchmarks/results")
    """Folder of the results."""
    cache: Path = Path("runs/agents")
    """Folder of the meta-trained agents."""


def situation_of(damage: str, seed: int) -> Situation:
    """The test situation of a replicate; no training, and no tuning, has seen it."""
    if damage == "paper":
        return ReacherEnv.presets["paper"]
    return ReacherEnv.sample_situation(np.random.default_rng([2020, seed]), n_faults=2)


def run(method: str, seed: int, args: Args) -> Result:
    """One replicate."""
    situation = situation_of(args.damage, seed)
    return METHODS[method](Task("reacher", ENV_ID, situation, args.steps, args.ppo_steps, args.cache), seed)


def main(args: Args) -> None:
    """Runs and reports."""
    for method in args.methods:
        if method not in METHODS:
            raise ValueError(f"There is no method {method!r}. Methods: {', '.join(METHODS)}.")
    folder = args.out / f"reacher-{args.damage}"
    # One method after the other: the first leaves the meta-trained agents that the next ones start from.
    for method in args.methods:
        seeds = range(args.replicates)
        run_replicates([Replicate(method, seed, partial(run, method, seed, args)) for seed in seeds], folder, args.jobs)
    results = load_results(folder)
    title = f"Reacher, {args.damage} damage"
    Console(width=160).print(summary(results, SOLVED, title, within=200))
    plot_curves(results, SOLVED, title, args.out / f"reacher-{args.damage}.png", args.steps)


if __name__ == "__main__":
    main(tyro.cli(Args))
