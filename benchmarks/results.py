"""Results: one CSV table an experiment, with a row a replicate.

Text stands in a cell as it is; all other values stand there as JSON, so that numbers lose no digit. A cell is empty
where a value is None or was not measured.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pandas as pd

from famle_agent.utils.atomic_write import whole_file

Result = dict[str, Any]
"""What is stored of a replicate, by column."""

_TEXT = {
    *("method", "situation", "later", "believed", "profile", "settings", "device", "command", "commit"),
    *("robot", "fault", "part", "figure", "data", "candidates", "adaptation", "title", "machine"),
}
"""Columns of text. A setting's name such as 12345678 is no number."""

_PACKAGES = (
    *("famle", "gymnasium", "matplotlib", "mujoco", "numpy", "pybullet", "scipy", "stable-baselines3", "torch"),
)


def load(path: Path) -> pd.DataFrame:
    """Reads a table.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is damaged.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; run the benchmark first.")
    try:
        table = _read(path)
        for name in table.columns.difference(list(_TEXT)):
            table[name] = pd.Series([None if pd.isna(cell) else json.loads(cell) for cell in table[name]])
    except (RecursionError, ValueError, pd.errors.ParserError) as error:
        raise ValueError(f"{path} is damaged ({error}): restore it from git, or delete its damaged rows.") from error
    return table


def store(path: Path, rows: Sequence[Result], keys: Sequence[str] = ("method", "seed")) -> None:
    """Adds rows to a table, in place of those with the same keys.

    The file is replaced as a whole, and other processes wait meanwhile, so that no row is lost.

    Args:
        path: The table, which need not exist.
        rows: What to add.
        keys: Columns of which a row has the keys; the table is sorted by them.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame([{name: _cell(name, value) for name, value in row.items()} for row in rows])
    names = list(keys)
    with _locked(path.parent):
        if path.exists():
            old = _read(path)
            replaced = pd.MultiIndex.from_frame(old[names]).isin(pd.MultiIndex.from_frame(table[names]))
            table = pd.concat([old[~replaced], table])
        with whole_file(path) as partial:
            table.sort_values(names, key=_sortable, kind="stable").to_csv(partial, index=False, lineterminator="\n")


def provenance(argv: Sequence[str]) -> Result:
    """Tells what it takes to run something again: command, commit and versions."""
    return {
        "command": " ".join(_command(argv)),
        "commit": _commit(),
        "versions": {"python": platform.python_version()} | dict(_versions()),
    }


def _versions() -> Iterator[tuple[str, str]]:
    """Of the packages that are installed; PyBullet need not be."""
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            yield name, version(name)


def _read(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype=object, keep_default_na=False, na_values=[""])


def _cell(name: str, value: Any) -> str | None:
    if value is None:
        return None
    return str(value) if name in _TEXT else json.dumps(value)


def _sortable(column: pd.Series[Any]) -> pd.Series[Any]:
    return column if column.name in _TEXT else column.map(json.loads)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps other processes from writing tables in a folder."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _commit() -> str:
    """Names the commit of this code as git does, with "-dirty" where it was changed since; "unknown" without git."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parent,
    )
    return described.stdout.strip() or "unknown"


_FOLDERS = ("--out", "--cache")


def _command(argv: Sequence[str]) -> list[str]:
    """Writes the command line as a user types it, without paths of a machine: of the program, and of its folders."""
    script, arguments = Path(argv[0]), list(argv[1:])
    paths = {i + 1 for i, argument in enumerate(arguments) if argument in _FOLDERS}
    arguments = [a for i, a in enumerate(arguments) if a.split("=")[0] not in _FOLDERS and i not in paths]
    if script.parent.name == "benchmarks":
        return ["python", "-m", f"benchmarks.{script.stem}", *arguments]
    return [script.name, *arguments] if script.suffix != ".py" else ["python", script.name, *arguments]
