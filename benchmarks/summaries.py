"""From stored results to tables and pictures, as the protocol wants them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from benchmarks.harness import Result
from benchmarks.statistics import first_crossing, interquartile_mean, median_steps, quartiles, solved_at
from famle_agent.plots import style

__all__ = ["by_method", "first_crossing", "interquartile_mean", "plot_curves", "quartiles", "solved_at", "summary"]


def by_method(results: Sequence[Result]) -> Mapping[str, list[Result]]:
    """The results by method."""
    methods: dict[str, list[Result]] = {}
    for result in results:
        methods.setdefault(result["method"], []).append(result)
    return methods


def summary(results: Sequence[Result], threshold: float, title: str, within: int) -> Table:
    """One row a method: first episodes, solved-at, the fraction solved in time, time per step."""
    columns = ("method", "n", "1st episode", "IQM [95 %]", "2nd episode", "last", "solved at", "1st crossing")
    table = Table(*columns, f"solved <= {within}", "ms / step", title=title)
    for method, runs in by_method(results).items():
        first, second, last = ([run["returns"][i] for run in runs] for i in (0, 1, -1))
        solved = [solved_at(run["returns"], run["lengths"], threshold) for run in runs]
        crossed = [first_crossing(run["returns"], run["lengths"], threshold) for run in runs]
        table.add_row(
            method,
            str(len(runs)),
            _spread(first),
            "{:.1f} [{:.1f}, {:.1f}]".format(*interquartile_mean(first)),
            _spread(second),
            _spread(last),
            _median_steps(solved),
            _median_steps(crossed),
            f"{sum(step is not None and step <= within for step in solved)}/{len(runs)}",
            f"{1000 * float(np.median([run['seconds_per_step'] for run in runs])):.0f}",
        )
    return table


def plot_curves(results: Sequence[Result], threshold: float, title: str, path: Path, steps: int) -> None:
    """The paper's figure 3: median return and quartiles over the robot's steps, a colour a method."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for method, runs in by_method(results).items():
        length = min(len(run["returns"]) for run in runs)
        x = np.median([np.cumsum(run["lengths"][:length]) for run in runs], axis=0)
        low, median, high = quartiles([run["returns"][:length] for run in runs])
        shown = x <= steps
        (line,) = axes.plot(x[shown], median[shown], label=f"{method} (n = {len(runs)})")
        axes.fill_between(x[shown], low[shown], high[shown], color=line.get_color(), alpha=0.2, linewidth=0)
    axes.axhline(threshold, color="0.4", linestyle="--", linewidth=1, label="solved")
    style(axes, "robot steps since the damage", "return per episode", title)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=150)


def _spread(values: Sequence[float]) -> str:
    low, median, high = quartiles(values)
    return f"{median:.1f} ({low:.1f}-{high:.1f})"


def _median_steps(steps: Sequence[int | None]) -> str:
    median = median_steps(steps)
    return f"{median:.0f}" if np.isfinite(median) else "never"
