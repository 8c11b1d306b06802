"""The Minitaur in its reality: the paper's table II.

python -m benchmarks.minitaur                     # 60 gaits outside the simulator
python -m benchmarks.minitaur --experiment home   # the same in the default simulator

Replicates share the shipped model, and the other agents theirs; each has its own seed of the robot and the planner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.compare import compare
from benchmarks.gait_robots import run
from benchmarks.harness import Options, Result, load_results
from benchmarks.methods import Task
from benchmarks.summaries import by_method, quartiles
from famle_agent.plots import plot_paths
from famle_envs import Situation
from famle_envs.minitaur import REALITY

RIVALS = ("ampc", "ampc-reptile", "ampc-fomaml", "ampc-maml")
DEFAULT_METHODS = {
    "reality": ("famle", "famle-frozen", "famle-nearest", "famle-likeliest", *RIVALS, "one-simulator", "oracle"),
    "home": ("famle", "one-simulator"),
}


@dataclass(frozen=True)
class Args(Options):
    """The Minitaur in its reality: the paper's table II."""

    experiment: Literal["reality", "home"] = "reality"
    """Where the robot walks."""


def task_of(experiment: str, seed: int, args: Args) -> Task:
    """The test robot of a replicate; intact, but for its profile."""
    profile = "simulator" if experiment == "home" else REALITY.name
    return Task("minitaur", seed, Situation(), args.cache, profile)


def summary(results: list[Result], experiment: str) -> Table:
    """One row a method, as the paper's table II."""
    title = f"Minitaur, {experiment} (paper, real robot: 4.8 m in 60 s)"
    table = Table("method", "n", "distance (m), median (quartiles)", "fell", "gaits", "ms a plan", title=title)
    for method, runs in by_method(results).items():
        low, median, high = quartiles([run["distance"] for run in runs])
        table.add_row(
            method,
            str(len(runs)),
            f"{median:.2f} ({low:.2f}-{high:.2f})",
            f"{sum(run['fell'] for run in runs)}/{len(runs)}",
            f"{np.median([run['gaits'] for run in runs]):.0f}",
            f"{np.median([run['ms_per_plan'] for run in runs]):.0f}",
        )
    return table


def main(args: Args) -> None:
    """Runs and reports."""
    folder = args.out / f"minitaur-{args.experiment}"
    methods = args.methods or DEFAULT_METHODS[args.experiment]
    compare(methods, [task_of(args.experiment, seed, args) for seed in range(args.replicates)], run, folder, args)
    results = load_results(folder)
    Console(width=120).print(summary(results, args.experiment))
    first = {result["method"]: np.array(result["path"]) for result in results if result["seed"] == 0}
    title = f"Minitaur, {args.experiment}, replicate 0"
    plot_paths(first, title, args.out / f"minitaur-{args.experiment}.png")


if __name__ == "__main__":
    main(tyro.cli(Args))
