from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.ablations import PIECES, Args, main, robots, summary
from benchmarks.results import load

ROOT = Path(__file__).parents[2]
QUOTED = {"reacher": 1, "ant": 0, "quadruped": 1, "minitaur": 1, "pusher": 1, "walker2d": 0}
"""The columns of the manual's table, and their digits behind the point."""


def test_pieces_are_compared_pair_by_pair() -> None:
    rows = [("all", 0, 3.0), ("all", 1, 5.0), ("frozen", 0, 1.0), ("frozen", 1, 2.0)]
    found = summary(pd.DataFrame(rows, columns=["method", "seed", "score"]))
    assert list(found.index) == ["all", "frozen"]
    assert found.loc["frozen"].to_dict() == {"mean": 1.5, "median": 1.5, "less all": -2.5, "+-": 0.5}
    assert found.loc["all", "less all"] == 0.0


def test_manual_quotes_the_stored_results() -> None:
    manual = (ROOT / "docs" / "results.md").read_text().partition("## What each piece of adaptation is worth")[2]
    rows = [line.split("|")[1:-1] for line in manual.partition("\n##")[0].splitlines() if line.startswith("|")]
    for column, (robot, digits) in enumerate(QUOTED.items(), start=1):
        found = summary(load(ROOT / "benchmarks" / "results" / f"ablations-{robot}.csv")).drop("all")
        quoted = [row[column].strip() for row in rows[3:]]
        assert quoted == [
            f"{less:+,.{digits}f} +- {error:,.{digits}f}" for less, error in found[["less all", "+-"]].values
        ]


@pytest.mark.parametrize("robot", ["ant", "quadruped", "minitaur"])
def test_every_piece_can_be_taken_from_a_robot(robot: str, tmp_path: Path) -> None:
    chosen = robots(tmp_path)[robot]
    whole = chosen.agent(0, PIECES["all"]).config
    for piece, settings in PIECES.items():
        changed = chosen.agent(0, settings).config
        assert (changed == whole) == (piece == "all")


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(ValueError, match=r"There is no dog\. Known: reacher, ant"):
        Args(robots=("dog",))
    with pytest.raises(ValueError, match=r"There is no luck\. Known: all, no sums"):
        Args(pieces=("luck",))


@pytest.mark.slow
def test_what_is_stored_is_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = Args(robots=("quadruped",), pieces=("frozen",), jobs=1, out=tmp_path, cache=tmp_path)
    main(args)
    table = load(tmp_path / "ablations-quadruped.csv")
    assert set(table["method"]) == {"all", "frozen"}
    assert table["score"].between(-80, -1).all()
    assert "less all" in capsys.readouterr().out
    before = (tmp_path / "ablations-quadruped.csv").read_bytes()
    main(args)
    assert (tmp_path / "ablations-quadruped.csv").read_bytes() == before
