from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.reporting.study import ROBOT_ALONE, STEPS_IN_TURNS
from benchmarks.results import load
from benchmarks.timing import PARTS, Args, main
from famle_envs.engines import ENGINES


@pytest.mark.usefixtures("small_reacher")
def test_all_parts_are_timed_and_stored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = Args(("reacher",), turns=2, turn_steps=4, repeats=2, steps=30, cache=tmp_path / "cache", out=tmp_path)
    main(args)
    table = load(tmp_path / "timing.csv")
    assert set(table["part"]) == set(PARTS)
    turns = table[table["part"] == STEPS_IN_TURNS].set_index("figure")["value"]
    assert {ROBOT_ALONE, "famle", "famle-original", "ampc-maml", "ppo"} <= set(turns.index)
    assert all(len(values) == 2 and min(values) > 0.0 for values in turns)
    assert (np.median(turns["famle"]) > np.median(turns[ROBOT_ALONE])).all()
    assert all(part in capsys.readouterr().out for part in ["reacher"])
    engines = table[table["part"] == "engines"].set_index("figure")["value"]
    assert set(engines.index) == {f"{name}: {what} (ms)" for name in ENGINES for what in ("step", "simulated second")}
    for name in ENGINES:
        step, second = engines[f"{name}: step (ms)"], engines[f"{name}: simulated second (ms)"]
        assert second == pytest.approx(10.0 * step)  # a step of the arm lasts a tenth of a second
        assert step > 0.0
    rows = len(table)
    main(Args(("reacher",), ("environment",), repeats=2, out=tmp_path))
    assert len(load(tmp_path / "timing.csv")) == rows  # measured anew, in place of the old figures


def test_nothing_else_can_be_timed() -> None:
    with pytest.raises(ValueError, match=r"nothing to time of moon\. Known: reacher, ant"):
        Args(robots=("moon",))
    with pytest.raises(ValueError, match="Known: step in turns"):
        Args(parts=("planing",))
