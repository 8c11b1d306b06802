"""The report's text: a section an experiment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from benchmarks.reporting.looks import look
from benchmarks.reporting.registry import Kind
from benchmarks.reporting.study import LAST, Study
from benchmarks.reporting.tables import Row

__all__ = ["document", "section"]

_SIGNIFICANT = 0.05

Column = tuple[str, Callable[[Row], str]]
"""The heading of a column, and what it says of a row."""


def document(
    sections: Sequence[str], missing: Sequence[tuple[str, str, str]], unknown: Sequence[str], times: Sequence[str]
) -> str:
    """The whole report.

    Args:
        sections: One an experiment.
        missing: Experiments without results: title, where they would be, and the command.
        unknown: Folders of results that are no entry of the registry.
        times: Names of the files of pictures of returns against time.
    """
    parts = ["# Results", *_HOW_TO_READ, *sections]
    if times:
        parts += [
            "## Return against time",
            *(f"![Return against the time of a control step]({name})" for name in times),
            "Interquartile means; times in one run where there are any, else those of the replicates.",
        ]
    if missing:
        rows = "\n".join(f"| {title} | `{where}` | `{command}` |" for title, where, command in missing)
        parts += ["## Not measured", f"| experiment | results | command |\n| --- | --- | --- |\n{rows}"]
    if unknown:
        names = ", ".join(f"`{name}`" for name in unknown)
        parts += [
            "## Stored and not shown",
            f"These folders have no entry in `benchmarks/reporting/registry.py`: {names}.",
        ]
    return "\n\n".join(parts) + "\n"


def section(study: Study, rows: Sequence[Row], pictures: Sequence[str]) -> str:
    """The section of an experiment.

    Args:
        study: Its replicates.
        rows: Its figures.
        pictures: Names of the files of its pictures, none where another section shows them.
    """
    experiment = study.experiment
    measured = [row for row in rows if row["replicates"]]
    parts = [f"## {study.title}", *(f"![{experiment.title}]({picture})" for picture in pictures)]
    columns = [*_COLUMNS[experiment.kind](study), *_diverged(rows), *_paper(study)]
    parts.append(_table([_METHOD, _N, *columns], rows))
    parts.append(_NOTES[experiment.kind].format(study=study))
    parts.append(_table([_METHOD, _N, *_measures(study)], measured))
    if compared := [row for row in measured if f"{study.measures[0].key}_famle_better" in row]:
        parts += [_table([_METHOD, _N, *_improvements(study)], compared), _better_than_famle(study, compared)]
    return "\n\n".join([*parts, _sources(study)])


_HOW_TO_READ = (
    """Made by `python -m benchmarks.reporting` from stored results alone. Robot steps are counted from the damage on.
Spreads are medians with quartiles in round brackets; IQM is the interquartile mean with its bootstrap 95 % interval in
square brackets.
*Of the oracle* is the ratio of IQMs over the seeds that both have, turned over where fewer is better, so that 100 % is
as good as the oracle; in brackets stands how many seeds that is, where a method has more. *P(FAMLE better)* is the
probability that a replicate of FAMLE does better than one of the other method, a tie counted half, with its bootstrap
95 % interval; that is Clopper and Pearson's where all comparisons go the same way. Fewer than five replicates have no
interval and no p. Where each seed has a damage of its own, FAMLE is compared with the other method on the same damage
alone, and it is the fraction of damages on which it does better; in round brackets stands how many they are, where a
method has more. p is of Wilcoxon's signed-rank test there and of Mann and Whitney's elsewhere, adjusted for all
comparisons of an experiment (Benjamini and Hochberg). Intervals and tests take replicates for independent also where
they share networks: the ant, the quadruped and the Minitaur have one network of each method. Deviations are those of a
sample (n - 1). An adaptation that *diverged* left the finite numbers and was taken back; older results did not count
them.""",
    """Times of replicates are wall times on machines that did other work too, and none are given of replicates that ran
in step as one batch; those *in one run*, where methods took turns (`python -m benchmarks.step_time`), can be compared.
The paper's figures for the quadruped and the Minitaur are of other bodies; they stand beside ours and not against
them.""",
)

_NOTES: Mapping[Kind, str] = {
    "curves": """Solved: three returns in a row above {study.experiment.threshold:g}, counted at the end of the first of
them; a replicate that never gets there is infinite in the median. Methods are compared over the first {study.steps:,}
robot steps, but for those of which the title says that they have fewer; *solved at*, *first crossing*, *matches FAMLE*
(the first of three episodes in a row above FAMLE's median of its last five in these steps) and *its last* episodes are
over all steps of a method. An episode is the resolution of all of these: where FAMLE is solved with the first one,
*faster by* counts episodes. Returns are those of the life itself, PPO's with the noise by which it explores. The time
of a step contains the simulated robot and all learning on the way; only in one run, that of the authors' settings is
without their learning at the end of an episode.""",
    "episode": """A robot walks again as soon as its mean speed over 100 steps is above 0.8 m/s, the paper's solved
mark; the steps since the damage are a median, in which one that never does is infinite, and those of the slowest that
does. Where the damage strikes on the way, one whose mean speed never falls to the mark walks on, after 0 steps. The
time is the median of a control step, with adaptation.""",
    "gaits": """Steps are the gaits of the runs that reach the goal, within {study.experiment.budget}. A gait takes a
second; the paper's took about two. *FAMLE faster by* compares the means of these. The time of a plan is without
adaptation.""",
    "distance": """The largest distance and the seconds until then, medians over replicates of {study.experiment.budget}
gaits, a second each; *FAMLE is there* when half of its replicates have come as far as the method's median. The time of
a plan is without adaptation.""",
}
"""How the first table of each kind is to be read."""


# --- columns ----------------------------------------------------------------------------------------------------------

_METHOD: Column = ("method", lambda row: str(row["label"]))
_N: Column = ("n", lambda row: str(row["replicates"] or "-"))


def _curves(study: Study) -> list[Column]:
    return [
        ("robot steps", lambda row: _steps(row.get("robot_steps"))),
        (f"solved in {study.steps:,}", lambda row: _count(row, "solved_in_common_steps")),
        ("solved at all", lambda row: _count(row, "solved")),
        ("solved at", lambda row: _steps(row.get("solved_at"))),
        ("first crossing", lambda row: _steps(row.get("first_crossing"))),
        ("FAMLE faster by", lambda row: _percent(row.get("famle_faster_by"))),
        ("matches FAMLE", lambda row: _steps(row.get("famle_matched_at"))),
        ("2nd episode", lambda row: _number(row.get("second_episode_median"))),
        (f"its last {LAST}", lambda row: _spread(row, "end")),
        *_times(study),
    ]


def _times(study: Study) -> list[Column]:
    columns: list[Column] = [("ms / step", lambda row: _number(row.get("ms")))]
    if study.step_times:
        columns.append(("ms / step in one run (times the robot alone)", _together))
    return columns


def _episode(study: Study) -> list[Column]:
    return [
        (f"above {study.experiment.threshold:g}", lambda row: _count(row, "solved")),
        ("walks on", lambda row: _count(row, "walks_on")),
        ("walks again", lambda row: _count(row, "recovered")),
        ("after steps", lambda row: _steps(row.get("recovery"))),
        ("the slowest of them", lambda row: _steps(row.get("slowest_recovery"))),
        *_times(study),
    ]


def _gaits(study: Study) -> list[Column]:
    return [
        ("steps, mean +- deviation", lambda row: _deviation(row, "steps")),
        ("success rate", lambda row: _percent(row.get("success"))),
        ("FAMLE faster by", lambda row: _percent(row.get("famle_faster_by"))),
        ("ms / plan", lambda row: _number(row.get("ms"))),
    ]


def _distance(study: Study) -> list[Column]:
    return [
        ("max distance (m)", lambda row: _number(row.get("furthest_median"))),
        ("interaction time (s)", lambda row: _steps(row.get("furthest_after_median"))),
        ("FAMLE is there after (s)", lambda row: _steps(row.get("famle_there_after"))),
        ("falls", lambda row: _count(row, "falls")),
        ("ms / plan", lambda row: _number(row.get("ms"))),
    ]


_COLUMNS: Mapping[Kind, Callable[[Study], list[Column]]] = {
    "curves": _curves,
    "episode": _episode,
    "gaits": _gaits,
    "distance": _distance,
}
"""The first table of each kind, as the paper's."""


def _diverged(rows: Sequence[Row]) -> list[Column]:
    """Where anybody counted it."""
    return [("adaptations that diverged", _share)] if any("diverged" in row for row in rows) else []


def _paper(study: Study) -> list[Column]:
    return [("the paper", lambda row: row.get("paper", "-"))] if study.experiment.paper else []


def _measures(study: Study) -> list[Column]:
    columns = list[Column]()
    for measure in study.measures:
        key = measure.key
        columns += [
            (f"{measure.label}: median (quartiles)", partial(_spread, key=key)),
            ("IQM [95 %]", partial(_interval, key=key)),
        ]
        if "oracle" in study.runs:
            columns.append(("of the oracle", partial(_of_oracle, key=key)))
    return columns


def _improvements(study: Study) -> list[Column]:
    return [(f"P(FAMLE better), {measure.label}", partial(_better, key=measure.key)) for measure in study.measures]


# --- cells ------------------------------------------------------------------------------------------------------------


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def _steps(value: float | None) -> str:
    if value is None:
        return "-"
    return "never" if np.isinf(value) else f"{value:,.0f}"


def _percent(value: float | None) -> str:
    if value is None:
        return "-"
    return "never solved" if np.isinf(value) else f"{100 * value:,.0f} %"


def _count(row: Row, key: str) -> str:
    return f"{row[key]} of {row['replicates']}" if key in row else "-"


def _deviation(row: Row, key: str) -> str:
    mean, deviation = row.get(f"{key}_mean"), row.get(f"{key}_deviation")
    if mean is None:
        return "-"
    return f"{mean:.1f}" if deviation is None else f"{mean:.1f} +- {deviation:.1f}"


def _share(row: Row) -> str:
    if "diverged" not in row:
        return "-"
    often = row["diverged_replicates"]
    return f"{100 * row['diverged']:.1f} %" + (f", over 10 % in {often} of {row['replicates']}" if often else "")


def _together(row: Row) -> str:
    return f"{row['step_ms']:.1f} (x {row['times_robot_alone']:.1f})" if "step_ms" in row else "-"


def _spread(row: Row, key: str) -> str:
    if f"{key}_median" not in row:
        return "-"
    return "{} ({} to {})".format(*(_decimals(row, key, name) for name in ("median", "low", "high")))


def _interval(row: Row, key: str) -> str:
    if f"{key}_iqm" not in row:
        return "-"
    if f"{key}_iqm_low" not in row:
        return _decimals(row, key, "iqm")
    return "{} [{}, {}]".format(*(_decimals(row, key, name) for name in ("iqm", "iqm_low", "iqm_high")))


def _of_oracle(row: Row, key: str) -> str:
    seeds = row.get(f"{key}_oracle_seeds")
    return _percent(row.get(f"{key}_of_oracle")) + (f" ({seeds})" if seeds not in (None, row["replicates"]) else "")


def _better(row: Row, key: str) -> str:
    if f"{key}_famle_better" not in row:
        return "-"
    name = f"{key}_famle_better"
    cell, seeds = f"{row[name]:.2f}", row[f"{name}_seeds"]
    if f"{name}_low" in row:
        cell += f" [{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}], p = {row[f'{name}_p']:.2g}"
    return cell + (f" ({seeds})" if seeds != row["replicates"] else "")


def _decimals(row: Row, key: str, name: str) -> str:
    """A figure with as many decimals as the others of its cell."""
    return f"{row[f'{key}_{name}']:.{0 if abs(row[f'{key}_median']) >= 100 else 1}f}"


# --- parts ------------------------------------------------------------------------------------------------------------


def _table(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    lines = [[title for title, _ in columns], ["---"] * len(columns)]
    lines += [[cell(row) for _, cell in columns] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _better_than_famle(study: Study, rows: Sequence[Row]) -> str:
    """Who wins against FAMLE in what, so that nobody has to search for it."""
    wins = []
    for measure in study.measures:
        name = f"{measure.key}_famle_better"
        winners = [
            row["label"] for row in rows if row.get(name, 1.0) < 0.5 and row.get(f"{name}_p", 1.0) < _SIGNIFICANT
        ]
        if winners:
            wins.append(f"{' / '.join(winners)} ({measure.label})")
    return f"Better than FAMLE, p < {_SIGNIFICANT}: {'; '.join(wins) or 'none'}."


def _sources(study: Study) -> str:
    """What runs the experiment, what is missing, and what made each of the results."""
    experiment = study.experiment
    parts = [f"`{experiment.command}` runs this.", experiment.shared]
    if "oracle" not in study.runs:
        parts.append("No oracle has been measured here.")
    lines = [f"{' '.join(parts)} These results were made by:", ""]
    for (commit, command), methods in study.provenance.items():
        names = ", ".join(look(method).label + f" (`{method}`)" for method in methods)
        lines.append(f"- `{command}` at `{commit}`: {names}")
    return "\n".join(lines)
