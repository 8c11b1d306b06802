from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import command, reacher
from benchmarks.reporting.report import Report

pytestmark = pytest.mark.usefixtures("tiny_budgets")


def test_benchmark_and_report_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["--replicates", "1", "--ppo-steps", "200", "--jobs", "1"]
    command.run(reacher.main, reacher.Args, ["--methods", "ppo", *small])
    stored = json.loads((tmp_path / "benchmarks/results/reacher-paper/ppo-0.json").read_text())
    assert sum(stored["lengths"]) > 100  # whole episodes of 200 steps
    command.run(Report.__call__, Report, [])
    assert "PPO" in (tmp_path / "benchmarks/report/report.md").read_text()
    assert "report.md" in capsys.readouterr().out


def test_mistakes_end_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for main, arguments, args, message in (
        (reacher.main, reacher.Args, ["--methods", "magic"], "no method 'magic'"),
        (Report.__call__, Report, [], "holds no results; run a benchmark first"),
    ):
        with pytest.raises(SystemExit) as caught:
            command.run(main, arguments, args)
        assert caught.value.code == 2
        error = capsys.readouterr().err
        assert message in " ".join(error.split())
        assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []
