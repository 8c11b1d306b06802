"""The arm: the paper's figure 3, and the same over damages drawn at random.

python -m benchmarks.reacher                      # the paper's test damage
python -m benchmarks.reacher --damage random --replicates 20 --steps 300
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from benchmarks import curves
from benchmarks.methods import METHODS, PPO_METHODS
from benchmarks.results import Result
from benchmarks.runner import Options, launch, run_experiment
from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv


@dataclass(frozen=True)
class Args(Options):
    """The arm: the paper's figure 3, and the same over damages drawn at random."""

    damage: Literal["paper", "random"] = "paper"
    """The paper's (-1, 1, 1, 0, 1), or two faults drawn anew for each replicate."""
    replicates: int = 30
    """Seeds 0, 1, ..."""
    steps: int = 1000
    """Robot steps of the model-based methods."""
    ppo_steps: int = 20_000
    """Robot steps of PPO."""


def situation_of(damage: str, seed: int) -> Situation:
    """Makes the test situation of a replicate; no training, and no tuning, has seen it."""
    if damage == "paper":
        return ReacherEnv.presets["paper"]
    return ReacherEnv.sample_situation(np.random.default_rng([2020, seed]), n_faults=2)


def run(method: str, tasks: Sequence[Task], args: Args) -> list[Result]:
    """Runs one replicate, or many in step."""
    steps = args.ppo_steps if method in PPO_METHODS else args.steps
    return curves.run(METHODS[method].on(tasks), tasks, steps, args.minutes)


def main(args: Args) -> None:
    """Runs and reports."""
    tasks = [
        Task("reacher", seed, situation_of(args.damage, seed), args.cache, device=args.device)
        for seed in range(args.replicates)
    ]
    run_experiment(f"reacher-{args.damage}", tasks, partial(run, args=args), args, together=True)


if __name__ == "__main__":
    launch(main, Args)
