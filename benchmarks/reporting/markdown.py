"""The report's text: a table of all robots, and a section an experiment."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import yaml

from benchmarks.reporting.figures import Row
from benchmarks.reporting.registry import Kind, in_order, style_of
from benchmarks.reporting.statistics import FEWEST
from benchmarks.reporting.study import LAST, Study

_SIGNIFICANT = 0.05

Cell = str | Callable[[Row], str]
"""A template of figures, or a function of them; it is filled with a dash where a figure is not known."""

_TEXTS: Mapping[str, str] = yaml.safe_load(Path(__file__).with_name("texts.yaml").read_text())


def document(
    sections: Sequence[str], missing: Sequence[tuple[str, str, str]], unknown: Sequence[str], times: bool
) -> str:
    """Writes the whole report.

    Args:
        sections: One an experiment.
        missing: Experiments without results: title, the table where they would be, and the command.
        unknown: Tables of results that are no entry of the registry.
        times: Whether there is a picture of returns against time.
    """
    parts = ["# Results", _TEXTS["report"], *sections]
    if times:
        parts.append(_TEXTS["times"])
    if missing:
        rows = [(title, f"`{where}`", f"`{command}`") for title, where, command in missing]
        parts += ["## Not measured", _table(("experiment", "results", "command"), rows)]
    if unknown:
        names = ", ".join(f"`{name}`" for name in unknown)
        parts.append("## Stored and not shown")
        parts.append(f"These tables have no entry in `benchmarks/reporting/experiments.yaml`: {names}.")
    return "\n\n".join(parts) + "\n"


def section(study: Study, figures: pd.DataFrame, pictures: Sequence[str]) -> str:
    """Writes the section of an experiment.

    Args:
        study: Its replicates.
        figures: A row a method.
        pictures: Names of the files of its pictures, none where another section shows them.
    """
    experiment, rows = study.experiment, _rows(figures)
    measured = [row for row in rows if row["replicates"]]
    about = {"steps": study.steps, **vars(experiment)}
    columns = [(title.format_map(about), cell) for title, cell in _COLUMNS[experiment.kind].items()]
    columns += [("adaptations that diverged", _share), ("the paper", operator.itemgetter("paper"))]
    spreads, improvements = list[tuple[str, Cell]](), list[tuple[str, Cell]]()
    for measure in study.measures:
        spreads.append((f"{measure.label}: median (quartiles)", partial(_spread, key=measure.key)))
        spreads.append(("IQM [95 %]", partial(_interval, key=measure.key)))
        spreads.append(("of the oracle", partial(_of_oracle, key=measure.key)))
        improvements.append((f"P(FAMLE better), {measure.label}", partial(_better, key=measure.key)))
    parts = [f"## {study.title}", *(f"![{experiment.title}]({picture})" for picture in pictures)]
    parts += [_by_method(columns, rows), _TEXTS[experiment.kind].format_map(about), _by_method(spreads, measured)]
    if compared := [row for row in measured if f"{study.measures[0].key}_famle_better" in row]:
        parts += [_by_method(improvements, compared), _better_than_famle(study, compared)]
    return "\n\n".join([*parts, _sources(study)])


# --- cells ------------------------------------------------------------------------------------------------------------


def _cell(row: Row, cell: Cell) -> str:
    """Fills a cell with the figures of a method; with a dash where one is not known."""
    try:
        if callable(cell):
            return cell(row)
        return cell.format_map(row).replace("inf%", "never solved").replace("inf", "never").replace("%", " %")
    except KeyError:
        return "-"


def _rounded(row: Row, *names: str) -> list[str]:
    """Writes figures with as many decimals as suit the first of them."""
    decimals = 0 if abs(row[names[0]]) >= 100 else 1
    return [f"{row[name]:.{decimals}f}" for name in names]


def _spread(row: Row, key: str) -> str:
    return "{} ({} to {})".format(*_rounded(row, f"{key}_median", f"{key}_low", f"{key}_high"))


def _interval(row: Row, key: str) -> str:
    """As many decimals as the median has."""
    names = [f"{key}_iqm_low", f"{key}_iqm_high"] if f"{key}_iqm_low" in row else []
    _, mean, *bounds = _rounded(row, f"{key}_median", f"{key}_iqm", *names)
    return mean + (f" [{', '.join(bounds)}]" if bounds else "")


def _of_oracle(row: Row, key: str) -> str:
    return f"{100 * row[f'{key}_of_oracle']:,.0f} %" + _seeds(row, f"{key}_oracle_seeds")


def _better(row: Row, key: str) -> str:
    name = f"{key}_famle_better"
    cell = f"{row[name]:.2f}"
    if f"{name}_low" in row:
        cell += f" [{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}], p = {row[f'{name}_p']:.2g}"
    return cell + _seeds(row, f"{name}_seeds")


def _seeds(row: Row, name: str) -> str:
    """Says of how many seeds a figure is, where a method has more."""
    return f" ({row[name]:.0f})" if row[name] != row["replicates"] else ""


def _deviation(row: Row) -> str:
    return f"{row['steps_mean']:.1f}" + (f" +- {row['steps_deviation']:.1f}" if "steps_deviation" in row else "")


def _share(row: Row) -> str:
    share, often = f"{100 * row['diverged']:.1f} %", row["diverged_replicates"]
    return share + (f", over 10 % in {often:.0f} of {row['replicates']}" if often else "")


_TIMES: Mapping[str, Cell] = {
    "ms / step": "{ms:.1f}",
    "ms / step in one run (times the robot alone)": "{step_ms:.1f} (x {times_robot_alone:.1f})",
}
_COLUMNS: Mapping[Kind, Mapping[str, Cell]] = {
    "curves": {
        "robot steps": "{robot_steps:,.0f}",
        "solved in {steps:,}": "{solved_in_common_steps:.0f} of {replicates}",
        "solved at all": "{solved:.0f} of {replicates}",
        "solved at": "{solved_at:,.0f}",
        "first crossing": "{first_crossing:,.0f}",
        "FAMLE faster by": "{famle_faster_by:,.0%}",
        "matches FAMLE": "{famle_matched_at:,.0f}",
        "2nd episode": "{second_episode_median:.1f}",
        f"its last {LAST}": partial(_spread, key="end"),
        **_TIMES,
    },
    "episode": {
        "above {threshold:g}": "{solved:.0f} of {replicates}",
        "walks on": "{walks_on:.0f} of {replicates}",
        "walks again": "{recovered:.0f} of {replicates}",
        "after steps": "{recovery:,.0f}",
        "the slowest of them": "{slowest_recovery:,.0f}",
        **_TIMES,
    },
    "gaits": {
        "steps, mean +- deviation": _deviation,
        "success rate": "{success:.0%}",
        "FAMLE faster by": "{famle_faster_by:,.0%}",
        "ms / plan": "{ms:.1f}",
    },
    "distance": {
        "max distance (m)": "{furthest_median:.1f}",
        "interaction time (s)": "{furthest_after_median:,.0f}",
        "FAMLE is there after (s)": "{famle_there_after:,.0f}",
        "falls": "{falls:.0f} of {replicates}",
        "ms / plan": "{ms:.1f}",
    },
}
"""The first table of each kind, as the paper's."""


# --- parts ------------------------------------------------------------------------------------------------------------


def _rows(figures: pd.DataFrame) -> list[Row]:
    """Lists the figures that are known, a row a method."""
    return [dict(row.dropna()) for _, row in figures.astype(object).iterrows()]


def _by_method(columns: Sequence[tuple[str, Cell]], rows: Sequence[Row]) -> str:
    """Writes a table with a row a method, without columns of which nothing is known."""
    filled = [[title, *(_cell(row, cell) for row in rows)] for title, cell in columns]
    known = [column for column in filled if set(column[1:]) != {"-"}]
    methods = ["method", *(row["label"] for row in rows)]
    titles, *lines = zip(methods, ["n", *(str(row["replicates"] or "-") for row in rows)], *known, strict=True)
    return _table(titles, lines)


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (titles, ["---"] * len(titles), *rows))


def _better_than_famle(study: Study, rows: Sequence[Row]) -> str:
    """Says who wins against FAMLE in what, so that nobody has to search for it."""
    wins = []
    for measure in study.measures:
        name = f"{measure.key}_famle_better"
        winners = [row["label"] for row in rows if row.get(name, 1) < 0.5 and row.get(f"{name}_p", 1) < _SIGNIFICANT]
        if winners:
            wins.append(f"{' / '.join(winners)} ({measure.label})")
    return f"Better than FAMLE, p < {_SIGNIFICANT}: {'; '.join(wins) or 'none'}."


def _sources(study: Study) -> str:
    """Says what runs the experiment, what is missing, and what made each of the results."""
    parts = [f"`{study.experiment.command}` runs this.", study.experiment.shared]
    if "oracle" not in study.methods:
        parts.append("No oracle has been measured here.")
    lines = [f"{' '.join(parts)} These results were made by:", ""]
    for (commit, command), methods in study.provenance.items():
        names = ", ".join(style_of(method).label + f" (`{method}`)" for method in methods)
        lines.append(f"- `{command}` at `{commit}`: {names}")
    return "\n".join(lines)


# --- all robots in one table ------------------------------------------------------------------------------------------


def _median(row: Row, key: str) -> str:
    return _spread(row, key) if row["replicates"] >= FEWEST else _rounded(row, f"{key}_median")[0]


def _solved(row: Row) -> str:
    never = "{solved:.0f} of {replicates} in {robot_steps:,.0f}"
    return (never if row["solved_at"] == float("inf") else "{solved_at:,.0f}").format_map(row)


def _success(row: Row) -> str:
    return f"{100 * row['success']:.0f} %" + (f", {_deviation(row)}" if "steps_mean" in row else "")


_HEADLINE: Sequence[tuple[str, str, Callable[[Row], str]]] = (
    ("reacher-paper", "arm: return of the first 50 steps", partial(_median, key="first_episode")),
    ("reacher-paper", "arm: solved after robot steps", _solved),
    ("ant-curves", "ant: return of the first 1,000 steps", partial(_median, key="first_episode")),
    ("ant-curves", "ant: solved after robot steps", _solved),
    ("quadruped-yaw", "quadruped, yaw error: success, gaits", _success),
    ("quadruped-leg", "... a leg blocked", _success),
    ("quadruped-both", "... both", _success),
    ("minitaur-held-out", "Minitaur: metres in 60 gaits", partial(_median, key="distance")),
)
"""The experiment, the heading and the cell of each column; experiments without results have none."""


def headline(figures: Mapping[str, pd.DataFrame]) -> str:
    """Writes the table of all robots: a row a method, a column for what each experiment has measured.

    Args:
        figures: A row a method, by the name of the experiment.
    """
    columns = [column for column in _HEADLINE if column[0] in figures]
    rows = {name: dict(zip(figures[name].index, _rows(figures[name]), strict=True)) for name, *_ in columns}
    measured = {method for table in rows.values() for method in table}
    methods = [method for method in in_order(measured) if style_of(method).headline]
    lines = []
    for method in methods:
        cells = (cell(rows[name][method]) if method in rows[name] else "" for name, _, cell in columns)
        lines.append([style_of(method).label, *cells])
    counts = []
    for name, table in rows.items():
        n = sorted({table[method]["replicates"] for method in methods if method in table})
        counts.append(f"{n[0]} to {n[-1]} ({name})" if len(n) > 1 else f"{n[0]} ({name})")
    return _table(["method", *(title for _, title, _ in columns)], lines) + f"\n\nReplicates: {', '.join(counts)}."


_SHORT: Sequence[tuple[str, str, str, Callable[[Row], str]]] = (
    ("reacher-paper", "arm, two faults", "return of the first 50 steps", partial(_median, key="first_episode")),
    (
        "ant-unseen",
        "ant, a dead joint and a wrong compass",
        "return of the first 1,000 steps",
        partial(_median, key="return"),
    ),
    ("quadruped-leg", "quadruped, a leg blocked", "reaches its goal, gaits", _success),
    ("quadruped-both", "quadruped, a leg blocked and a wrong compass", "reaches its goal, gaits", _success),
    ("a1-leg", "Unitree A1, a leg blocked", "reaches its goal, gaits", _success),
    ("a1-both", "Unitree A1, a leg blocked and a wrong compass", "reaches its goal, gaits", _success),
    ("minitaur-held-out", "Minitaur, nothing broken", "metres in 60 gaits", partial(_median, key="distance")),
)
"""The experiment, what is broken, what is measured and the cell of each row of the table for a first look."""


def in_short(figures: Mapping[str, pd.DataFrame]) -> str:
    """Writes the table for a first look: a row a robot and what is broken; with adaptation, without, and the oracle.

    Args:
        figures: A row a method, by the name of the experiment.
    """
    lines = []
    for name, broken, measured, cell in _SHORT:
        if name in figures:
            rows = dict(zip(figures[name].index, _rows(figures[name]), strict=True))
            cells = (cell(rows[method]) if method in rows else "" for method in ("famle", "famle-frozen", "oracle"))
            lines.append([broken, measured, *cells, str(rows["famle"]["replicates"]) if "famle" in rows else ""])
    return _table(("robot", "measured", "FAMLE", "the same without adaptation", "oracle", "runs"), lines)


def sine_section(title: str, stored: pd.DataFrame) -> str:
    """Writes the section of the paper's figure 2, which has no robot.

    Args:
        title: Of the section.
        stored: A row for each method and number of points.
    """
    errors = {(row["points"], row["method"]): row for row in stored.to_dict("records")}
    methods, spread = stored["method"].unique(), "{median:.3f} ({quartiles[0]:.3f} to {quartiles[1]:.3f})"
    rows = []
    for points in stored["points"].unique():
        better = f"{100 * errors[points, 'FAMLE']['famle_better_than_maml']:.0f} %"
        rows.append([str(points), *(spread.format_map(errors[points, method]) for method in methods), better])
    about = {**stored.iloc[0], "table": _table(["points", *methods, "FAMLE better than MAML"], rows)}
    return f"## {title}\n\n{_TEXTS['sine'].format_map(about)}"
