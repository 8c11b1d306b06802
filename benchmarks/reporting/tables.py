"""Every figure of a study, for machines: one row a method, and one row a replicate."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.harness import Result
from benchmarks.reporting.looks import look
from benchmarks.reporting.registry import Kind
from benchmarks.reporting.statistics import (
    Array,
    Interval,
    first_crossing,
    interquartile_mean,
    median_steps,
    p_value,
    probability_of_improvement,
    quartiles,
    solved_at,
)
from benchmarks.reporting.study import LAST, SUBJECT, Measure, Study, diverged_often

__all__ = ["Row", "figures", "replicates", "to_csv"]

Row = dict[str, Any]
"""A row of a table by the names of its columns; None where there is nothing to say."""


def figures(study: Study) -> list[Row]:
    """Every figure of every method, then the paper's methods that no measured one stands beside."""
    rows = []
    for method, runs in study.runs.items():
        row: Row = {"method": method, "label": look(method).label, "replicates": len(runs)}
        measures = [measure for measure in study.measures if study.has(method, measure)]
        for measure in measures:
            row |= _spread(study, method, measure)
        row |= _KINDS[study.experiment.kind](study, method)
        row |= _times(study, method)
        for measure in measures:
            row |= _improvement(study, method, measure)
        rows.append(row | _diverged(runs) | _published(study, look(method).paper))
    _correct_for_many(rows)
    shown = {look(method).paper for method in study.runs}
    for published in study.experiment.paper:
        if published.method not in shown:
            row = {"method": published.method, "label": f"{published.method}, in the paper alone", "replicates": 0}
            rows.append(row | _published(study, published.method))
    return rows


def replicates(study: Study) -> list[Row]:
    """One row a replicate, of learning curves one row an episode."""
    rows = []
    for method, runs in study.runs.items():
        for run in runs:
            row: Row = {"experiment": study.experiment.folder, "method": method, "seed": run["seed"]}
            row["situation"] = run.get("situation")
            if study.experiment.kind == "curves":
                ends = np.cumsum(run["lengths"])
                for i, value in enumerate(run["returns"]):
                    rows.append(row | {"episode": i + 1, "robot_steps": int(ends[i]), "return": value})
            else:
                keys = ("return", "gaits", "reached", "fell", "distance", "adaptations", "diverged")
                rows.append(row | {key: run[key] for key in keys if key in run})
    return rows


def to_csv(rows: Sequence[Row]) -> str:
    """Rows as comma-separated values, with a column for each name that is in any of them."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: round(value, 4) if isinstance(value, float) else value for name, value in row.items()} for row in rows
    )
    return text.getvalue()


def _spread(study: Study, method: str, measure: Measure) -> Row:
    """Median, quartiles and interquartile mean of a figure, and how much of the oracle's it is."""
    scores = study.scores(method, measure)
    low, median, high = quartiles(scores)
    mean, interval = interquartile_mean(scores)
    row = {"median": median, "low": low, "high": high, "iqm": mean} | _interval("iqm", interval)
    if pair := study.shared(method, "oracle", measure):
        ours, oracle = (interquartile_mean(values)[0] for values in pair)
        over, under = (ours, oracle) if measure.higher_is_better else (oracle, ours)
        row |= {"of_oracle": over / under if under > 0 else None, "oracle_seeds": len(pair[0])}
    return {f"{measure.key}_{name}": value for name, value in row.items()}


def _interval(name: str, interval: Interval) -> Row:
    return {} if interval is None else {f"{name}_low": interval[0], f"{name}_high": interval[1]}


def _diverged(runs: Sequence[Result]) -> Row:
    """The share of adaptations that diverged, and the replicates in which more than one in ten did."""
    counted = [run for run in runs if run.get("adaptations")]
    if not counted:
        return {}
    total = sum(run["adaptations"] for run in counted)
    return {
        "diverged": sum(run["diverged"] for run in counted) / total,
        "diverged_replicates": sum(map(diverged_often, counted)),
    }


def _correct_for_many(rows: Sequence[Row]) -> None:
    """Adjusts the p-values of an experiment for their number (Benjamini and Hochberg), in place."""
    places = [(row, key) for row in rows for key in row if key.endswith("_famle_better_p")]
    if places:
        for (row, key), p in zip(places, stats.false_discovery_control([row[key] for row, key in places]), strict=True):
            row[key] = float(p)


def _times(study: Study, method: str) -> Row:
    """A control step: of the replicates themselves, and in one run with the other methods."""
    row: Row = {"ms": study.own_time(method)}
    if (together := study.step_times.get(method)) is not None:
        row |= {"step_ms": together.milliseconds, "times_robot_alone": together.times_robot_alone}
    return row


def _improvement(study: Study, method: str, measure: Measure) -> Row:
    """The probability that a replicate of FAMLE is better than one of another method."""
    if method == SUBJECT or SUBJECT not in study.runs or not study.has(SUBJECT, measure):
        return {}
    if study.paired:
        groups = study.shared(SUBJECT, method, measure)
    else:
        groups = study.scores(SUBJECT, measure), study.scores(method, measure)
    if groups is None:
        return {}
    ours, theirs = groups if measure.higher_is_better else (-groups[0], -groups[1])
    probability, interval = probability_of_improvement(ours, theirs, study.paired)
    name = f"{measure.key}_famle_better"
    row: Row = {name: probability, f"{name}_seeds": len(theirs)} | _interval(name, interval)
    return row if interval is None else row | {f"{name}_p": p_value(ours, theirs, study.paired)}


def _curves(study: Study, method: str) -> Row:
    threshold, runs = study.experiment.threshold, study.runs[method]
    solved = _solved_at(runs, threshold)
    early = [_within(run, study.steps) for run in runs]
    second = [run["returns"][1] for run in runs if len(run["returns"]) > 1]
    row: Row = {
        "second_episode_median": np.median(second) if second else None,
        "robot_steps": study.lived[method],
        "solved": sum(step is not None for step in solved),
        "solved_at": median_steps(solved),
        "famle_faster_by": _famle_faster_by(study, runs),
        "first_crossing": median_steps([first_crossing(run["returns"], run["lengths"], threshold) for run in runs]),
        "famle_matched_at": _famle_matched_at(study, runs),
    }
    row["end_low"], row["end_median"], row["end_high"] = quartiles([np.mean(run["returns"][-LAST:]) for run in runs])
    if study.lived[method] >= study.steps:
        row["solved_in_common_steps"] = sum(solved_at(*run, threshold) is not None for run in early)
    return row


def _episode(study: Study, method: str) -> Row:
    runs = study.runs[method]
    recovery = [run.get("recovery") for run in runs]
    row: Row = {
        "solved": int(np.sum(study.scores(method, study.measures[0]) > study.experiment.threshold)),
        "recovered": sum(steps is not None for steps in recovery),
        "recovery": median_steps(recovery),
        "slowest_recovery": max((steps for steps in recovery if steps is not None), default=None),
    }
    if any(run.get("break_at") for run in runs):
        row["walks_on"] = sum(steps == 0 for steps in recovery)
    return row


def _gaits(study: Study, method: str) -> Row:
    gaits = _gaits_to_goal(study, method)
    famle = _gaits_to_goal(study, SUBJECT)
    return {
        "success": len(gaits) / len(study.runs[method]),
        "steps_mean": np.mean(gaits) if gaits else None,
        "steps_deviation": np.std(gaits, ddof=1) if len(gaits) > 1 else None,
        "famle_faster_by": np.mean(gaits) / np.mean(famle) - 1.0 if gaits and famle and method != SUBJECT else None,
    }


def _gaits_to_goal(study: Study, method: str) -> list[int]:
    """Of the replicates that reach it."""
    return [run["gaits"] for run in study.runs.get(method, ()) if run["reached"]]


def _distance(study: Study, method: str) -> Row:
    runs = study.runs[method]
    ways = [study.trace(run)[1] for run in runs]
    furthest, after = (
        float(np.median(values)) for values in zip(*((way.max(), way.argmax()) for way in ways), strict=True)
    )
    row: Row = {"furthest_median": furthest, "furthest_after_median": after, "falls": sum(run["fell"] for run in runs)}
    if method != SUBJECT and SUBJECT in study.runs:
        famle = median_steps([_gaits_to(study.trace(run)[1], furthest) for run in study.runs[SUBJECT]])
        row["famle_there_after"] = famle
    return row


def _gaits_to(way: Array, x: float) -> int | None:
    """The gaits after which a way gets to x."""
    there = np.flatnonzero(way >= x)
    return int(there[0]) if len(there) else None


_KINDS: Mapping[Kind, Callable[[Study, str], Row]] = {
    "curves": _curves,
    "episode": _episode,
    "gaits": _gaits,
    "distance": _distance,
}
"""What only one kind of experiment has."""


def _within(run: Result, steps: int) -> tuple[list[float], list[int]]:
    """Returns and lengths of the episodes that end within some robot steps."""
    whole = int(np.searchsorted(np.cumsum(run["lengths"]), steps, side="right"))
    return run["returns"][:whole], run["lengths"][:whole]


def _solved_at(runs: Sequence[Result], threshold: float) -> list[int | None]:
    return [solved_at(run["returns"], run["lengths"], threshold) for run in runs]


def _famle_faster_by(study: Study, runs: Sequence[Result]) -> float | None:
    """How many more steps than FAMLE a method needs, as a fraction of FAMLE's; None where FAMLE never gets there."""
    subject = study.runs.get(SUBJECT)
    if subject is None or runs is subject:
        return None
    famle, other = (median_steps(_solved_at(some, study.experiment.threshold)) for some in (subject, runs))
    return other / famle - 1.0 if np.isfinite(famle) else None


def _famle_matched_at(study: Study, runs: Sequence[Result]) -> float | None:
    """When a method begins three episodes in a row above FAMLE's median at the end of the steps that all have."""
    *_, last = study.measures
    if SUBJECT not in study.runs or runs is study.runs[SUBJECT] or not study.has(SUBJECT, last):
        return None
    return median_steps(_solved_at(runs, float(np.median(study.scores(SUBJECT, last)))))


def _published(study: Study, method: str) -> Row:
    """The paper's figures of a method."""
    published = next((row for row in study.experiment.paper if row.method == method), None)
    if published is None:
        return {}
    row: Row = {"paper": str(published)}
    for field in fields(published)[1:]:
        value = getattr(published, field.name)
        if isinstance(value, tuple):
            row |= {f"paper_{field.name}_mean": value[0], f"paper_{field.name}_deviation": value[1]}
        elif value is not None and field.name != "remark":
            row[f"paper_{field.name}"] = value
    return row
