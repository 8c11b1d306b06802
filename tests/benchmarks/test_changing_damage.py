"""Robots whose damage changes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.changing_damage import BEDS, CHANGES, FLICKER, Args, faults, main, ramp, recovery, summary
from benchmarks.results import load
from famle_envs import Situation

ROOT = Path(__file__).parents[2]
INTACT, FIRST, SECOND = np.ones(3), np.array([1.0, 0.0, 1.0]), np.array([-1.0, 1.0, 1.0])


def test_faults_of_two_replicates_are_the_same_in_both_orders() -> None:
    for seed in range(0, 20, 2):
        first, second = faults(False, -1.0, 5, seed)
        assert sorted(first) == sorted(second) == [-1.0, 1.0, 1.0, 1.0, 1.0]
        assert np.argmin(first) != np.argmin(second)
        other_second, other_first = faults(False, -1.0, 5, seed + 1)
        assert (first == other_first).all()
        assert (second == other_second).all()
        healed_first, healed = faults(True, -1.0, 5, seed)
        assert (healed_first == first).all()
        assert (healed == 1.0).all()
    assert len({faults(False, 0.0, 5, seed)[0].tobytes() for seed in range(20)}) > 2


@pytest.mark.parametrize("change", CHANGES)
def test_all_changes_end_in_what_comes_after(change: str) -> None:
    steps = 40
    gains = CHANGES[change].gains(FIRST, SECOND, steps)
    assert gains.shape == (steps, 3)
    complete = gains[CHANGES[change].takes(steps) :]
    assert any((gain == SECOND).all() for gain in complete[:FLICKER])
    assert (complete == np.where(complete[:, :1] < 0, SECOND, INTACT)).all()


def test_slow_change_goes_in_equal_steps() -> None:
    gains = CHANGES["slow"].gains(FIRST, SECOND, 40)
    assert np.diff(gains, axis=0)[: ramp(40) - 1] == pytest.approx(np.tile((SECOND - FIRST) / 10, (9, 1)))
    assert gains[0] == pytest.approx(FIRST + (SECOND - FIRST) / 10)
    assert (gains[ramp(40) :] == SECOND).all()


def test_fault_that_flickers_comes_and_goes() -> None:
    there = (CHANGES["flickers"].gains(INTACT, SECOND, 4 * FLICKER) == SECOND).all(axis=1)
    assert there.tolist() == 2 * ([True] * FLICKER + [False] * FLICKER)


def test_recovery_counts_steps_until_most_of_what_comes_later() -> None:
    assert recovery(np.repeat([0.0, 1.0], [30, 70]), 8, 50) == 29  # 7 of the next 8 steps are as later
    assert recovery(np.ones(100), 10, 50) == 0
    assert recovery(np.repeat([-3.0, -1.0], [30, 70]), 10, 50) == 29
    assert recovery(np.repeat([5.0, 1.0], [30, 70]), 10, 50) == 0


@pytest.mark.usefixtures("small_reacher")
def test_arms_live_through_two_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = tmp_path / "cache"
    main(Args(robots=("arm",), methods=("heals",), replicates=1, jobs=1, out=tmp_path, cache=cache))
    assert "second fault" in capsys.readouterr().out
    (row,) = load(tmp_path / "changing-damage.csv").to_dict("records")
    assert row["method"] == "arm, heals"
    assert Situation.from_string(row["situation"]).motor_gain.count(-1.0) == 1
    assert row["later"] == "intact"
    assert len(row["rewards"]) == 30
    assert len(row["recovery"]) == 2
    assert min(row["levels"]) > 0.0


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(ValueError, match=r"There is no dog\. Known: arm, ant, halfcheetah"):
        main(Args(robots=("dog",)))
    with pytest.raises(ValueError, match=r"There is no rust\. Known: another"):
        main(Args(methods=("rust",)))


def test_summary_has_means_by_robot_and_kind() -> None:
    table = pd.DataFrame({"method": ["a", "a", "b"], "recovery": [[0, 2], [4, 4], [1, 1]]})
    table["levels"] = [[1.0, 2.0, 3.0], [3.0, 4.0, 5.0], [1.0, 1.0, 1.0]]
    assert summary(table).to_numpy().tolist() == [[2, 3, 2, 3, 4, 2], [1, 1, 1, 1, 1, 1]]


def test_manual_quotes_the_stored_results() -> None:
    section = (ROOT / "docs" / "results.md").read_text().partition("## Damage that changes")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (?:arm|ant|HalfCheetah): [^|]*\|(.*)\|$", section, re.MULTILINE)
    quoted = [[float(cell) for cell in row.split("|")] for row in rows]
    stored = summary(load(ROOT / "benchmarks" / "results" / "changing-damage.csv")).drop(columns="robots")
    wanted = stored.loc[[f"{robot}, {change}" for robot in BEDS for change in CHANGES]].to_numpy(dtype=float)
    np.testing.assert_allclose(np.array(quoted)[:, :2], wanted[:, :2], atol=0.0501)
    np.testing.assert_allclose(np.array(quoted)[:, 2:], wanted[:, 2:], atol=0.0051)
