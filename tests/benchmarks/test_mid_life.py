"""Arms that break after an intact episode."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.mid_life import Args, main, summary
from benchmarks.results import load
from famle_envs import Situation


@pytest.mark.usefixtures("small_reacher")
def test_arms_live_an_episode_before_they_break(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(Args(methods=("famle-frozen",), replicates=2, episodes=2, jobs=1, out=tmp_path, cache=tmp_path / "cache"))
    assert "episode 1" in capsys.readouterr().out
    table = load(tmp_path / "mid-life.csv")
    assert len({Situation.from_string(text) for text in table["situation"]}) == 2
    assert (table["believed"] == "intact").all()  # of agents that never adapt
    assert all(len(returns) == 2 and min(returns) > 0.0 for returns in table["returns"])


def test_summary_has_means_of_each_episode() -> None:
    table = pd.DataFrame({"method": ["a", "a", "b"], "returns": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]})
    assert summary(table).to_numpy().tolist() == [[2.0, 3.0], [5.0, 6.0]]
