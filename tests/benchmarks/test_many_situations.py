"""More training situations than the paper's."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from benchmarks import many_situations
from benchmarks.many_situations import Args, Set, drawn, summary
from benchmarks.results import load
from famle_agent import FAMLE
from famle_envs.reacher import ReacherEnv

LITTLE: dict[str, Any] = {"transitions_per_situation": 20, "meta_iterations": 2, "candidates": 4, "elites": 2}


def test_situations_are_drawn_once_and_others_for_each_split() -> None:
    test, train = drawn(0, 30), drawn(1, 30)
    assert len({*test, *train, *ReacherEnv.training_situations}) == 60 + len(ReacherEnv.training_situations)
    assert drawn(1, 30) == train


def test_agents_of_few_and_more_situations_live_on_the_same_arms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(many_situations, "FAMLE", partial(FAMLE, **LITTLE))
    monkeypatch.setattr(many_situations, "SETS", {"few": Set(0, compose=False), "more": Set(2, compose=False)})
    many_situations.main(Args(sets=("few", "more"), replicates=1, jobs=1, out=tmp_path, cache=tmp_path / "cache"))
    assert "episode 2, worst" in capsys.readouterr().out
    table = load(tmp_path / "many-situations.csv")
    assert list(table["method"]) == ["few", "more"]
    assert table["situation"].nunique() == 1
    assert (table["judge_ms"] > 0).all()


def test_summary_has_means_and_worst_returns_of_each_episode() -> None:
    lives = [("a", [10.0, 20.0]), ("a", [30.0, 40.0]), ("b", [1.0, 2.0])]
    table = pd.DataFrame([{"method": m, "returns": r, "cpu_seconds": 9.0, "judge_ms": 1.0} for m, r in lives])
    found = summary(table)
    assert found.loc["a", ["episode 1", "episode 2", "episode 1, worst"]].tolist() == [20.0, 30.0, 10.0]
    assert found.loc["b", "cpu_seconds"] == 9.0
