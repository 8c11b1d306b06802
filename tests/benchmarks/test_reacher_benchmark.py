from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import reacher
from benchmarks.reporting.registry import style_of
from benchmarks.results import load
from famle_envs.reacher import ReacherEnv
from tests.small_reacher import EPISODE


def test_test_damages_are_unseen_and_differ_between_replicates() -> None:
    drawn = [reacher.situation_of("random", seed) for seed in range(20)]
    assert not set(drawn) & set(ReacherEnv.training_situations)
    assert len(set(drawn)) == 20
    assert reacher.situation_of("paper", 0) == reacher.situation_of("paper", 1)


@pytest.mark.usefixtures("small_reacher")
def test_reacher_benchmark_runs_methods_and_reports(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    methods, budget = ("famle", "famle-frozen", "ampc", "ppo"), {"steps": 3 * EPISODE, "ppo_steps": 4 * EPISODE}
    args = reacher.Args(
        methods=methods, replicates=1, jobs=1, out=tmp_path / "results", cache=tmp_path / "cache", **budget
    )
    reacher.main(args)
    table = capsys.readouterr().out
    assert all(style_of(method).label in table for method in methods)
    returns = load(tmp_path / "results" / "reacher-paper.csv").set_index("method")["returns"]
    assert set(returns.index) == set(methods)
    assert len(returns["famle"]) == 3
    assert returns["famle"] != returns["famle-frozen"]
