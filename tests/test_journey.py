from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.journey import Journey, run_journey, run_journey_demo


@pytest.fixture(scope="module")
def agent() -> FAMLE:
    """An agent of the quadruped that has seen next to nothing."""
    small = {"transitions_per_situation": 4, "joint_iterations": 2, "candidates": 5, "members": 1, "adapt_steps": 1}
    learner = FAMLE("quadruped", seed=0, device="cpu", pretrained=False, **small)
    return learner.meta_learn(["intact", "joint 3 locked"])


def journey(agent: FAMLE, steps: int, **kwargs: Any) -> Journey:
    env = gym.make("FamleQuadruped-v0", max_episode_steps=steps, render_mode="rgb_array", **kwargs.pop("make", {}))
    agent.forget()
    run = run_journey(FAMLEWrapper(env, agent), seed=0, **kwargs)
    env.close()
    return run


def test_journey_says_where_the_robot_was_and_what_it_believed(agent: FAMLE) -> None:
    run = journey(agent, 3, film=True)
    assert run.path.shape == (4, 2)
    np.testing.assert_allclose(run.path[0], 0.0, atol=1e-3)
    assert np.abs(np.diff(run.path, axis=0)).max() > 1e-3
    assert run.gaits == len(run.believed) == len(run.frames) == 3
    assert set(run.believed) <= {"intact", "joint 3 locked", "intact + joint 3 locked"}
    assert not run.reached
    assert not run.fell


def test_path_is_where_the_body_is_whatever_the_sensors_say(agent: FAMLE) -> None:
    run = journey(agent, 1, make={"profile": {"name": "blind", "position_noise": 100.0}})
    assert np.abs(run.path).max() < 0.5


def test_journey_ends_at_the_goal(agent: FAMLE) -> None:
    run = journey(agent, 5, make={"goal": (0.3, 0.0), "success_radius": 5.0})
    assert run.gaits == 1
    assert run.reached
    assert not run.fell


def test_situation_strikes_before_the_named_action(agent: FAMLE) -> None:
    env = FAMLEWrapper(gym.make("FamleQuadruped-v0", max_episode_steps=4), agent)
    seen = []
    unwrapped = env.unwrapped
    unwrapped.reward_fn = lambda *_: seen.append(str(unwrapped.situation)) or 0.0  # type: ignore[attr-defined]
    run_journey(env, 0, later="joint 0 locked", strikes_at=2)
    env.close()
    assert seen == ["intact"] * 2 + ["joint 0 locked"] * 2


@pytest.mark.parametrize("wrong", [{"situation": "joint 99 locked"}, {"profile": "dream"}])
def test_mistakes_are_told_before_anything_runs(tmp_path: Path, wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"joint|profile"):
        run_journey_demo("quadruped", out=tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_demo_shows_the_way_to_the_goal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = run_journey_demo("quadruped", "front left leg blocked", out=tmp_path)
    assert runs["with adaptation"].reached
    assert "at the goal" in capsys.readouterr().out
    with Image.open(tmp_path / "path.png") as plot, Image.open(tmp_path / "robot.gif") as film:
        assert min(plot.size) > 100
        assert film.n_frames >= runs["with adaptation"].gaits
    assert FAMLE.load(tmp_path / "agent.zip", device="cpu").dynamics is not None
    assert list((tmp_path / "tensorboard").rglob("events*"))
