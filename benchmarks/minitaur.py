"""The Minitaur on held-out dynamics: the paper's table II.

python -m benchmarks.minitaur                     # 60 gaits outside the simulator
python -m benchmarks.minitaur --experiment home   # the same in the default simulator

Replicates share the shipped model, and the other agents theirs; each has its own seed of the robot and the planner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from benchmarks.methods import RIVALS
from benchmarks.quadruped import run
from benchmarks.reporting.report import show
from benchmarks.runner import Options, compare, launch
from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.minitaur import HELD_OUT

DEFAULT_METHODS = {
    "held-out": ("famle", "famle-frozen", "famle-nearest", "famle-likeliest", *RIVALS, "one-simulator", "oracle"),
    "home": ("one-simulator", "famle-frozen", "famle"),
}


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
    methods = args.methods or DEFAULT_METHODS[args.experiment]
    tasks = [task_of(args.experiment, seed, args) for seed in range(args.replicates)]
    compare(methods, tasks, run, args.out / f"minitaur-{args.experiment}.csv", args)
    show(args.out, f"minitaur-{args.experiment}")


if __name__ == "__main__":
    launch(main, Args)
