from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.compare import compare
from benchmarks.harness import Options, ReplicateError, Result, load_results
from benchmarks.methods import Method
from benchmarks.task import Task
from tests.small_reacher import task_of


@pytest.fixture
def calls() -> list[str]:
    """What was done, in order."""
    return []


@pytest.fixture
def play(calls: list[str], tmp_path: Path) -> Callable[..., Path]:
    """Compares methods that only say what they do; "fleet" has robots that act in step."""

    def none(task: Task) -> Any:
        raise NotImplementedError

    def learning(name: str) -> Callable[[Task], object]:
        return lambda task: calls.append(f"{name} learns")

    def diverging(task: Task) -> object:
        raise ArithmeticError("the learning diverges")

    known = {name: Method(none, learning(name)) for name in ("one", "other")}
    known["diverging"] = Method(none, diverging)
    known["fleet"] = replace(known["one"], learn=learning("fleet"), fleet=none)

    def run(method: str, task: Task) -> Result:
        calls.append(f"{method} {task.seed}")
        if (method, task.seed) == ("one", 13):
            raise ArithmeticError("a replicate fails")
        return {"value": task.seed}

    def run_fleet(method: str, tasks: Sequence[Task]) -> list[Result]:
        calls.append(f"{method} {[task.seed for task in tasks]}")
        return [{"value": task.seed} for task in tasks]

    def compared(names: Sequence[str], seeds: Sequence[int], in_step: int = 30) -> Path:
        tasks = [task_of(seed, tmp_path) for seed in seeds]
        folder = tmp_path / "results"
        options = Options(jobs=1, in_step=in_step)
        compare(names, tasks, run, folder, options, known, run_fleet if in_step else None)
        return folder

    return compared


def test_method_learns_once_before_its_replicates(play: Callable[..., Path], calls: list[str]) -> None:
    folder = play(["one", "other"], [0, 1])
    assert calls == ["one learns", "one 0", "one 1", "other learns", "other 0", "other 1"]
    assert [(result["method"], result["value"]) for result in load_results(folder)] == [
        *(("one", 0), ("one", 1)),
        *(("other", 0), ("other", 1)),
    ]


def test_what_is_stored_is_neither_learnt_nor_run_again(play: Callable[..., Path], calls: list[str]) -> None:
    play(["one", "fleet"], [0, 1])
    calls.clear()
    play(["one", "fleet"], [1, 0])
    assert calls == []
    play(["one", "fleet"], [0, 2])
    assert calls == ["one learns", "one 2", "fleet learns", "fleet [0, 2]"]


def test_robots_act_in_step_where_method_and_benchmark_can(play: Callable[..., Path], calls: list[str]) -> None:
    folder = play(["fleet"], [0, 1])
    assert calls == ["fleet learns", "fleet [0, 1]"]
    assert [(result["seed"], result["value"], result["fleet"]) for result in load_results(folder)] == [
        *((0, 0, 2), (1, 1, 2)),
    ]
    calls.clear()
    play(["fleet"], [2, 3], in_step=0)
    assert calls == ["fleet learns", "fleet 2", "fleet 3"]
    calls.clear()
    play(["fleet"], [4, 5, 6], in_step=2)
    assert calls == ["fleet learns", "fleet [4, 5]", "fleet [6]"]


def test_unknown_method_is_refused_before_anything_runs(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ValueError, match=r"no method 'magic'\. Methods: one, other, diverging, fleet"):
        play(["one", "magic"], [0])
    assert calls == []


def test_failing_replicate_does_not_end_the_others(play: Callable[..., Path], calls: list[str], tmp_path: Path) -> None:
    with pytest.raises(ReplicateError):
        play(["one"], [0, 13, 1])
    assert calls == ["one learns", "one 0", "one 13", "one 1"]
    assert [result["seed"] for result in load_results(tmp_path / "results")] == [0, 1]


def test_failing_replicate_does_not_end_the_other_methods(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ReplicateError):
        play(["one", "other"], [13])
    assert "other 13" in calls


def test_learning_that_fails_does_not_end_the_other_methods(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ReplicateError, match=r"diverging could not be learnt.*the learning diverges"):
        play(["diverging", "other"], [0])
    assert calls == ["other learns", "other 0"]
