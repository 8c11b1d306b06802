"""The Minitaur on held-out dynamics: the paper's table II.

python -m benchmarks.minitaur                     # 60 gaits outside the simulator
python -m benchmarks.minitaur --experiment home   # the same in the default simulator

Replicates share the shipped model, and the other agents theirs; each has its own seed of the robot and the planner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from benchmarks.quadruped import run
from benchmarks.runner import Options, launch, run_experiment
from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.minitaur import HELD_OUT


@dataclass(frozen=True)
class Args(Options):
    """The Minitaur on held-out dynamics: the paper's table II."""

    experiment: Literal["held-out", "home"] = "held-out"
    """Where the robot walks."""


def task_of(experiment: str, seed: int, args: Args) -> Task:
    """Makes the test robot of a replicate; intact, but for its profile."""
    profile = "simulator" if experiment == "home" else HELD_OUT.name
    return Task("minitaur", seed, Situation(), args.cache, profile)


def main(args: Args) -> None:
    """Runs and reports."""
    tasks = [task_of(args.experiment, seed, args) for seed in range(args.replicates)]
    run_experiment(f"minitaur-{args.experiment}", tasks, run, args)


if __name__ == "__main__":
    launch(main, Args)
