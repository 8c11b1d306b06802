from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks.results import load, provenance, store

ROWS: list[dict[str, Any]] = [
    {"method": "famle", "seed": 10, "settings": "12345678", "returns": [0.1, 1 / 3], "reached": True, "later": None},
    {"method": "famle", "seed": 9, "settings": "1e234567", "ms": {"mean": 23.27}, "reached": False, "gaits": 80},
]


def test_table_holds_what_was_stored_digit_by_digit_and_sorted_by_seed(tmp_path: Path) -> None:
    store(tmp_path / "table.csv", ROWS)
    second, first = load(tmp_path / "table.csv").to_dict("records")
    assert (first["seed"], second["seed"]) == (10, 9)
    for row, stored in zip(ROWS, (first, second), strict=True):
        assert {name: stored[name] for name, value in row.items() if value is not None} == {
            name: value for name, value in row.items() if value is not None
        }
    assert pd.isna(first["later"])
    assert pd.isna(first["gaits"])


def test_row_takes_the_place_of_the_one_with_the_same_keys(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    store(path, [{"method": "famle", "seed": seed, "value": 1} for seed in (0, 1)])
    store(path, [{"method": "famle", "seed": 1, "value": 2, "more": 3}])
    assert load(path)["value"].tolist() == [1, 2]
    store(path, [{"method": "famle", "seed": seed, "value": seed} for seed in (7, 8)], keys=("method",))
    assert load(path)["seed"].tolist() == [7, 8]


def store_seeds(path: Path, seeds: range) -> None:
    for seed in seeds:
        store(path, [{"method": "famle", "seed": seed}])


def test_processes_that_store_at_the_same_time_lose_no_row(tmp_path: Path) -> None:
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(partial(store_seeds, tmp_path / "table.csv"), (range(8), range(8, 16))))
    assert load(tmp_path / "table.csv")["seed"].tolist() == list(range(16))
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_missing_and_damaged_tables_are_named(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    with pytest.raises(FileNotFoundError, match=r"table\.csv does not exist; run the benchmark"):
        load(path)
    for content in ("", 'method,seed,returns\nfamle,0,"[1, 2"\n'):
        path.write_text(content)
        with pytest.raises(ValueError, match=r"table\.csv is damaged .*restore it"):
            load(path)


@pytest.mark.parametrize(
    "out", [["--out", "/some/where"], ["--out=/some/where"], ["--cache", "/some/where", "--out=/b"], []]
)
def test_command_of_a_result_names_no_path_of_a_machine(out: list[str]) -> None:
    argv = ["/a/machine/benchmarks/reacher.py", "--jobs", "1", *out, "--methods", "ppo"]
    origin = provenance(argv)
    assert origin["command"] == "python -m benchmarks.reacher --jobs 1 --methods ppo"
    assert origin["versions"]["numpy"] == np.__version__
    assert json.dumps(origin)
