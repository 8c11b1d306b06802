"""The stored replicates of one experiment, and the figures that are read from each."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from benchmarks.harness import Result
from benchmarks.reporting.looks import in_order, look
from benchmarks.reporting.registry import Experiment, Kind
from benchmarks.reporting.statistics import Array, quartiles

__all__ = [
    "LAST",
    "ROBOT_ALONE",
    "SUBJECT",
    "Measure",
    "StepTime",
    "Study",
    "diverged_often",
    "quartiles_over_steps",
    "read_study",
]

SUBJECT = "famle"
"""The method that all others are compared with."""

ROBOT_ALONE = "robot alone"
"""The raw cost of a control step among the times that were measured in one run."""

LAST = 5
"""The episodes at the end of a learning curve whose mean stands for where it has got to: a single one is noisy."""

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
        key: Its name in tables for machines.
        label: Its name for people.
        score: The figure of a stored replicate.
        higher_is_better: Whether more is better.
        steps: Robot steps that a replicate must have for it.
    """

    key: str
    label: str
    score: Callable[[Result], float]
    higher_is_better: bool = True
    steps: int = 0


@dataclass(frozen=True)
class StepTime:
    """What a control step of a method costs, where methods took turns.

    Attributes:
        milliseconds: The median over turns.
        times_robot_alone: The median of the ratios within a turn, since a machine may slow down between two.
    """

    milliseconds: float
    times_robot_alone: float

    @classmethod
    def of(cls, turns: Sequence[float], alone: Sequence[float]) -> StepTime:
        """From the milliseconds a step of each turn, of a method and of the robot alone."""
        return cls(float(np.median(turns)), float(np.median(np.divide(turns, alone))))


@dataclass(frozen=True)
class Study:
    """The stored replicates of one experiment.

    Attributes:
        experiment: What was done.
        runs: The replicates of each method by seed, methods in the order in which they are shown.
        step_times: What a control step costs by method, all measured in one run; empty where nobody did.
    """

    experiment: Experiment
    runs: Mapping[str, Sequence[Result]]
    step_times: Mapping[str, StepTime] = field(default_factory=dict)

    @cached_property
    def lived(self) -> Mapping[str, int]:
        """The robot steps in whole episodes that all replicates of a method have; of learning curves alone."""
        return {method: min(int(sum(run["lengths"])) for run in runs) for method, runs in self.runs.items()}

    @cached_property
    def steps(self) -> int:
        """The robot steps over which methods are compared: FAMLE's, without FAMLE those that all methods have."""
        return self.lived.get(SUBJECT) or min(self.lived.values())

    def has(self, method: str, measure: Measure) -> bool:
        """Whether the replicates of a method have lived for long enough to be measured so."""
        return not measure.steps or self.lived[method] >= measure.steps

    @cached_property
    def measures(self) -> tuple[Measure, ...]:
        """What the methods are compared by, the first one first."""
        limit = self.experiment.budget
        if self.experiment.kind == "curves":
            at = f"{self.steps:,} robot steps"
            return (
                Measure("first_episode", "return of the first episode", lambda run: float(run["returns"][0])),
                Measure("mean_return", f"mean return over {at}", self._mean_return, steps=self.steps),
                Measure("last", f"mean return of the last {LAST} episodes within {at}", self._last, steps=self.steps),
            )
        if self.experiment.kind == "episode":
            label = "return since the damage, per 1,000 robot steps" if self.breaks else "return of the first episode"
            return (Measure("return", label, self._return_since_damage),)
        if self.experiment.kind == "gaits":
            label = f"gaits to the goal, {limit + 1} where it is not reached"
            return (Measure("gaits", label, lambda run: float(run["gaits"] if run["reached"] else limit + 1), False),)
        return (Measure("distance", "distance (m)", lambda run: float(run["distance"])),)

    def scores(self, method: str, measure: Measure) -> Array:
        """A figure of each replicate of a method, (n,)."""
        return np.array([measure.score(run) for run in self.runs[method]])

    def shared(self, method: str, other: str, measure: Measure) -> tuple[Array, Array] | None:
        """A figure of two methods over the seeds that both have, each (n,); None without such seeds."""
        if not all(name in self.runs and self.has(name, measure) for name in (method, other)):
            return None
        ours, theirs = ({run["seed"]: run for run in self.runs[name]} for name in (method, other))
        if not (seeds := ours.keys() & theirs.keys()):
            return None
        first, second = (np.array([measure.score(runs[seed]) for seed in sorted(seeds)]) for runs in (ours, theirs))
        return first, second

    @cached_property
    def paired(self) -> bool:
        """Whether each seed has a damage of its own, so that replicates are compared with those of the same seed."""
        return len({run.get("situation") for runs in self.runs.values() for run in runs}) > 1

    @cached_property
    def breaks(self) -> frozenset[int]:
        """The steps before which robots break on the way; empty where they are broken from the first one."""
        return frozenset(run["break_at"] for runs in self.runs.values() for run in runs if run.get("break_at"))

    def milliseconds(self, run: Result) -> float | None:
        """Wall time of a replicate's control step: the mean with all learning in learning curves, else the median.

        Replicates that ran in step, as one batch, have none of their own.
        """
        if run.get("fleet", 1) > 1:
            return None
        if self.experiment.kind == "curves":
            return 1000.0 * float(run["seconds_per_step"])
        return float(run["ms_per_step"]["median"] if self.experiment.kind == "episode" else run["ms_per_plan"])

    def own_time(self, method: str) -> float | None:
        """The median of the replicates' own milliseconds, None where they have none."""
        own = [value for run in self.runs[method] if (value := self.milliseconds(run)) is not None]
        return float(np.median(own)) if own else None

    @cached_property
    def times(self) -> Mapping[str, float]:
        """Milliseconds of a control step of the methods that have any: in one run where that was measured."""
        if self.step_times:
            return {method: self.step_times[method].milliseconds for method in self.runs if method in self.step_times}
        return {method: time for method in self.runs if (time := self.own_time(method)) is not None}

    def trace(self, run: Result) -> tuple[Array, Array]:
        """What happened over a replicate's life: robot steps or actions, and return, speed or x at each, both (n,)."""
        kind = self.experiment.kind
        if kind == "curves":
            return np.cumsum(run["lengths"]).astype(np.float64), np.array(run["returns"], dtype=np.float64)
        if kind == "episode":
            speed = np.array(run["speed"], dtype=np.float64)
            return np.linspace(0.0, self.experiment.budget, len(speed) + 1)[1:], speed
        x = np.array(run["path"], dtype=np.float64)[:, 0]
        return np.arange(len(x), dtype=np.float64), x

    @cached_property
    def title(self) -> str:
        """The experiment's title; less than was asked for, or than others have, says so in it."""
        counts = {method: len(runs) for method, runs in self.runs.items()}
        most = max(counts.values())
        parts = [f"{most} replicates"]
        if most < self.experiment.paper_replicates:
            parts[0] += f", the paper has {self.experiment.paper_replicates}"
        parts += [f"{n} of {labels}" for n, labels in _by_number({m: n for m, n in counts.items() if n < most})]
        if self.experiment.kind == "curves":
            longest = max(max(run["lengths"]) for runs in self.runs.values() for run in runs)
            if self.steps + longest <= self.experiment.budget:
                parts.append(f"{self.steps:,} robot steps instead of {self.experiment.budget:,}")
            short = _by_number({method: steps for method, steps in self.lived.items() if steps < self.steps})
            parts += [f"{steps:,} robot steps of {labels}" for steps, labels in short]
        if mixed := [look(method).label for method, runs in self.runs.items() if _settings_differ(runs)]:
            parts.append("settings that differ between replicates of " + " / ".join(mixed))
        often = {method: sum(map(diverged_often, runs)) for method, runs in self.runs.items()}
        for n, labels in _by_number({method: n for method, n in often.items() if n}):
            parts.append(f"more than one in ten adaptations diverged in {n} replicates of {labels}")
        return f"{self.experiment.title}: {'; '.join(parts)}"

    @property
    def provenance(self) -> Mapping[tuple[str, str], Sequence[str]]:
        """The methods that come from each commit and command."""
        sources: dict[tuple[str, str], list[str]] = {}
        for method, runs in self.runs.items():
            for source in sorted({(run["commit"], run["command"]) for run in runs}):
                sources.setdefault(source, []).append(method)
        return sources

    def _mean_return(self, run: Result) -> float:
        """The mean return over the steps that all have, each episode weighted by its steps within them."""
        ends = np.minimum(np.cumsum(run["lengths"]), self.steps)
        return float(np.average(run["returns"], weights=np.diff(ends, prepend=0)))

    def _last(self, run: Result) -> float:
        """The mean return of the last episodes that end within the steps which all have."""
        whole = int(np.searchsorted(np.cumsum(run["lengths"]), self.steps, side="right"))
        return float(np.mean(run["returns"][max(0, whole - LAST) : whole]))

    def _return_since_damage(self, run: Result) -> float:
        """The return since the damage, as if that had lasted for the whole episode."""
        budget = self.experiment.budget
        return float(run["return"] * budget / (budget - run.get("break_at", 0)))


def _by_number(numbers: Mapping[str, int]) -> list[tuple[int, str]]:
    """The labels of the methods that have a number, for each number, the largest first."""
    labels: dict[int, list[str]] = {}
    for method, number in numbers.items():
        labels.setdefault(number, []).append(look(method).label)
    return [(number, " / ".join(labels[number])) for number in sorted(labels, reverse=True)]


def _settings_differ(runs: Sequence[Result]) -> bool:
    """Whether replicates of a method are of agents with different settings, as far as results know of them."""
    return len({run["settings"] for run in runs if "settings" in run}) > 1


def diverged_often(run: Result) -> bool:
    """Whether more than one in ten of a replicate's adaptations diverged, as far as it was counted."""
    return bool(10 * run.get("diverged", 0) > run.get("adaptations", 0))


def quartiles_over_steps(traces: Sequence[tuple[Array, Array]], hold: bool = False) -> tuple[Array, Array]:
    """The quartiles over replicates at each robot step at which one of them has a value.

    A replicate's value at a step is that of the episode, or the action, which the step belongs to.

    Args:
        traces: Robot steps and values of each replicate.
        hold: Whether a replicate that ended keeps its last value; else nothing is said of steps that not all have.

    Returns:
        Robot steps (n,), and the 25th, 50th and 75th percentile at each, (3, n).
    """
    ends = [steps[-1] for steps, _ in traces]
    grid = np.unique(np.concatenate([steps for steps, _ in traces]))
    grid = grid[grid <= (max(ends) if hold else min(ends))]
    values = [value[np.minimum(np.searchsorted(steps, grid), len(value) - 1)] for steps, value in traces]
    return grid, quartiles(values)


def read_study(experiment: Experiment, results: Path) -> Study | None:
    """The stored replicates of an experiment, or None where there are none.

    Args:
        experiment: What was done.
        results: The folder of all results.

    Raises:
        ValueError: A file is damaged.
    """
    files = sorted((results / experiment.folder).glob("*-*.json"))
    stored = [_read(path, ("method", "seed", *_NEEDED[experiment.kind])) for path in files]
    methods: dict[str, list[Result]] = {}
    for run in sorted(stored, key=lambda run: int(run["seed"])):
        methods.setdefault(run["method"], []).append(run)
    runs = {method: methods[method] for method in in_order(methods)}
    return Study(experiment, runs, _step_times(experiment, results)) if runs else None


def _step_times(experiment: Experiment, results: Path) -> Mapping[str, StepTime]:
    """What `benchmarks.step_time` has stored of a robot; the other kinds of experiments count plans and not steps."""
    path = results / "step-time.json"
    if experiment.kind not in ("curves", "episode") or not path.exists():
        return {}
    turns: Mapping[str, Sequence[float]] = _read(path, ("times",))["times"].get(experiment.robot, {})
    return {method: StepTime.of(milliseconds, turns[ROBOT_ALONE]) for method, milliseconds in turns.items()}


def _read(path: Path, needed: Sequence[str]) -> Result:
    remedy = "delete the file and run the benchmark again; it skips all that is stored."
    try:
        result = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}): {remedy}") from error
    if not isinstance(result, dict):
        raise ValueError(f"{path} is damaged (no object): {remedy}")
    if missing := [key for key in ("command", "commit", *needed) if result.get(key) in (None, [])]:
        raise ValueError(f"{path} is damaged (it has no {', '.join(missing)}): {remedy}")
    return result
