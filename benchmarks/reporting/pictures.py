"""The pictures of the report."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from benchmarks.reporting.looks import in_order, look
from benchmarks.reporting.statistics import Array, interquartile_mean
from benchmarks.reporting.study import Study, quartiles_over_steps
from famle_agent.app.plots import style

__all__ = ["draw", "draw_paths", "draw_times"]

_PAPER: Mapping[str, Any] = {"marker": "D", "color": "0.35", "capsize": 3}
"""How the paper's own figures are drawn."""


def draw(studies: Sequence[Study]) -> Figure:
    """The picture of one experiment, or of several on gaits side by side."""
    kind = studies[0].experiment.kind
    if kind == "gaits":
        return _draw_gaits(studies)
    return _draw_curves(studies[0]) if kind == "curves" else _draw_points(studies[0])


def draw_times(studies: Sequence[Study]) -> Figure:
    """What a method gets, against the time of its control step: a panel an experiment."""
    columns = min(2, len(studies))
    rows = -(-len(studies) // columns)
    figure = Figure(figsize=(5.6 * columns, 3.6 * rows + 1.2), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes, study in zip(panels, studies, strict=False):
        _times(axes, study)
    for axes in panels[len(studies) :]:
        axes.set_visible(False)
    _legend(figure, 2 * columns)
    return figure


def _times(axes: Axes, study: Study) -> None:
    measure, times = study.measures[0], study.times
    for method, milliseconds in times.items():
        mean, error = _mean_and_error(study.scores(method, measure))
        axes.errorbar(milliseconds, mean, yerr=error, fmt="o", color=look(method).colour, label=look(method).label)
    axes.set_xscale("log")
    if times:
        axes.set_xlim(min(times.values()) / 2, 2 * max(times.values()))
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    style(axes, "time per control step (ms)", measure.label, _wrapped(study.experiment.title, 50))


def draw_paths(study: Study) -> Figure:
    """The ways of all replicates from above, a panel a method, and where they were to get to."""
    columns = min(3, len(study.runs))
    rows = -(-len(study.runs) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.0 * rows + 0.8), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).flatten()
    for axes, (method, runs) in zip(panels, study.runs.items(), strict=False):
        for run in runs:
            x, y = np.array(run["path"]).T
            axes.plot(x, y, marker=".", markersize=3, linewidth=1, alpha=0.5, color=look(method).colour)
        if study.experiment.goal is not None:
            axes.plot(*study.experiment.goal, marker="*", markersize=12, color="0.3", linestyle="none")
        axes.set_aspect("equal", adjustable="box")
        style(axes, "", "", f"{look(method).label} (n = {len(runs)})")
        axes.title.set(fontsize="small", color=look(method).colour)
    for axes in panels[len(study.runs) :]:
        axes.set_visible(False)
    figure.supxlabel("x (m)")
    figure.supylabel("y (m)")
    figure.suptitle(_wrapped(study.experiment.title, 60), fontsize="medium")
    return figure


# --- learning curves --------------------------------------------------------------------------------------------------


def _draw_curves(study: Study) -> Figure:
    """The paper's figures 3 and 4, and where some learn for longer than others a second panel with all their steps."""
    longest = max(sum(run["lengths"]) for runs in study.runs.values() for run in runs)
    panels = 2 if longest > 2 * study.steps else 1
    figure = Figure(figsize=(5.6 * panels + 1.4, 5.6), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, panels, sharey=True, squeeze=False).flat):
        _curves(axes, study, study.steps if i == 0 else longest, label=i == 0)
    if panels == 2:
        figure.axes[1].set_xscale("log")
        figure.axes[1].set(title="all robot steps", ylabel="")
    figure.suptitle(_wrapped(study.title, 60 * panels))
    _legend(figure, 2 * panels)
    return figure


def _curves(axes: Axes, study: Study, steps: float, label: bool) -> None:
    for method, runs in study.runs.items():
        x, (low, median, high) = quartiles_over_steps([study.trace(run) for run in runs])
        shown, drawn = x <= steps, look(method)
        name = f"{drawn.label} (n = {len(runs)})" if label else None
        axes.plot(x[shown], median[shown], color=drawn.colour, linestyle=drawn.line, label=name)
        axes.fill_between(x[shown], low[shown], high[shown], color=drawn.colour, alpha=0.15, linewidth=0)
    solved = "solved" if label else None
    axes.axhline(study.experiment.threshold, color="0.4", linestyle="--", linewidth=1, label=solved)
    style(axes, "robot steps since the damage", "return per episode", f"the first {study.steps:,} robot steps")


# --- gaits to a goal --------------------------------------------------------------------------------------------------


def _draw_gaits(studies: Sequence[Study]) -> Figure:
    """Boxes of the gaits to the goal, a panel a situation and a row a method; below them what the paper has."""
    methods = in_order({method for study in studies for method in study.runs})
    paper = {row.method: None for study in studies for row in study.experiment.paper if row.steps is not None}
    rows = {name: i for i, name in enumerate([*methods, *(f"the paper's {name}" for name in paper)])}
    figure = Figure(figsize=(3.0 + 4.0 * len(studies), 1.8 + 0.38 * len(rows)), layout="constrained")
    for axes, study in zip(figure.subplots(1, len(studies), sharey=True, squeeze=False).flat, studies, strict=True):
        _boxes(axes, study, rows)
        style(axes, "gaits to the goal", "", _wrapped(study.title, 44))
        axes.title.set_fontsize("medium")
    figure.axes[0].set_yticks(list(rows.values()), [look(name).label for name in rows])
    _colour_labels(figure.axes[0], methods)
    figure.axes[0].set_ylim(len(rows) - 0.4, -0.6)
    return figure


def _boxes(axes: Axes, study: Study, rows: Mapping[str, int]) -> None:
    """One panel; runs that do not reach the goal stand at the limit, as a cross with their number."""
    limit = study.experiment.budget
    for method, runs in study.runs.items():
        colour = look(method).colour
        line = {"color": colour}
        axes.boxplot(
            [run["gaits"] if run["reached"] else limit for run in runs],
            positions=[rows[method]],
            orientation="horizontal",
            widths=0.6,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": colour, "alpha": 0.45},
            medianprops=line | {"linewidth": 2.5},
            whiskerprops=line,
            capprops=line,
            flierprops={"markeredgecolor": colour, "markersize": 4},
        )
        if failed := sum(not run["reached"] for run in runs):
            axes.plot(limit, rows[method], marker="x", markersize=8, color=colour)
            axes.annotate(f"{failed} of {len(runs)} fail", (limit + 2, rows[method]), va="center", fontsize="x-small")
    for row in study.experiment.paper:
        if row.steps is not None:
            axes.errorbar(row.steps[0], rows[f"the paper's {row.method}"], xerr=row.steps[1], **_PAPER)
    axes.set_xlim(0, 1.25 * limit)


# --- one figure a method ----------------------------------------------------------------------------------------------


def _draw_points(study: Study) -> Figure:
    """What each replicate gets, and of episodes the speed on the way too."""
    rows = len(study.runs) + sum(row.distance is not None for row in study.experiment.paper)
    speeds = study.experiment.kind == "episode"
    figure = Figure(figsize=(14.0 if speeds else 7.6, max(1.6 + 0.36 * rows, 4.6 * speeds)), layout="constrained")
    panels = figure.subplots(1, 1 + speeds, squeeze=False).flatten()
    _points(panels[0], study)
    if speeds:
        _speeds(panels[1], study)
    figure.suptitle(_wrapped(study.title, 150 if speeds else 80), fontsize="medium")
    return figure


def _points(axes: Axes, study: Study) -> None:
    """Interquartile means with 95 % intervals, every replicate behind them, and the paper's figures as diamonds."""
    measure = study.measures[0]
    published = [(row.method, row.distance) for row in study.experiment.paper if row.distance is not None]
    names = [f"{look(method).label} (n = {len(runs)})" for method, runs in study.runs.items()]
    names += [f"the paper's {name}, its robot" for name, _ in published]
    for i, method in enumerate(study.runs):
        scores, colour = study.scores(method, measure), look(method).colour
        mean, error = _mean_and_error(scores)
        axes.plot(scores, np.full(len(scores), i), marker="o", color=colour, alpha=0.25, linestyle="none")
        axes.errorbar(mean, i, xerr=error, color=colour, marker="|", markersize=16, linewidth=2, markeredgewidth=2)
    for i, (_, distance) in enumerate(published, start=len(study.runs)):
        axes.errorbar(distance, i, **_PAPER)
    if np.isfinite(study.experiment.threshold):
        axes.axvline(study.experiment.threshold, color="0.4", linestyle="--", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    _colour_labels(axes, list(study.runs))
    axes.set_ylim(len(names) - 0.4, -0.6)
    style(axes, f"{measure.label}\nof each replicate; interquartile mean, 95 % interval", "")


def _speeds(axes: Axes, study: Study) -> None:
    """Median speed and quartiles over an episode, with the moment of the damage if it strikes on the way."""
    for method, runs in study.runs.items():
        x, (low, median, high) = quartiles_over_steps([study.trace(run) for run in runs])
        drawn = look(method)
        axes.plot(x, median, color=drawn.colour, linestyle=drawn.line)
        axes.fill_between(x, low, high, color=drawn.colour, alpha=0.15, linewidth=0)
    for breaks in study.breaks:
        axes.axvline(breaks, color="0.4", linestyle=":", linewidth=1)
    style(axes, "robot steps", "forward speed (m/s), median and quartiles")


def _colour_labels(axes: Axes, methods: Sequence[str]) -> None:
    """Gives the first labels of the y axis the colours of the methods, which other panels are read by."""
    for label, method in zip(axes.get_yticklabels(), methods, strict=False):
        label.set_color(look(method).colour)


def _mean_and_error(scores: Array) -> tuple[float, Array]:
    """The interquartile mean, and how far its interval reaches to both sides, (2, 1); not at all where it has none."""
    mean, interval = interquartile_mean(scores)
    low, high = interval or (mean, mean)
    return mean, np.maximum(0.0, [[mean - low], [high - mean]])


def _legend(figure: Figure, columns: int) -> None:
    """One legend for all panels, below them."""
    entries = {
        label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, fontsize="small")


def _wrapped(text: str, width: int) -> str:
    return "\n".join(textwrap.wrap(text, width))
