"""The figures of each method in an experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.reporting.registry import Kind, style_of
from benchmarks.reporting.statistics import interquartile_mean, p_value, probability_of_improvement, solved_at
from benchmarks.reporting.study import ROBOT_ALONE, SUBJECT, Measure, Study

Row = dict[str, Any]
"""Figures by name; one that is not known is missing, or NaN."""


def figures(study: Study) -> pd.DataFrame:
    """Makes a table with a row a method, and then the paper's methods that no measured one stands beside."""
    table = pd.DataFrame.from_dict({method: _row(study, method) for method in study.methods}, orient="index")
    _correct_for_many(table)
    shown = {style_of(method).paper for method in study.methods}
    for paper in study.experiment.paper:
        if paper.method not in shown:
            alone: Row = {"label": f"{paper.method}, in the paper alone", "replicates": 0, "paper": paper.text}
            table = pd.concat([table, pd.DataFrame(alone, index=[paper.method])])
    return table.rename_axis("method")


def _correct_for_many(table: pd.DataFrame) -> None:
    """Adjusts the p-values of an experiment for their number (Benjamini and Hochberg), in place."""
    if names := [str(name) for name in table if str(name).endswith("_famle_better_p")]:
        p = table[names].to_numpy(float, copy=True)
        p[~np.isnan(p)] = stats.false_discovery_control(p[~np.isnan(p)])
        table[names] = p


def _row(study: Study, method: str) -> Row:
    scores, style = study.of(method), style_of(method)
    row: Row = {"label": style.label, "replicates": len(scores)}
    by_seed = {measure: study.by_seed(measure) for measure in study.measures}
    for measure, values in by_seed.items():
        row |= _spread(measure, values, method)
    row |= _KINDS[study.experiment.kind](study, method, scores)
    row["ms"] = scores["ms"].median()
    if method in study.step_times:
        turns, alone = study.step_times[method], study.step_times[ROBOT_ALONE]
        row["step_ms"] = np.median(turns)
        row["times_robot_alone"] = np.median(np.divide(turns, alone))  # a machine may slow down between two turns
    for measure, values in by_seed.items():
        row |= _improvement(measure, values, method, study.paired)
    if adaptations := scores["adaptations"].sum():
        often = int(scores["diverged_often"].sum())
        row |= {"diverged": scores["diverged"].sum() / adaptations, "diverged_replicates": often}
    for paper in study.experiment.paper:
        if paper.method == style.paper:
            row["paper"] = paper.text
    return row


def _spread(measure: Measure, by_seed: pd.DataFrame, method: str) -> Row:
    """Median, quartiles and interquartile mean of a measure, and how much of the oracle's it is."""
    key, scores = measure.key, by_seed[method].dropna()
    if scores.empty:
        return {}
    row = _quartiles(key, scores) | dict(zip(_estimate(f"{key}_iqm"), interquartile_mean(scores), strict=True))
    if "oracle" in by_seed and len(pair := by_seed[[method, "oracle"]].dropna()):
        ours, oracle = (interquartile_mean(values)[0] for values in pair.to_numpy().T)
        over, under = (ours, oracle) if measure.higher_is_better else (oracle, ours)
        row |= {f"{key}_of_oracle": over / under if under > 0 else np.nan, f"{key}_oracle_seeds": len(pair)}
    return row


def _quartiles(key: str, values: Any) -> Row:
    names = (f"{key}_low", f"{key}_median", f"{key}_high")
    return dict(zip(names, np.percentile(values, [25, 50, 75]), strict=True))


def _estimate(name: str) -> tuple[str, str, str]:
    return name, f"{name}_low", f"{name}_high"


def _improvement(measure: Measure, by_seed: pd.DataFrame, method: str, paired: bool) -> Row:
    """The probability that a replicate of FAMLE is better than one of another method."""
    if method == SUBJECT or SUBJECT not in by_seed:
        return {}
    pair = by_seed[[SUBJECT, method]] * (1 if measure.higher_is_better else -1)
    ours, theirs = (pair.dropna()[name] if paired else pair[name].dropna() for name in (SUBJECT, method))
    if ours.empty or theirs.empty:
        return {}
    name, estimate = f"{measure.key}_famle_better", probability_of_improvement(ours, theirs, paired)
    p = np.nan if np.isnan(estimate[1]) else p_value(ours, theirs, paired)
    return {f"{name}_seeds": len(theirs), f"{name}_p": p} | dict(zip(_estimate(name), estimate, strict=True))


# --- what only one kind of experiment has -----------------------------------------------------------------------------


def _curves(study: Study, method: str, scores: pd.DataFrame) -> Row:
    row: Row = {
        "second_episode_median": scores["second_episode"].median(),
        "robot_steps": study.robot_steps[method],
        "solved": int(np.isfinite(scores["solved_at"]).sum()),
        "solved_at": scores["solved_at"].median(),
        "first_crossing": scores["first_crossing"].median(),
        **_quartiles("end", scores["end"]),
    }
    if study.robot_steps[method] >= study.steps:
        row["solved_in_common_steps"] = int(scores["solved_in_common_steps"].sum())
    if method != SUBJECT and SUBJECT in study.methods:
        famle = study.of(SUBJECT)
        if np.isfinite(solved := famle["solved_at"].median()):
            row["famle_faster_by"] = row["solved_at"] / solved - 1.0
        # The first of three episodes in a row above FAMLE's median at the end of the steps that all have.
        mark, traces = famle["last"].median(), study.traces(method)
        ends = [solved_at(trace.to_numpy(), np.diff(trace.index, prepend=0), mark) for trace in traces]
        row["famle_matched_at"] = np.median(ends)
    return row


def _episode(study: Study, method: str, scores: pd.DataFrame) -> Row:
    recovery = scores["recovery"]
    recovered = recovery[np.isfinite(recovery)]
    row: Row = {
        "solved": int((scores["return"] > study.experiment.threshold).sum()),
        "recovered": len(recovered),
        "recovery": recovery.median(),
        "slowest_recovery": recovered.max(),
    }
    return row | ({"walks_on": int((recovery == 0).sum())} if study.breaks else {})


def _gaits(study: Study, method: str, scores: pd.DataFrame) -> Row:
    gaits, famle = (some["gaits"][some["reached"].astype(bool)] for some in (scores, study.of(SUBJECT)))
    row: Row = {"success": len(gaits) / len(scores), "steps_mean": gaits.mean(), "steps_deviation": gaits.std()}
    return row | ({"famle_faster_by": gaits.mean() / famle.mean() - 1.0} if method != SUBJECT else {})


def _distance(study: Study, method: str, scores: pd.DataFrame) -> Row:
    furthest = scores["furthest"].median()
    row: Row = {
        "furthest_median": furthest,
        "furthest_after_median": scores["furthest_after"].median(),
        "falls": int(scores["fell"].sum()),
    }
    if method != SUBJECT and SUBJECT in study.methods:
        first = pd.Series([way.index[way >= furthest].min() for way in study.traces(SUBJECT)])
        row["famle_there_after"] = first.fillna(np.inf).median()
    return row


_KINDS: Mapping[Kind, Callable[[Study, str, pd.DataFrame], Row]] = {
    "curves": _curves,
    "episode": _episode,
    "gaits": _gaits,
    "distance": _distance,
}
