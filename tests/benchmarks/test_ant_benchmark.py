from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest

from benchmarks.ant import ANT_METHODS, BIN, Args, damage_of, run, untrained
from benchmarks.reporting.registry import style_of
from benchmarks.reporting.report import show
from benchmarks.results import load
from benchmarks.runner import compare
from benchmarks.task import Task
from famle_agent import ModelBasedAgent
from famle_envs.ant import AntEnv


def test_test_damages_are_unseen_and_those_of_tuning_are_others() -> None:
    test = {damage_of("unseen", seed) for seed in range(20)}
    tuning = {damage_of("validation", seed) for seed in range(20)}
    assert len(test) == 20
    assert not test & tuning
    assert not test & set(AntEnv.training_situations)
    assert test == {damage_of("break", seed) for seed in range(20)}


def test_untrained_damages_are_of_four_kinds() -> None:
    kinds = [{frozenset(untrained(seed).faults) for seed in range(kind, 20, 4)} for kind in range(4)]
    assert kinds == [{frozenset({name})} for name in ("motor_gain", "motor_gain", "locked_joints", "friction")]
    assert sum(gain < 1 for gain in untrained(0).motor_gain) == 2
    assert min(untrained(1).motor_gain) < 0


def test_replicate_is_stored_and_summed_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args, methods, table = Args(steps=2 * BIN, jobs=1), ("famle", "famle-frozen"), tmp_path / "ant-unseen.csv"
    task = Task("ant", 0, damage_of("unseen", 0), tmp_path)
    compare(methods, [task], partial(run, args=args), table, args, ANT_METHODS)
    results = load(table).to_dict("records")
    assert [result["method"] for result in results] == list(methods)
    for result in results:
        assert result["return"] == pytest.approx(BIN * sum(result["speed"]), abs=0.2)
        assert result["ms_per_step"]["mean"] > 0
    assert results[1]["believed"] == "intact"
    show(tmp_path, "ant-unseen")
    shown = capsys.readouterr().out
    assert all(style_of(method).label in shown for method in methods)


def test_single_episode_is_not_for_model_free_methods(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="take a model-based method"):
        run("ppo", [Task("ant", 0, damage_of("unseen", 0), tmp_path)], Args())


@pytest.mark.parametrize("method", ["famle-nearest", "famle-select", "members-2", "random-shooting"])
def test_methods_are_the_shipped_agent_with_something_changed(method: str) -> None:
    agent: Any = ANT_METHODS[method].agent(Task("ant", 3, damage_of("unseen", 3), Path("unused")))
    settings = agent.config.to_dict()
    assert agent.dynamics.members == (2 if method == "members-2" else 4)
    assert settings["compose"] == (method != "famle-nearest")
    assert bool(settings["adapt_steps"]) == (method not in ("famle-nearest", "famle-select"))
    assert settings["planner"] == ("random_shooting" if method == "random-shooting" else "icem")
    agent.get_env().close()


@pytest.mark.parametrize("method", ["famle-original", "famle-paper"])
def test_stored_network_is_the_one_that_its_method_would_learn(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ModelBasedAgent, "meta_learn", None)  # it would take most of an hour
    stored = Path(__file__).parents[2] / "benchmarks" / "agents"
    agent: Any = ANT_METHODS[method].agent(Task("ant", 0, damage_of("curves", 0), stored))
    assert agent.situations == tuple(situation.label for situation in AntEnv.training_situations)
    obs, _ = agent.get_env().envs[0].reset(seed=0)
    assert agent.predict(obs)[0].shape == (8,)
    agent.get_env().close()
