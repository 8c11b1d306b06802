from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.fuzz import READERS, ReaderName, promised
from benchmarks.interruptions import KINDS, WORKS, attempt
from benchmarks.results import load
from benchmarks.robustness import PARTS, Args, changed, main, repeated

ROOT = Path(__file__).parents[2]

FOUND: dict[ReaderName, list[bytes]] = {
    "situation": [
        f"friction x {'1' * 30_000}z".encode(),
        b"joint 0 sensor off by 1e999 deg",
        b"motor 1 delayed by 999999999 steps",
        "joint \u0663 dead".encode(),
        b"paper + paper",
        b"",
    ],
    "settings": [
        b"hidden: [999999999999999999999]",
        b"planner: [icem]",
        b"horizon: &a [*a]",
        b"members: .nan",
        b"[" * 999,
    ],
    "checkpoint": [
        b"\x02",
        b"\x00" + b"[" * 9_999,
        b'\x00{"format": "famle-agent", "version": 2}',
        b"\x01" + b"\xff" * 9,
    ],
    "transitions": [b"\x05", b"\x05PK\x05\x06" + b"\xff" * 18, b"\x00\x93NUMPY\x01\x00\xff\x00" + b"(" * 255],
    "progress": [b"\x02", b"\x02\x80\x04.", b'\x00{"items": [["done", {"tensor": []}]]}', b'\x00{"items": [1]}'],
    "folder": [b"", b"[]", b"\xff", b"{" * 9_999],
    "results": [b"", b"a\n" + b"[" * 9_999, b"method,seed\nfamle,1,2,3\n", b"\xff\xfe"],
}
"""Inputs at which a reader may fail otherwise than it promises; fuzzing found some of them."""


@pytest.mark.parametrize("name", READERS)
def test_reader_raises_what_it_promises_alone(name: ReaderName, tmp_path: Path) -> None:
    read, seeds = READERS[name](tmp_path)
    for seed in seeds:
        read(seed)
    rng = np.random.default_rng(0)
    for data in [*FOUND[name], *(changed(seeds[i % len(seeds)], rng) for i in range(50))]:
        promised(read, data)


def test_what_is_changed_is_another_input() -> None:
    rng, data = np.random.default_rng(0), bytes(range(100))
    others = {changed(data, rng) for _ in range(50)}
    assert len(others) > 40
    assert all(other[:1] == data[:1] for other in others)


@pytest.mark.slow
@pytest.mark.parametrize("what", WORKS)
def test_work_that_is_interrupted_loses_nothing(what: str, tmp_path: Path) -> None:
    work = WORKS[what]
    whole = attempt(work, tmp_path / "whole")
    assert whole.error is None
    assert re.fullmatch(r"[0-9a-f]{16,}", whole.digest)
    for how, interrupt in KINDS.items():
        assert interrupt(work, tmp_path / how, whole, 0.5) == "", how


def test_lost_bits_are_seen(tmp_path: Path) -> None:
    """Work that does not go on where it was, and does not do the same again."""
    whole = attempt(_other_each_time, tmp_path / "whole")
    assert KINDS["kill -9"](_other_each_time, tmp_path / "killed", whole, 0.5) == "it ended with other bits"


def _other_each_time(folder: Path) -> str:
    return str(np.random.default_rng().integers(2**60))


@pytest.mark.slow
def test_all_parts_are_tried_and_stored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parts = tuple(part for part in PARTS if part not in ("interruptions", "files", "learning"))
    main(Args(parts, steps=100, environments=15, out=tmp_path))
    table = load(tmp_path / "robustness.csv")
    assert set(table["part"]) == set(parts)
    assert (table["wrong"] == 0).all()
    assert "make() and close()" in capsys.readouterr().out


@pytest.mark.slow
def test_robots_and_agents_are_let_go(tmp_path: Path) -> None:
    """In a process of its own, since a measurement of coverage keeps objects for each thread."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    sizes = ["--environments", "20", "--learns", "10", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "benchmarks.robustness", "--parts", "environments", "learning", *sizes]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    table = load(tmp_path / "robustness.csv")
    assert list(table["part"]) == ["environments", "learning", "learning"], done.stderr
    for lines in table["what"]:
        assert [line for line in lines or () if "memory" not in line] == []  # which takes longer to settle


LEAKS: dict[str, Callable[[list[Any]], Any]] = {
    "files": lambda held: Path(__file__).open(),  # noqa: SIM115
    "objects": lambda held: [held],
    "memory": lambda held: np.ones(6_000_000),  # 48 MB, which no memory that was freed before can hold
    "nothing": lambda held: held,
}


@pytest.mark.parametrize("leak", LEAKS)
def test_leaks_are_seen(leak: str) -> None:
    held = list[Any]()
    row = repeated("something", 10, lambda _: held.append(LEAKS[leak](held)))
    assert bool(row.wrong) == (leak != "nothing")
    assert leak == "nothing" or any(leak in line for line in row.wrong)
    for one in held:
        if leak == "files":
            one.close()


def test_nothing_else_can_be_tried() -> None:
    with pytest.raises(ValueError, match=r"There is no part luck\. Parts: interruptions, files"):
        Args(parts=("luck",))
