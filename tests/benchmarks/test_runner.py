from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from benchmarks import reacher
from benchmarks.methods import Method
from benchmarks.reporting.report import Report
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Options, ReplicateError, compare, launch, run_batches
from benchmarks.task import Task
from tests.small_reacher import task_of


def squared(seeds: tuple[int, ...], log: Path) -> list[Result]:
    with log.open("a") as file:
        file.writelines(f"{seed}\n" for seed in seeds)
    if 2 in seeds:
        raise ArithmeticError("a replicate fails")
    return [{"value": seed**2} for seed in seeds]


def batch(log: Path, *seeds: int) -> Batch:
    return Batch("method", seeds, partial(squared, seeds, log))


def test_finished_replicates_are_stored_and_not_run_again(tmp_path: Path) -> None:
    table, log = tmp_path / "table.csv", tmp_path / "log"
    for _ in range(2):
        run_batches([batch(log, 0), batch(log, 1, 3)], table, jobs=1)
    assert log.read_text().split() == ["0", "1", "3"]
    results = load(table)
    assert (results["value"].tolist(), results["seed"].tolist()) == ([0, 1, 9], [0, 1, 3])
    assert results["fleet"].dropna().tolist() == [2, 2]
    assert {"command", "commit", "versions", "wall_seconds", "method"} <= set(results)
    run_batches([batch(log, 1), batch(log, 3, 4)], table, jobs=1)
    assert log.read_text().split() == ["0", "1", "3", "3", "4"]  # of a batch all, where one is missing


def test_failing_replicate_ends_no_other(tmp_path: Path) -> None:
    """It is named, and raises when all others are stored."""
    table, log = tmp_path / "table.csv", tmp_path / "log"
    with pytest.raises(ReplicateError, match=r"method, seed 2: (.|\n)*ArithmeticError: a replicate fails"):
        run_batches([batch(log, seed) for seed in range(4)], table, jobs=1)
    assert load(table)["seed"].tolist() == [0, 1, 3]


def test_batch_that_forgets_a_replicate_is_not_stored(tmp_path: Path) -> None:
    with pytest.raises(ReplicateError, match="shorter"):
        run_batches([Batch("method", (0, 1), lambda: [{"value": 0}])], tmp_path / "table.csv", jobs=1)
    assert not list(tmp_path.iterdir())


def test_missing_ray_is_named_with_its_remedy_before_anything_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)  # as if it were not installed
    with pytest.raises(ImportError, match=r'pip install "famle\[ray\]"'):
        run_batches([batch(tmp_path / "log", 0)], tmp_path / "table.csv", jobs=1, backend="ray")
    assert not list(tmp_path.iterdir())
    run_batches([], tmp_path / "table.csv", jobs=1, backend="ray")  # nothing to run needs no cluster


# --- methods on test robots -----------------------------------------------------------------------------------


@pytest.fixture
def calls() -> list[str]:
    """What was done, in order."""
    return []


@pytest.fixture
def play(calls: list[str], tmp_path: Path) -> Callable[..., Path]:
    """Compares methods that only say what they do; "fleet" has robots that act in step."""

    def none(task: Any) -> Any:
        raise NotImplementedError

    def learning(name: str) -> Callable[[Task], object]:
        return lambda task: calls.append(f"{name} learns")

    def diverging(task: Task) -> object:
        raise ArithmeticError("the learning diverges")

    known = {name: Method(none, learning(name)) for name in ("one", "other")}
    known["diverging"] = Method(none, diverging)
    known["fleet"] = replace(known["one"], learn=learning("fleet"), fleet=none)

    def run(method: str, tasks: Sequence[Task]) -> list[Result]:
        seeds = [task.seed for task in tasks]
        calls.append(f"{method} {seeds}")
        if (method, seeds) == ("one", [13]):
            raise ArithmeticError("a replicate fails")
        return [{"value": seed} for seed in seeds]

    def compared(names: Sequence[str], seeds: Sequence[int], in_step: int = 30, together: bool = True) -> Path:
        tasks, table = [task_of(seed, tmp_path) for seed in seeds], tmp_path / "table.csv"
        compare(names, tasks, run, table, Options(jobs=1, in_step=in_step), known, together)
        return table

    return compared


def test_method_learns_once_before_its_replicates(play: Callable[..., Path], calls: list[str]) -> None:
    results = load(play(["one", "other"], [0, 1]))
    assert calls == ["one learns", "one [0]", "one [1]", "other learns", "other [0]", "other [1]"]
    assert results[["method", "value"]].to_numpy().tolist() == [["one", 0], ["one", 1], ["other", 0], ["other", 1]]


def test_what_is_stored_is_neither_learnt_nor_run_again(play: Callable[..., Path], calls: list[str]) -> None:
    play(["one", "fleet"], [0, 1])
    calls.clear()
    play(["one", "fleet"], [1, 0])
    assert calls == []
    play(["one", "fleet"], [0, 2])
    assert calls == ["one learns", "one [2]", "fleet learns", "fleet [0, 2]"]


def test_robots_act_in_step_where_method_and_benchmark_can(play: Callable[..., Path], calls: list[str]) -> None:
    play(["fleet"], [4, 5, 6], in_step=2)
    assert calls == ["fleet learns", "fleet [4, 5]", "fleet [6]"]
    calls.clear()
    play(["fleet"], [2, 3], together=False)
    assert calls == ["fleet learns", "fleet [2]", "fleet [3]"]


def test_unknown_method_is_refused_before_anything_runs(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ValueError, match=r"no method 'magic'\. Methods: one, other, diverging, fleet"):
        play(["one", "magic"], [0])
    assert calls == []


def test_failures_do_not_end_the_other_methods(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ReplicateError, match=r"diverging could not be learnt.*the learning diverges"):
        play(["diverging", "one", "other"], [13])
    assert calls == ["one learns", "one [13]", "other learns", "other [13]"]


# --- the command line -----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("tiny_budgets")
def test_benchmark_and_report_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small = ["--replicates", "1", "--ppo-steps", "200", "--jobs", "1"]
    launch(reacher.main, reacher.Args, ["--methods", "ppo", *small])
    (lengths,) = load(tmp_path / "benchmarks/results/reacher-paper.csv")["lengths"]
    assert sum(lengths) > 100  # whole episodes of 200 steps
    launch(Report.__call__, Report, [])
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
            launch(main, arguments, args)
        assert caught.value.code == 2
        error = capsys.readouterr().err
        assert message in " ".join(error.split())
        assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_table_that_vanishes_is_told_of(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"

    def remove() -> list[dict[str, int]]:
        table.unlink(missing_ok=True)
        return [{"x": 1}]

    batches = [Batch("method", (0,), lambda: [{"x": 0}]), Batch("method", (1,), remove)]
    with pytest.raises(ReplicateError, match="lost rows while others came"):
        run_batches(batches, table, 1)
    run_batches(batches[:1], table, 1)
    assert load(table)["x"].tolist() == [0, 1]
