"""Results as benchmarks store them, without running any, and what the report makes of them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import results as tables
from benchmarks.reporting.report import Report


def store(results: Path, experiment: str, method: str, seed: int, **figures: Any) -> None:
    """Stores a replicate as a benchmark does."""
    source = {"command": f"python -m benchmarks.x --methods {method}", "commit": "abc1234"}
    tables.store(results / f"{experiment}.csv", [{"method": method, "seed": seed, **source, **figures}])


def store_curves(
    results: Path, method: str, returns: Sequence[Sequence[float]], experiment: str = "reacher-paper", **more: Any
) -> None:
    """Stores learning curves in episodes of 50 steps, one a seed."""
    for seed, values in enumerate(returns):
        curve = {"returns": list(values), "lengths": [50] * len(values), "seconds_per_step": 0.02}
        store(results, experiment, method, seed, **curve, **more)


def store_gaits(results: Path, method: str, gaits: Sequence[int | None], experiment: str = "quadruped-yaw") -> None:
    """Stores journeys to a goal, one a seed; None is one that did not get there."""
    for seed, n in enumerate(gaits):
        path = [[0.1 * i, 0.0] for i in range((n or 80) + 1)]
        reached = {"reached": n is not None, "fell": False, "distance": path[-1][0]}
        store(results, experiment, method, seed, gaits=n or 80, path=path, ms_per_plan=5.0, **reached)


def store_walks(results: Path, method: str, ways: Sequence[Sequence[float]]) -> None:
    """Stores walks by their x, one a seed."""
    for seed, xs in enumerate(ways):
        figures = {"gaits": len(xs) - 1, "distance": xs[-1], "path": [[x, 0.0] for x in xs], "fell": False}
        store(results, "minitaur-held-out", method, seed, ms_per_plan=5.0, **figures)


def store_runs(results: Path, method: str, returns: Sequence[float], experiment: str = "ant-unseen") -> None:
    """Stores first episodes with the same damage, one a seed."""
    for seed, value in enumerate(returns):
        store_run(results, method, seed, value, experiment)


def store_run(
    results: Path, method: str, seed: int, value: float, experiment: str = "ant-unseen", **figures: Any
) -> None:
    """Stores one first episode."""
    milliseconds = {"mean": 13.0, "median": 12.0, "p99": 15.0}
    figures |= {"return": value, "speed": [value / 1000] * 20, "ms_per_step": milliseconds}
    store(results, experiment, method, seed, **figures)


def report(results: Path) -> tuple[str, Path]:
    """The report of some results, and its folder."""
    out = results.parent / "report"
    Report(results, out)()
    return (out / "report.md").read_text(), out


def by_name(path: Path) -> dict[str, dict[str, str]]:
    """The rows of a table of figures by method."""
    with path.open() as file:
        return {row["method"]: row for row in csv.DictReader(file)}


def rows_of(text: str, label: str) -> list[list[str]]:
    """The cells of all table rows of experiments that begin with a label."""
    experiments = text.partition("## All robots")[2].partition("\n## ")[2]
    lines = [line for line in experiments.splitlines() if line.startswith(f"| {label} |")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
