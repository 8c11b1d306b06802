from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchmarks import sim_to_sim
from benchmarks.methods import METHODS, famle
from benchmarks.results import Result, load
from benchmarks.sim_to_sim import BEDS, HOME, ORACLE, OTHER, Args, cache_of, main, path_of, run, summary, task_of
from benchmarks.task import Engine, Task
from famle_envs.robot_env import RobotEnv
from tests.small_reacher import task_of as arm

SIMULATORS: tuple[Engine, ...] = ("pybullet", "mujoco")


def robot_of(task: Task) -> RobotEnv:
    robot: Any = task.make()
    robot.close()
    return robot.unwrapped  # type: ignore[no-any-return]


@pytest.mark.parametrize("simulator", SIMULATORS)
@pytest.mark.parametrize("robot", BEDS)
def test_all_have_the_same_damage_and_differ_by_engines(
    robot: str, simulator: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def watch(method: str, tasks: Sequence[Task]) -> list[Result]:
        made, simulated, task = robot_of(tasks[0]), tasks[0].simulated(), tasks[0]
        simulated.close()
        learnt_in: Any = simulated.unwrapped
        engines = learnt_in.engine, made.engine
        return [{"method": method, "engines": engines, "cache": task.cache, "situation": made.situation}]

    monkeypatch.setattr(sim_to_sim, "BEDS", {**BEDS, robot: replace(BEDS[robot], run=watch)})
    task, other = task_of(robot, 1, Args(simulator=simulator, cache=tmp_path)), OTHER[simulator]
    for method, engines in (("famle", (simulator, other)), (ORACLE, (other, other)), (HOME, (simulator, simulator))):
        (found,) = run(method, [task], tmp_path)
        learnt = {"engines": engines, "cache": cache_of(engines[0], tmp_path)}
        assert found == {"method": "famle", "situation": task.situation, **learnt}


def test_models_of_one_engine_are_not_taken_for_those_of_the_other() -> None:
    one, other = (task_of("ant", 0, Args(simulator=simulator)) for simulator in SIMULATORS)
    assert one.is_shipped
    assert not other.is_shipped
    assert one.cache != other.cache


@pytest.mark.usefixtures("small_reacher")
@pytest.mark.parametrize("method", ["famle", "oracle", "one-simulator", "ampc", "famle-paper", "ppo-pretrained"])
def test_benchmarks_have_the_engine_that_they_ask_for_whatever_the_default_is(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt = list[str]()
    collected = RobotEnv.reset

    def watch(self: RobotEnv, **kwargs: Any) -> Any:
        learnt.append(self.engine)
        return collected(self, **kwargs)

    monkeypatch.setattr(RobotEnv, "reset", watch)
    for default in ("mujoco", "pybullet"):
        monkeypatch.setattr("famle_envs.engines.find_spec", lambda name, known=default: name == known or None)
        for simulator in SIMULATORS:
            task = replace(arm(0, tmp_path / default / simulator), simulator=simulator, engine=OTHER[simulator])
            METHODS[method].learn(task)
            agent: Any = METHODS[method].agent(task)
            agent.get_env().close()
            assert set(learnt) == {simulator}
            assert robot_of(task).engine == OTHER[simulator]
            learnt.clear()


@pytest.mark.usefixtures("small_reacher")
@pytest.mark.parametrize("simulator", SIMULATORS)
def test_replicates_take_turns_with_models_and_are_stored_summed_up_and_drawn(
    simulator: Engine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = ("famle", "famle-frozen", ORACLE, HOME)
    args = Args(
        methods=methods,
        replicates=3,
        jobs=1,
        out=tmp_path,
        cache=tmp_path / "cache",
        robots=("reacher",),
        simulator=simulator,
    )
    args = replace(args, meta_trainings=2)
    main(args)
    shown = capsys.readouterr().out
    assert all(label in shown for label in ("learnt in", "FAMLE, no adaptation", "oracle", "gap_closed"))
    for engine in SIMULATORS:  # the oracle learns in the other one
        learnt = {path.name for path in cache_of(engine, args.cache).glob("*.zip")}
        assert learnt == {"reacher-ours-0.zip", "reacher-ours-1.zip"}
    results = load(path_of("reacher", simulator, tmp_path))
    assert results.groupby("method").size().to_dict() == dict.fromkeys(methods, 3)
    assert results.groupby("method")["situation"].agg(list).map(tuple).nunique() == 1
    assert (tmp_path / "sim-to-sim.png").read_bytes().startswith(b"\x89PNG")
    main(args)
    assert load(path_of("reacher", simulator, tmp_path)).equals(results)  # nothing was left to do


def test_summary_says_how_much_of_the_gap_is_closed_and_how_many_recover() -> None:
    returns = {"famle": [750.0, 850.0, 950.0], "famle-frozen": [100.0, 200.0, 300.0], "oracle": [900.0, 1000.0, 1100.0]}
    rows = [
        {"method": method, "seed": seed, "return": value}
        for method, values in returns.items()
        for seed, value in enumerate(values)
    ]
    found = summary("ant", pd.DataFrame(rows))
    assert found.loc["famle", "recovered"] == pytest.approx(2 / 3)
    assert found["gap_closed"].to_dict() == pytest.approx({"famle": 650 / 800, "famle-frozen": 0.0, "oracle": 1.0})
    without = summary("ant", pd.DataFrame(rows[:3]))
    assert np.isnan(without.loc["famle", "gap_closed"])
    assert without.loc["famle", "median"] == 850.0


def test_robot_that_is_not_known_is_named() -> None:
    with pytest.raises(ValueError, match=r"no robot 'moon'\. Robots: reacher, ant"):
        Args(robots=("moon",))


@pytest.mark.usefixtures("small_reacher")
def test_meta_training_leaves_nothing_in_the_cache_but_the_model_and_its_lock(tmp_path: Path) -> None:
    famle(arm(0, tmp_path)).get_env().close()  # type: ignore[union-attr]
    assert {path.name for path in tmp_path.iterdir()} == {"reacher-ours-0.zip", "reacher-ours-0.zip.lock"}
