"""The report's first table, all robots in one, which the README shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchmarks.reporting.looks import in_order, look
from benchmarks.reporting.statistics import FEWEST
from benchmarks.reporting.study import Study
from benchmarks.reporting.tables import Row, figures

__all__ = ["headline"]

METHODS = (
    *("famle", "ampc", "ampc-reptile", "ampc-fomaml", "ampc-maml", "ppo", "ppo-pretrained", "informed", "oracle"),
    *("famle-paper", "ampc-paper", "ampc-reptile-paper", "ampc-fomaml-paper", "ampc-maml-paper"),
    *("famle-original", "ampc-original", "ampc-reptile-original"),
)
"""What the table has rows for, where it was measured."""


def _median(row: Row, study: Study) -> str:
    key = study.measures[0].key
    low, median, high = (row[f"{key}_{name}"] for name in ("low", "median", "high"))
    decimals = 0 if abs(median) >= 100 else 1
    if row["replicates"] < FEWEST:
        return f"{median:.{decimals}f}"
    return f"{median:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"


def _solved(row: Row, study: Study) -> str:
    if np.isfinite(row["solved_at"]):
        return f"{row['solved_at']:,.0f}"
    return f"{row['solved']} of {row['replicates']} in {row['robot_steps']:,}"


def _gaits(row: Row, study: Study) -> str:
    mean = row["steps_mean"]
    deviation = "" if row["steps_deviation"] is None else f" +- {row['steps_deviation']:.1f}"
    return f"{100 * row['success']:.0f} %" + ("" if mean is None else f", {mean:.1f}{deviation}")


COLUMNS: Sequence[tuple[str, str, Callable[[Row, Study], str]]] = (
    ("reacher-paper", "arm: return of the first 50 steps", _median),
    ("reacher-paper", "arm: solved after robot steps", _solved),
    ("ant-curves", "ant: return of the first 1,000 steps", _median),
    ("ant-curves", "ant: solved after robot steps", _solved),
    ("quadruped-yaw", "quadruped, yaw error: success, gaits", _gaits),
    ("quadruped-leg", "... a leg blocked", _gaits),
    ("quadruped-both", "... both", _gaits),
    ("minitaur-held-out", "Minitaur: metres in 60 gaits", _median),
)
"""The experiment, the heading and the cell of each column; experiments without results have none."""


def headline(studies: Sequence[Study]) -> str:
    """The table in Markdown: a row a method, a column an experiment."""
    by_folder = {study.experiment.folder: study for study in studies}
    rows = {folder: {row["method"]: row for row in figures(study)} for folder, study in by_folder.items()}
    columns = [column for column in COLUMNS if column[0] in rows]
    methods = in_order({method for folder, *_ in columns for method in rows[folder]} & set(METHODS))
    table = [["method", *(title for _, title, _ in columns)], ["---"] * (len(columns) + 1)]
    for method in methods:
        cells = [
            cell(row, by_folder[folder]) if (row := rows[folder].get(method)) else "" for folder, _, cell in columns
        ]
        table.append([look(method).label, *cells])
    counts = {folder: _replicates(rows[folder]) for folder, *_ in columns}
    lines = [f"| {' | '.join(line)} |" for line in table]
    return "\n".join([*lines, "", f"Replicates: {', '.join(f'{n} ({folder})' for folder, n in counts.items())}."])


def _replicates(rows: Mapping[str, Row]) -> str:
    counts = [row["replicates"] for method, row in rows.items() if method in METHODS]
    return f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else str(counts[0])
