from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.reporting.registry import EXPERIMENTS
from benchmarks.reporting.study import over_steps, read_study
from tests.stored_results import store


def test_values_follow_each_replicate_s_own_episodes() -> None:
    long = pd.Series([1.0, 3.0], index=[100, 200])
    short = pd.Series([1.0, 1.0, 5.0], index=[50, 100, 150])
    together = over_steps([long, short])
    assert together.index.tolist() == [50, 100, 150]
    assert together.median(axis="columns").tolist() == [1.0, 1.0, 4.0]


def test_mean_return_weights_episodes_by_their_steps_within_the_common_ones(tmp_path: Path) -> None:
    store(tmp_path, "reacher-paper", "a", 0, returns=[10.0, 20.0], lengths=[50, 50], seconds_per_step=0.1)
    store(tmp_path, "reacher-paper", "b", 0, returns=[10.0, 40.0, 99.0], lengths=[80, 40, 10], seconds_per_step=0.1)
    study = read_study(EXPERIMENTS[0], tmp_path)
    assert study is not None
    assert study.steps == 100
    scores = study.scores.set_index("method")
    assert scores["mean_return"].tolist() == [15.0, pytest.approx(0.8 * 10.0 + 0.2 * 40.0)]
    assert scores["last"].tolist() == [15.0, 10.0]
