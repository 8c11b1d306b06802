from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.reporting.study import ROBOT_ALONE, STEPS_IN_TURNS
from benchmarks.results import load
from benchmarks.timing import Args, main


@pytest.mark.usefixtures("small_reacher")
def test_all_methods_are_timed_and_stored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(Args(("reacher",), turns=2, turn_steps=4, out=tmp_path))
    table = load(tmp_path / "timing.csv")
    assert set(table["part"]) == {STEPS_IN_TURNS}
    turns = table.set_index("figure")["value"]
    assert {ROBOT_ALONE, "famle", "famle-original", "ampc-maml", "ppo"} <= set(turns.index)
    assert all(len(values) == 2 and min(values) > 0.0 for values in turns)
    assert (np.median(turns["famle"]) > np.median(turns[ROBOT_ALONE])).all()
    assert "reacher" in capsys.readouterr().out
    main(Args(("reacher",), turns=1, turn_steps=4, out=tmp_path))
    assert len(load(tmp_path / "timing.csv")) == len(table)  # measured anew, in place of the old figures


def test_nothing_else_can_be_timed() -> None:
    with pytest.raises(ValueError, match=r"nothing to time of moon\. Known: reacher, ant"):
        Args(robots=("moon",))
