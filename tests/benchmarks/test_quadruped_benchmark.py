from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from benchmarks import minitaur, quadruped
from benchmarks.methods import METHODS
from benchmarks.reporting.registry import style_of
from benchmarks.reporting.report import show
from benchmarks.results import load
from benchmarks.runner import compare
from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.quadruped import QuadrupedEnv


@pytest.mark.parametrize("robot", ["quadruped", "a1"])
def test_tests_are_run_on_held_out_dynamics_and_on_damage_that_no_training_situation_has(
    robot: Literal["quadruped", "a1"],
) -> None:
    args = quadruped.Args(robot=robot)
    for experiment in ("yaw", "leg", "both", "later"):
        for seed in range(4):
            task = quadruped.task_of(experiment, seed, args)
            assert (task.robot, task.profile) == (robot, "held-out")
            test = task.later or task.situation
            assert test not in QuadrupedEnv.training_situations
            assert not test.is_intact
    legs = {quadruped.task_of("leg", seed, args).situation.locked_joints for seed in range(12)}
    assert legs == {(0, 1, 2), (3, 4, 5), (6, 7, 8), (9, 10, 11)}


def test_minitaur_is_tested_on_held_out_dynamics_too() -> None:
    assert minitaur.task_of("held-out", 0, minitaur.Args()).profile == "held-out"
    assert minitaur.task_of("home", 0, minitaur.Args()).profile == "simulator"


@pytest.mark.slow
def test_replicate_is_stored_with_its_profile_and_summed_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args, table = quadruped.Args(cache=tmp_path, jobs=1), tmp_path / "quadruped-yaw.csv"
    compare(("famle", "famle-frozen"), [quadruped.task_of("yaw", 0, args)], quadruped.run, table, args)
    results = load(table).to_dict("records")
    for result in results:
        assert result["profile"].startswith("held-out: motor_strength 0.03")
        assert len(result["path"]) == result["gaits"] + 1
        assert result["distance"] == pytest.approx(result["path"][-1][0], abs=1e-3)
        assert result["reached"] == (np.hypot(2.5 - result["path"][-1][0], result["path"][-1][1]) < 0.25)
    assert results[1]["believed"] == "intact"
    show(tmp_path, "quadruped-yaw")
    shown = capsys.readouterr().out
    assert all(style_of(method).label in shown for method in ("famle", "famle-frozen"))


@pytest.mark.parametrize("robot", ["quadruped", "a1", "minitaur"])
@pytest.mark.parametrize("method", ["famle", "famle-frozen", "famle-nearest"])
def test_methods_are_the_shipped_agent_with_something_changed(robot: str, method: str, tmp_path: Path) -> None:
    agent: Any = METHODS[method].agent(Task(robot, 3, Situation(), tmp_path, "held-out"))
    adaptation = agent.config.adaptation
    assert agent.dynamics is not None
    assert (adaptation.every == 0) == (method == "famle-frozen")
    assert (adaptation.gradient is None) == (method == "famle-nearest")
    agent.get_env().close()
