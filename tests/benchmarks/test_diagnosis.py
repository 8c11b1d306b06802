from __future__ import annotations

import math
from pathlib import Path

import pandas as pd
import pytest

from benchmarks import diagnosis
from benchmarks.diagnosis import OURS, Args, bed, main, ours, parts_of, summary
from benchmarks.results import load
from famle_agent import FAMLE
from famle_envs import Situation


def test_label_is_taken_apart_however_it_is_written() -> None:
    assert parts_of("intact") == frozenset()
    both = {Situation(motor_gain=(1, 0)), Situation(orientation_error=round(math.radians(30), 6))}
    assert (
        parts_of("joint 1 dead + yaw sensor off by 30 deg")
        == parts_of("yaw sensor off by 390 deg, joint 1 dead")
        == both
    )
    assert parts_of("mass 1.0, something else") == {"mass 1.0", "something else"}


@pytest.mark.parametrize("robot", OURS)
def test_each_known_fault_can_be_named(robot: str) -> None:
    cases = list(ours(robot, steps=5))
    assert sum(case.parts == frozenset() for case in cases) == diagnosis.INTACT
    assert len({case.fault for case in cases}) == len(cases) - diagnosis.INTACT + 1
    if robot != "reacher":  # which ships no model
        agent = FAMLE(robot, device="cpu")
        names = {parts_of(name) for name in agent.posterior()}
        agent.get_env().close()
        assert all(case.parts in names for case in cases if case.parts is not None)


def test_faults_out_of_range_are_of_another_kind() -> None:
    known = {case.fault: case.parts is not None for case in bed("halfcheetah")}
    assert known["motor 0 dead"]
    assert known["motor 1 dead, motor 3 dead"]
    assert not known["motor 4 dead"]


@pytest.mark.usefixtures("tiny_budgets")
def test_cases_are_lived_and_summed_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(diagnosis, "OURS", {"reacher": (*OURS["reacher"][:1], ("joint 1 locked",), "")})
    monkeypatch.setattr(diagnosis, "INTACT", 1)
    main(Args(robots=("reacher",), jobs=1, steps=12, out=tmp_path, cache=tmp_path))
    table = load(tmp_path / "diagnosis.csv")
    assert set(table["fault"]) == {case.fault for case in ours("reacher", 12)}
    assert all([one["step"] for one in said] == [10, 12] for said in table["said"])
    assert "reacher" in capsys.readouterr().out


def test_summary_counts_what_was_sure_and_right() -> None:
    def said(probability: float, right: bool, error: float = 1.0) -> list[dict[str, object]]:
        return [{"step": 10, "named": "", "probability": probability, "error": error, "right": right}]

    rows = [
        ("intact", True, said(0.95, True)),
        ("intact", True, said(0.95, False)),
        ("a", True, said(0.5, False)),
        ("b", True, said(0.99, True)),
        ("c", False, said(0.99, False, error=9.0)),
    ]
    table = pd.DataFrame([{"method": "robot", "fault": fault, "known": known, "said": s} for fault, known, s in rows])
    assert summary(table).loc["robot"].round(3).to_dict() == {
        "named right": 0.5,
        "sure": 0.75,
        "right of the sure": 0.667,
        "intact called broken": 0.5,
        "unlike all, known faults": 0.0,
        "unlike all, other kinds": 1.0,
    }
