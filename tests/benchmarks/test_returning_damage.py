"""Robots whose damage comes back."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks import returning_damage
from benchmarks.results import load
from benchmarks.returning_damage import LIBRARY_SIZES, Args, damage, main, summary
from famle_envs import Situation

ROOT = Path(__file__).parents[2]


def test_damage_is_of_three_motors_and_not_of_training() -> None:
    gains = np.array([damage(5, seed).motor_gain for seed in range(20)])
    assert ((gains < 1.0).sum(axis=1) == 3).all()
    assert (np.abs(gains[gains < 1.0]) <= 0.5).all()
    assert len(np.unique(gains, axis=0)) == 20


@pytest.mark.usefixtures("small_reacher")
def test_arms_meet_their_damage_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, steps in {"BROKEN": 60, "REPAIRED": 20, "AGAIN": 20}.items():
        monkeypatch.setattr(returning_damage, name, steps)
    main(Args(robots=("arm",), replicates=1, jobs=1, out=tmp_path, cache=tmp_path / "cache"))
    assert "arm, library" in capsys.readouterr().out
    table = load(tmp_path / "returning-damage.csv")
    assert set(table["method"]) == {"arm, library", "arm, without library"}
    assert {Situation.from_string(text) for text in table["situation"]} == {damage(5, 0)}
    for row in table.to_dict("records"):
        assert len(row["rewards"]) == len(row["errors"]) == 2
        assert min(row["rewards"] + row["errors"]) > 0.0


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(ValueError, match=r"There is no dog\. Known: arm"):
        Args(robots=("dog",))
    with pytest.raises(ValueError, match=r"There is no book\. Known: without library, library"):
        Args(methods=("book",))


def test_summary_has_means_of_the_first_steps() -> None:
    table = pd.DataFrame({"method": ["a", "a"], "errors": [[2.0] * 10, [4.0] * 10]})
    table["rewards"] = [[1.0, 3.0, *[5.0] * 8]] * 2
    assert summary(table).to_numpy().tolist() == [[3.0, 2.0, 3.0, 3.8, 3.0, 4.4, 2.0]]


def test_manual_quotes_the_stored_results() -> None:
    section = (ROOT / "docs" / "results.md").read_text().partition("## Damage that comes back")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (?:arm|ant|HalfCheetah): [^|]*\|(.*)\|$", section, re.MULTILINE)
    quoted = [[float(cell) for cell in row.split("|")] for row in rows]
    stored = summary(load(ROOT / "benchmarks" / "results" / "returning-damage.csv")).drop(columns="robots")
    methods = [f"{robot}, {method}" for robot in ("arm", "ant", "halfcheetah") for method in LIBRARY_SIZES]
    np.testing.assert_allclose(quoted, stored.loc[methods].to_numpy(dtype=float), atol=0.0051)
