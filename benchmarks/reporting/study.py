"""The stored replicates of one experiment, and the figures that are read from each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.reporting.registry import Experiment, Kind, in_order, style_of
from benchmarks.reporting.statistics import first_crossing, solved_at
from benchmarks.results import load

SUBJECT = "famle"
"""The method that all others are compared with."""

STEPS_IN_TURNS, ROBOT_ALONE = "step in turns", "robot alone"
"""The part of the table of timings in which methods took turns, and its raw cost."""

LAST = 5
"""The episodes at the end of a learning curve whose mean stands for where it has got to: a single one is noisy."""

_OPTIONAL = ("situation", "settings", "fleet", "break_at", "recovery", "adaptations", "diverged")
"""What only some replicates have."""

_NEEDED: Mapping[Kind, tuple[str, ...]] = {
    "curves": ("returns", "lengths", "seconds_per_step"),
    "episode": ("return", "speed", "ms_per_step"),
    "gaits": ("gaits", "reached", "path", "ms_per_plan"),
    "distance": ("gaits", "distance", "fell", "path", "ms_per_plan"),
}
"""What a stored replicate must have."""


@dataclass(frozen=True)
class Measure:
    """A figure by which methods are compared.

    Attributes:
        key: Its column.
        label: Its name for people.
        higher_is_better: Whether more is better.
    """

    key: str
    label: str
    higher_is_better: bool = True


@dataclass(frozen=True)
class Study:
    """The stored replicates of one experiment.

    Attributes:
        experiment: What was done.
        runs: What is stored, a row a replicate; methods in the order in which they are shown.
        step_times: The milliseconds of a control step in each turn by method; empty where nobody measured them.
    """

    experiment: Experiment
    runs: pd.DataFrame
    step_times: Mapping[str, Sequence[float]]

    @cached_property
    def methods(self) -> Mapping[str, int]:
        """The number of replicates of each method."""
        return {str(method): len(runs) for method, runs in self.runs.groupby("method", sort=False)}

    @cached_property
    def robot_steps(self) -> Mapping[str, int]:
        """The robot steps in whole episodes that all replicates of a method have; of learning curves alone."""
        if self.experiment.kind != "curves":
            return {}
        return dict(self.runs["lengths"].map(sum).groupby(self.runs["method"], sort=False).min())

    @cached_property
    def steps(self) -> int:
        """The robot steps over which methods are compared: FAMLE's, without FAMLE those that all methods have."""
        return self.robot_steps.get(SUBJECT) or min(self.robot_steps.values(), default=0)

    @cached_property
    def measures(self) -> tuple[Measure, ...]:
        """What the methods are compared by, the first one first."""
        if self.experiment.kind == "curves":
            at = f"{self.steps:,} robot steps"
            return (
                Measure("first_episode", "return of the first episode"),
                Measure("mean_return", f"mean return over {at}"),
                Measure("last", f"mean return of the last {LAST} episodes within {at}"),
            )
        if self.experiment.kind == "episode":
            on_the_way = "return since the damage, per 1,000 robot steps"
            return (Measure("return", on_the_way if self.breaks else "return of the first episode"),)
        if self.experiment.kind == "gaits":
            label = f"gaits to the goal, {self.experiment.budget + 1} where it is not reached"
            return (Measure("gaits", label, higher_is_better=False),)
        return (Measure("distance", "distance (m)"),)

    @cached_property
    def scores(self) -> pd.DataFrame:
        """The figures of each replicate; a measure is not known where a method has too few robot steps for it."""
        rows = [_SCORES[self.experiment.kind](self, run) | _diverged(run) for _, run in self.runs.iterrows()]
        return self.runs[["method", "seed"]].join(pd.DataFrame(rows))

    def of(self, method: str) -> pd.DataFrame:
        """The figures of the replicates of a method; without a row where it was not measured."""
        return self.scores[self.scores["method"] == method]

    def by_seed(self, measure: Measure) -> pd.DataFrame:
        """A figure of each replicate: a row a seed, a column a method; NaN where it is not known."""
        return self.scores.pivot(index="seed", columns="method", values=measure.key).astype(float)

    @cached_property
    def paired(self) -> bool:
        """Whether each seed has a damage of its own, so that replicates are compared with those of the same seed."""
        return self.runs["situation"].nunique() > 1

    @cached_property
    def breaks(self) -> list[int]:
        """The steps before which robots break on the way; none where they are broken from the first one."""
        return sorted({int(step) for step in self.runs["break_at"].dropna() if step})

    @cached_property
    def times(self) -> Mapping[str, float]:
        """Milliseconds of a control step of the methods that have any: in one run where that was measured."""
        if self.step_times:
            return {name: float(np.median(self.step_times[name])) for name in self.methods if name in self.step_times}
        own = self.scores.groupby("method", sort=False)["ms"].median().dropna()
        return {str(method): float(ms) for method, ms in own.items()}

    @cached_property
    def title(self) -> str:
        """The experiment's title; less than was asked for, or than others have, says so in it."""
        most = max(self.methods.values())
        parts = [f"{most} replicates"]
        if most < self.experiment.paper_replicates:
            parts[0] += f", the paper has {self.experiment.paper_replicates}"
        parts += [f"{n} of {labels}" for n, labels in _by_number({m: n for m, n in self.methods.items() if n < most})]
        if self.experiment.kind == "curves":
            longest = max(map(max, self.runs["lengths"]))
            if self.steps + longest <= self.experiment.budget:
                parts.append(f"{self.steps:,} robot steps instead of {self.experiment.budget:,}")
            short = {method: steps for method, steps in self.robot_steps.items() if steps < self.steps}
            parts += [f"{steps:,} robot steps of {labels}" for steps, labels in _by_number(short)]
        settings = self.runs.groupby("method", sort=False)["settings"].nunique()  # as far as results know of them
        if mixed := [style_of(str(method)).label for method in settings.index[settings > 1]]:
            parts.append("settings that differ between replicates of " + " / ".join(mixed))
        often = {method: int(self.of(method)["diverged_often"].sum()) for method in self.methods}
        for n, labels in _by_number({method: n for method, n in often.items() if n}):
            parts.append(f"more than one in ten adaptations diverged in {n} replicates of {labels}")
        return f"{self.experiment.title}: {'; '.join(parts)}"

    @property
    def provenance(self) -> Mapping[tuple[str, str], Sequence[str]]:
        """The methods that come from each commit and command."""
        sources: dict[tuple[str, str], list[str]] = {}
        for method in self.methods:
            runs = self.runs[self.runs["method"] == method]
            for source in sorted(set(zip(runs["commit"], runs["command"], strict=True))):
                sources.setdefault(source, []).append(method)
        return sources

    def traces(self, method: str) -> list[pd.Series[float]]:
        """Return, speed or x of each replicate of a method at robot steps or actions, which are the index."""
        runs = self.runs[self.runs["method"] == method]
        if self.experiment.kind == "curves":
            pairs = zip(runs["returns"], runs["lengths"], strict=True)
            return [pd.Series(returns, index=np.cumsum(lengths), dtype=float) for returns, lengths in pairs]
        if self.experiment.kind == "episode":
            ends = [np.linspace(0, self.experiment.budget, len(speed) + 1)[1:] for speed in runs["speed"]]
            return [pd.Series(speed, index=end, dtype=float) for speed, end in zip(runs["speed"], ends, strict=True)]
        return [pd.Series([x for x, _ in path], dtype=float) for path in runs["path"]]


def over_steps(traces: Sequence[pd.Series[float]]) -> pd.DataFrame:
    """Brings replicates, one a column, to the robot steps at which one of them has a value and which all have.

    A replicate's value at a step is that of the episode, or the action, which the step belongs to.
    """
    return pd.concat(list(traces), axis=1, keys=range(len(traces))).sort_index().bfill().dropna()


def read_study(experiment: Experiment, results: Path) -> Study | None:
    """Reads the stored replicates of an experiment; None where there are none.

    Args:
        experiment: What was done.
        results: The folder of all results.

    Raises:
        ValueError: A table is damaged.
    """
    path = results / f"{experiment.name}.csv"
    if not path.exists():
        return None
    runs = load(path)
    for name in ("method", "seed", "command", "commit", *_NEEDED[experiment.kind]):
        if name not in runs or not runs[name].map(_is_known).all():
            raise ValueError(f"{path} is damaged (a row has no {name}): delete that row and run the benchmark again.")
    runs = pd.concat([runs[runs["method"] == method] for method in in_order(set(runs["method"]))], ignore_index=True)
    runs = runs.reindex(columns=[*runs, *(name for name in _OPTIONAL if name not in runs)])
    return Study(experiment, runs, _step_times(experiment, results / "timing.csv"))


def _is_known(cell: Any) -> bool:
    """Tells whether a cell, which may hold a list, has any value."""
    return isinstance(cell, dict) or bool(np.any(pd.notna(cell)))


def _step_times(experiment: Experiment, path: Path) -> Mapping[str, Sequence[float]]:
    """Reads what `benchmarks.timing` has stored of a robot; other kinds of experiments count plans and not steps."""
    if experiment.kind not in ("curves", "episode") or not path.exists():
        return {}
    times = load(path)
    mine = times[(times["robot"] == experiment.robot) & (times["part"] == STEPS_IN_TURNS)]
    return dict(zip(mine["figure"], mine["value"], strict=True))


def _by_number(numbers: Mapping[str, int]) -> list[tuple[int, str]]:
    """The labels of the methods that have a number, for each number, the largest first."""
    labels: dict[int, list[str]] = {}
    for method, number in numbers.items():
        labels.setdefault(number, []).append(style_of(method).label)
    return [(number, " / ".join(labels[number])) for number in sorted(labels, reverse=True)]


# --- the figures of a replicate ---------------------------------------------------------------------------------------


def _curve(study: Study, run: pd.Series[Any]) -> dict[str, float]:
    returns, lengths, threshold = run["returns"], run["lengths"], study.experiment.threshold
    figures = {
        "first_episode": returns[0],
        "mean_return": np.nan,
        "last": np.nan,
        "second_episode": returns[1] if len(returns) > 1 else np.nan,
        "end": np.mean(returns[-LAST:]),
        "solved_at": solved_at(returns, lengths, threshold),
        "first_crossing": first_crossing(returns, lengths, threshold),
        # Robots that act in step, as one batch, have no times of their own.
        "ms": np.nan if run["fleet"] > 1 else 1e3 * run["seconds_per_step"],
    }
    if study.robot_steps[run["method"]] >= study.steps:
        ends = np.cumsum(lengths)
        whole = int(np.searchsorted(ends, study.steps, side="right"))
        weights = np.diff(np.minimum(ends, study.steps), prepend=0)
        figures["mean_return"] = np.average(returns, weights=weights)
        figures["last"] = np.mean(returns[max(0, whole - LAST) : whole])
        solved = solved_at(returns[:whole], lengths[:whole], threshold)
        figures["solved_in_common_steps"] = float(np.isfinite(solved))
    return figures


def _episode(study: Study, run: pd.Series[Any]) -> dict[str, float]:
    """The return counts since the damage, as if that had lasted for the whole episode."""
    budget = study.experiment.budget
    lasted = budget - (0 if pd.isna(run["break_at"]) else run["break_at"])
    recovery = np.inf if pd.isna(run["recovery"]) else run["recovery"]
    return {"return": run["return"] * budget / lasted, "recovery": recovery, "ms": run["ms_per_step"]["median"]}


def _journey(study: Study, run: pd.Series[Any]) -> dict[str, float]:
    """A run that does not reach its goal counts as one gait more than there are."""
    gaits = run["gaits"] if run["reached"] else study.experiment.budget + 1
    return {"gaits": gaits, "reached": run["reached"], "ms": run["ms_per_plan"]}


def _walk(study: Study, run: pd.Series[Any]) -> dict[str, float]:
    x = np.array(run["path"])[:, 0]
    furthest = {"furthest": x.max(), "furthest_after": x.argmax()}
    return {"distance": run["distance"], "fell": run["fell"], "ms": run["ms_per_plan"], **furthest}


def _diverged(run: pd.Series[Any]) -> dict[str, float]:
    """The adaptations, those of them that diverged, and whether more than one in ten did; as far as it was counted."""
    adaptations, diverged = run["adaptations"], run["diverged"]
    return {"adaptations": adaptations, "diverged": diverged, "diverged_often": 10 * diverged > adaptations}


_SCORES: Mapping[Kind, Callable[[Study, pd.Series[Any]], dict[str, float]]] = {
    "curves": _curve,
    "episode": _episode,
    "gaits": _journey,
    "distance": _walk,
}
