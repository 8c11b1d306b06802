"""The quadruped in its reality: the paper's table I.

python -m benchmarks.quadruped                                     # yaw error, blocked leg, both, yaw error on the way
python -m benchmarks.quadruped --experiments gap-home gap-reality  # what one simulator alone teaches, there and outside

Replicates share the shipped model, and the other agents theirs; each has its own seed of the robot and the planner, and
legs take turns.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.compare import compare
from benchmarks.gait_robots import run
from benchmarks.harness import Options, Result, load_results
from benchmarks.methods import Task
from benchmarks.summaries import by_method
from famle_agent.plots import plot_paths
from famle_envs import Situation
from famle_envs.quadruped import LEGS, REALITY, blocked_leg

YAW = math.radians(30)
PAPER = {"yaw": "32.6 +- 2.3", "leg": "43.1 +- 6.4", "both": "41.6 +- 7.7"}
RIVALS = ("ampc", "ampc-reptile", "ampc-fomaml", "ampc-maml")
PARTS = ("famle", "famle-frozen", "famle-nearest", "famle-likeliest")
DEFAULT_METHODS = {
    "later": (*PARTS, *RIVALS),
    "gap-home": ("one-simulator", "famle"),
    "gap-reality": ("one-simulator", "famle"),
}


@dataclass(frozen=True)
class Args(Options):
    """The quadruped in its reality: the paper's table I."""

    experiments: tuple[str, ...] = ("yaw", "leg", "both", "later")
    """Some of yaw, leg, both, later, and gap-home, gap-reality for the intact robot in both."""
    replicates: int = 12
    """Seeds 0, 1, ..."""


def task_of(experiment: str, seed: int, args: Args) -> Task:
    """The test robot of a replicate."""
    leg = blocked_leg(seed % len(LEGS))
    wrong = {
        "yaw": Situation(orientation_error=YAW),
        "leg": Situation(locked_joints=leg.locked_joints),
        "both": Situation(locked_joints=leg.locked_joints, orientation_error=YAW),
    }
    profile = "simulator" if experiment == "gap-home" else REALITY.name
    task = Task("quadruped", seed, wrong.get(experiment, Situation()), args.cache, profile)
    return replace(task, later=wrong["yaw"], strikes_at=5) if experiment == "later" else task


def summary(results: list[Result], experiment: str) -> Table:
    """One row a method, as the paper's table I; a run without success counts as 80 gaits in the median."""
    title = f"Quadruped, {experiment}" + (f" (paper: {PAPER[experiment]}, 100 %)" if experiment in PAPER else "")
    table = Table("method", "n", "success", "gaits, mean +- deviation", "median", "ms a plan", title=title)
    for method, runs in by_method(results).items():
        gaits = np.array([run["gaits"] for run in runs if run["reached"]])
        table.add_row(
            method,
            str(len(runs)),
            f"{len(gaits) / len(runs):.0%}",
            f"{gaits.mean():.1f} +- {gaits.std():.1f}" if len(gaits) else "-",
            f"{np.median([run['gaits'] for run in runs]):.0f}",
            f"{np.median([run['ms_per_plan'] for run in runs]):.0f}",
        )
    return table


def main(args: Args) -> None:
    """Runs and reports."""
    for experiment in args.experiments:
        methods = args.methods or DEFAULT_METHODS.get(experiment, (*PARTS, *RIVALS, "oracle"))
        folder = args.out / f"quadruped-{experiment}"
        compare(methods, [task_of(experiment, seed, args) for seed in range(args.replicates)], run, folder, args)
        results = load_results(folder)
        Console(width=120).print(summary(results, experiment))
        first = {result["method"]: np.array(result["path"]) for result in results if result["seed"] == 0}
        plot_paths(first, f"Quadruped, {experiment}, replicate 0", args.out / f"quadruped-{experiment}.png", (2.5, 0.0))


if __name__ == "__main__":
    main(tyro.cli(Args))
