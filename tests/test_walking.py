from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.cli import main
from famle_agent.plots import running_mean
from famle_agent.walking import BrokenRun, run_and_break, run_walking_demo


def broken_run(speed: list[float], break_at: int) -> BrokenRun:
    return BrokenRun(np.array(speed), np.ones(len(speed)), ["intact"] * len(speed), break_at)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=30), st.integers(1, 40))
def test_running_mean_is_the_mean_of_the_last_values(values: list[float], window: int) -> None:
    expected = [np.mean(values[max(0, i + 1 - window) : i + 1]) for i in range(len(values))]
    np.testing.assert_allclose(running_mean(np.array(values), window), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "recovery"),
    [
        ([2.0] * 8, 0),
        ([2.0] * 4 + [0.0] * 4, None),
        ([2.0] * 4 + [0.0, 0.0] + [2.0] * 6, 4),
        ([2.0] * 4 + [0.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0], 4),
        ([0.0] * 4 + [2.0] * 8, 2),
    ],
    ids=["never slow", "never again", "recovers", "slow again at the end", "slow only before"],
)
def test_recovery_counts_from_the_break(speed: list[float], recovery: int | None) -> None:
    assert broken_run(speed, break_at=4).recovery(threshold=1.0, window=2) == recovery


def test_robot_breaks_in_the_middle_of_the_run(quick_agent: FAMLE, make_env: Callable[..., gym.Env[Any, Any]]) -> None:
    env = FAMLEWrapper(make_env(render_mode="rgb_array"), quick_agent)
    seen = []
    env.get_wrapper_attr("unwrapped").reward_fn = lambda obs, action, next_obs: (
        seen.append(str(env.get_wrapper_attr("situation"))) or len(seen)
    )
    run = run_and_break(env, "joint 3 dead", steps=6, break_at=2, seed=0, film_every=3)
    assert seen == ["intact"] * 2 + ["joint 3 dead"] * 4
    assert run.speed.tolist() == [1, 2, 3, 4, 5, 6]
    assert len(run.believed) == len(run.seconds) == 6
    assert set(run.believed) <= set(quick_agent.situations)
    assert [frame.shape for frame in run.frames] == [(480, 480, 3)] * 2


@pytest.mark.slow
def test_demo_shows_the_ant_before_at_and_after_the_break(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = run_walking_demo(out=tmp_path, steps=240, break_at=120)
    adapting, frozen = runs.values()
    assert adapting.speed[60:120].mean() > 0.8
    assert adapting.speed[-60:].mean() > 0.8
    assert adapting.believed[119] == "intact"
    assert adapting.believed[-1] == "joint 2 dead + yaw sensor off by 60 deg"
    assert set(frozen.believed) == {"intact"}
    assert "mean speed" in capsys.readouterr().out
    with Image.open(tmp_path / "speed.png") as plot, Image.open(tmp_path / "robot.gif") as film:
        assert min(plot.size) > 100
        assert film.n_frames > 20
    assert FAMLE.load(tmp_path / "agent.zip", device="cpu").dynamics is not None
    assert list((tmp_path / "tensorboard").rglob("events*"))


@pytest.mark.parametrize(("situation", "break_at"), [("joint 9 dead", 3), ("joint 1 dead", 0), ("joint 1 dead", 10)])
def test_mistakes_are_told_before_anything_runs(tmp_path: Path, situation: str, break_at: int) -> None:
    with pytest.raises(ValueError, match=r"joint|break_at"):
        run_walking_demo(situation=situation, out=tmp_path / "new", steps=10, break_at=break_at)
    assert not (tmp_path / "new").exists()


def test_command_line_knows_which_robots_it_can_show(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["demo", "--robot", "octopus"])
    assert "ant" in capsys.readouterr().err
