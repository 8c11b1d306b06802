"""The pictures of the report."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.reporting.registry import in_order, style_of
from benchmarks.reporting.statistics import interquartile_mean
from benchmarks.reporting.study import Study, over_steps
from famle_agent.app.plots import style

_PAPER: Mapping[str, Any] = {"marker": "D", "color": "0.35", "capsize": 3}
"""How the paper's own figures are drawn."""

_DASHES = {"-": "", "--": (5, 3), "-.": (6, 2, 1, 2), ":": (1, 2)}


def draw(studies: Sequence[Study]) -> Figure:
    """Draws the picture of one experiment, or of several on gaits side by side."""
    kind = studies[0].experiment.kind
    if kind == "gaits":
        return _draw_gaits(studies)
    return _draw_curves(studies[0]) if kind == "curves" else _draw_points(studies[0])


def draw_times(studies: Sequence[Study]) -> Figure:
    """Draws what a method gets, against the time of its control step: a panel an experiment."""
    figure, panels = _panels(len(studies), min(2, len(studies)), (5.6, 3.6))
    for axes, study in zip(panels, studies, strict=True):
        measure = study.measures[0]
        for method, milliseconds in study.times.items():
            mean, (low, high) = _mean(scores := study.of(method)[measure.key]), _bounds(scores)
            colour, label = style_of(method).colour, style_of(method).label
            axes.plot([milliseconds] * 3, [low, mean, high], marker="o", markevery=[1], color=colour, label=label)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        style(axes, "time per control step (ms)", measure.label, _wrapped(study.experiment.title, 50))
    _legend(figure, 2 * min(2, len(studies)))
    return figure


def draw_paths(study: Study) -> Figure:
    """Draws the paths of all replicates from above, a panel a method, and where they were to get to."""
    figure, panels = _panels(len(study.methods), min(3, len(study.methods)), (3.4, 2.0), sharex=True, sharey=True)
    for axes, (method, n) in zip(panels, study.methods.items(), strict=True):
        drawn = style_of(method)
        for path in study.runs["path"][study.runs["method"] == method]:
            axes.plot(*np.transpose(path), marker=".", markersize=3, linewidth=1, alpha=0.5, color=drawn.colour)
        if study.experiment.goal is not None:
            axes.plot(*study.experiment.goal, marker="*", markersize=12, color="0.3", linestyle="none")
        axes.set_aspect("equal", adjustable="box")
        style(axes, "", "", f"{drawn.label} (n = {n})")
        axes.title.set(fontsize="small", color=drawn.colour)
    figure.supxlabel("x (m)")
    figure.supylabel("y (m)")
    figure.suptitle(_wrapped(study.experiment.title, 60), fontsize="medium")
    return figure


def draw_scores(tables: Mapping[str, tuple[pd.DataFrame, str]]) -> Figure:
    """Draws what each replicate gets, a panel a table.

    Args:
        tables: By title, a table with a row a replicate and a column a method, and what its figures are.
    """
    figure, panels = _panels(len(tables), min(2, len(tables)), (5.0, 1.9))
    for axes, (title, (scores, label)) in zip(panels, tables.items(), strict=True):
        names = {method: style_of(str(method)).label for method in scores}
        palette = {name: style_of(str(method)).colour for method, name in names.items()}
        data = scores.rename(columns=names).melt(var_name="method", value_name="score")
        shared: dict[str, Any] = {"data": data, "x": "score", "y": "method", "hue": "method", "palette": palette}
        sns.stripplot(**shared, jitter=False, size=5, alpha=0.3, legend=False, ax=axes)
        sns.pointplot(
            **shared, estimator=_mean, errorbar=_bounds, markers="|", markersize=12, linestyle="none", ax=axes
        )
        style(axes, label, "", title)
    return figure


# --- learning curves --------------------------------------------------------------------------------------------------


def _draw_curves(study: Study) -> Figure:
    """Draws the paper's figures 3 and 4, and where some have many more steps a second panel with all of them."""
    longest = int(study.runs["lengths"].map(sum).max())
    panels = 2 if longest > 2 * study.steps else 1
    figure = Figure(figsize=(5.6 * panels + 1.4, 5.6), layout="constrained")
    for i, axes in enumerate(figure.subplots(1, panels, sharey=True, squeeze=False)[0]):
        steps = longest if i else study.steps
        _lines(axes, study, steps)
        axes.axhline(study.experiment.threshold, color="0.4", linestyle="--", linewidth=1, label="solved")
        style(axes, "robot steps since the damage", "return per episode", f"the first {steps:,} robot steps")
    if panels == 2:
        figure.axes[1].set_xscale("log")
        figure.axes[1].set(title="all robot steps", ylabel="")
    figure.suptitle(_wrapped(study.title, 60 * panels))
    _legend(figure, 1 + panels)
    return figure


def _lines(axes: Axes, study: Study, steps: float = np.inf) -> None:
    """Draws the medians over robot steps, and the quartiles around them."""
    traces = {f"{style_of(m).label} (n = {n})": over_steps(study.traces(m)) for m, n in study.methods.items()}
    styles = dict(zip(traces, map(style_of, study.methods), strict=True))
    data = pd.concat(traces, names=["method", "steps"]).melt(ignore_index=False).reset_index()
    sns.lineplot(
        data[data["steps"] <= steps],
        x="steps",
        y="value",
        hue="method",
        style="method",
        palette={label: drawn.colour for label, drawn in styles.items()},
        dashes={label: _DASHES[drawn.line] for label, drawn in styles.items()},
        estimator="median",
        errorbar=("pi", 50),
        err_kws={"alpha": 0.15, "linewidth": 0},
        ax=axes,
    )
    if legend := axes.get_legend():
        legend.remove()  # the figure has one for all panels


# --- gaits to a goal --------------------------------------------------------------------------------------------------


def _draw_gaits(studies: Sequence[Study]) -> Figure:
    """Draws boxes of the gaits to the goal, a panel a situation and a row a method; below them what the paper has."""
    methods = in_order({method for study in studies for method in study.methods})
    paper = {row.method: None for study in studies for row in study.experiment.paper if row.gaits is not None}
    rows = [*(style_of(method).label for method in methods), *(f"the paper's {name}" for name in paper)]
    figure = Figure(figsize=(3.0 + 4.0 * len(studies), 1.8 + 0.38 * len(rows)), layout="constrained")
    for axes, study in zip(figure.subplots(1, len(studies), sharey=True, squeeze=False).flat, studies, strict=True):
        _boxes(axes, study, rows)
        style(axes, "gaits to the goal", "", _wrapped(study.title, 44))
        axes.title.set_fontsize("medium")
    _colour_labels(figure.axes[0], methods)
    return figure


def _boxes(axes: Axes, study: Study, rows: Sequence[str]) -> None:
    """Draws one panel; runs that do not reach the goal stand at the limit, as a cross with their number."""
    limit = study.experiment.budget
    labels = {method: style_of(method).label for method in study.methods}
    sns.boxplot(
        x=study.scores["gaits"].clip(upper=limit),
        y=study.scores["method"].map(labels),
        order=rows,
        hue=study.scores["method"].map(labels),
        palette={label: style_of(method).colour for method, label in labels.items()},
        boxprops={"alpha": 0.6},
        width=0.6,
        linewidth=1.2,
        legend=False,
        ax=axes,
    )
    for method, label in labels.items():
        reached = study.of(method)["reached"]
        if failed := int((~reached.astype(bool)).sum()):
            axes.plot(limit, rows.index(label), marker="x", markersize=8, color=style_of(method).colour)
            text = f"{failed} of {len(reached)} fail"
            axes.annotate(text, (limit + 2, rows.index(label)), va="center", fontsize="x-small")
    for row in study.experiment.paper:
        if row.gaits is not None:
            axes.errorbar(row.gaits[0], rows.index(f"the paper's {row.method}"), xerr=row.gaits[1], **_PAPER)
    axes.set_xlim(0, 1.25 * limit)


# --- one figure a method ----------------------------------------------------------------------------------------------


def _draw_points(study: Study) -> Figure:
    """Draws what each replicate gets, and of episodes the speed on the way too."""
    rows = len(study.methods) + sum(row.distance is not None for row in study.experiment.paper)
    speeds = study.experiment.kind == "episode"
    figure = Figure(figsize=(14.0 if speeds else 7.6, max(1.6 + 0.36 * rows, 4.6 * speeds)), layout="constrained")
    panels = figure.subplots(1, 1 + speeds, squeeze=False).flatten()
    _points(panels[0], study)
    if speeds:
        _lines(panels[1], study)
        for breaks in study.breaks:
            panels[1].axvline(breaks, color="0.4", linestyle=":", linewidth=1)
        style(panels[1], "robot steps", "forward speed (m/s), median and quartiles")
    figure.suptitle(_wrapped(study.title, 150 if speeds else 80), fontsize="medium")
    return figure


def _points(axes: Axes, study: Study) -> None:
    """Draws interquartile means with 95 % intervals, every replicate behind them, and the paper's figures."""
    measure = study.measures[0]
    published = [(row.method, row.distance) for row in study.experiment.paper if row.distance is not None]
    names = {method: f"{style_of(method).label} (n = {n})" for method, n in study.methods.items()}
    shared: dict[str, Any] = {
        "x": study.scores[measure.key],
        "y": study.scores["method"].map(names),
        "hue": study.scores["method"].map(names),
        "palette": {name: style_of(method).colour for method, name in names.items()},
        "order": [*names.values(), *(f"the paper's {name}, its robot" for name, _ in published)],
        "legend": False,
        "ax": axes,
    }
    sns.stripplot(**shared, jitter=False, size=6, alpha=0.25)
    sns.pointplot(**shared, estimator=_mean, errorbar=_bounds, markers="|", markersize=16, linestyle="none")
    for i, (_, distance) in enumerate(published, start=len(names)):
        axes.errorbar(distance, i, **_PAPER)
    if np.isfinite(study.experiment.threshold):
        axes.axvline(study.experiment.threshold, color="0.4", linestyle="--", linewidth=1)
    _colour_labels(axes, list(study.methods))
    style(axes, f"{measure.label}\nof each replicate; interquartile mean, 95 % interval", "")


def _mean(scores: Any) -> float:
    return interquartile_mean(scores)[0]


def _bounds(scores: Any) -> tuple[float, float]:
    """Returns the interval of the interquartile mean; of no width where there are too few replicates for one."""
    mean, low, high = interquartile_mean(scores)
    return (mean, mean) if np.isnan(low) else (low, high)


# --- what pictures share ----------------------------------------------------------------------------------------------


def _panels(n: int, columns: int, size: tuple[float, float], **shared: Any) -> tuple[Figure, list[Axes]]:
    """Makes a figure of n panels."""
    rows = -(-n // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows + 1.0), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, **shared).flatten()
    for axes in panels[n:]:
        axes.set_visible(False)
    return figure, list(panels[:n])


def _colour_labels(axes: Axes, methods: Sequence[str]) -> None:
    """Gives the first labels of the y axis the colours of the methods, which other panels are read by."""
    for label, method in zip(axes.get_yticklabels(), methods, strict=False):
        label.set_color(style_of(method).colour)


def _legend(figure: Figure, columns: int) -> None:
    """Draws one legend for all panels, below them."""
    entries = {
        label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, fontsize="x-small")


def _wrapped(text: str, width: int) -> str:
    return "\n".join(textwrap.wrap(text, width))
