from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from famle_agent import FAMLE
from famle_agent.app import demo
from famle_agent.app.cli import main
from famle_agent.app.demo import run_demo
from famle_agent.app.plots import side_by_side
from famle_agent.rollout import Rollout
from tests.conftest import QUICK

slow = pytest.mark.slow

SHOWN = {
    "adapt/adaptations",
    "adapt/diverged",
    "adapt/recognised",
    "episode/return",
    "episode/return_so_far",
    "posterior/joint 3 dead",
    "prediction/error_after",
    "step/reward",
}
"""What TensorBoard has of each run."""


def read(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def scalars(folder: Path) -> set[str]:
    return set(read(folder).Tags()["scalars"])


@slow
def test_demo_of_the_arm_writes_all_it_promises(
    tmp_path: Path, tiny_budgets: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "results" / "demo"
    main(["demo", "--out", str(out), "--episodes", "2", "--meta-iterations", "2", "--situation", "joint 3 dead"])
    with Image.open(out / "returns.png") as plot, Image.open(out / "robot.gif") as film:
        assert plot.size[0] > 100
        assert film.n_frames > 1
        assert film.size[0] > 1.5 * film.size[1]  # two films next to each other
    agent = FAMLE.load(out / "agent.zip", device="cpu")
    assert agent.config.training.meta_learner.iterations == 2
    assert len(agent.situations) == 11
    agent.get_env().close()
    assert "meta/loss_after" in scalars(out / "tensorboard" / "FAMLE_meta_1")
    for name in ("with_adaptation", "without_adaptation"):
        assert scalars(out / "tensorboard" / name) >= SHOWN
    shown = capsys.readouterr().out
    assert "joint 3 dead" in shown
    assert "returns.png" in shown


def test_demo_says_in_words_what_broke_and_how_far_it_is(
    agent_file: Path,
    tmp_path: Path,
    tiny_budgets: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(
        demo, "FAMLE", Mock(load=FAMLE.load, side_effect=lambda *_, **__: FAMLE.load(agent_file, **QUICK))
    )
    run_demo(episodes=2, out=tmp_path)
    shown = " ".join(capsys.readouterr().out.split())
    assert "The reacher breaks before episode 1: joint 0 reversed, joint 3 dead." in shown
    for episode, truth in ((0, "intact"), (1, "joint 0 reversed, joint 3 dead")):
        lines = re.findall(rf"episode {episode}: \S+ in 6 steps\. Belief: .*?\. Truth: {truth}\.", shown)
        assert len(lines) == 2  # with adaptation and without
    assert "truth at" in shown
    for name in ("with_adaptation", "without_adaptation"):
        events = read(tmp_path / "tensorboard" / name)
        assert set(events.Tags()["scalars"]) >= SHOWN
        assert set(events.Tags()["images"]) >= {"posterior", "prediction/path", "robot/last_episode"}
        assert events.Scalars("posterior/joint 3 dead")[-1].step == 12  # of two episodes of 6


def test_each_demo_has_a_folder_of_its_own(
    agent_file: Path, tmp_path: Path, tiny_budgets: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        demo, "FAMLE", Mock(load=FAMLE.load, side_effect=lambda *_, **__: FAMLE.load(agent_file, **QUICK))
    )
    (tmp_path / "demo").mkdir()  # empty, and so free
    (tmp_path / "demo-2").mkdir()
    (tmp_path / "demo-2" / "notes.txt").write_text("of somebody")
    for name in ("demo", "demo-3"):
        run_demo(episodes=2, out=tmp_path / "demo")
        assert {"agent.zip", "returns.png", "robot.gif", "tensorboard"} == {
            path.name for path in (tmp_path / name).iterdir()
        }
    assert [path.name for path in (tmp_path / "demo-2").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("out", [".", "..", "sub/.."])
def test_folder_that_no_number_can_be_added_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "notes.txt").write_text("of somebody")
    monkeypatch.chdir(tmp_path if out == "sub/.." else tmp_path / "sub")
    with pytest.raises(ValueError, match="name of a new folder"):
        run_demo(out=Path(out))
    assert [path.name for path in tmp_path.iterdir()] == ["sub"]


def test_captions_say_what_is_wrong_and_what_is_believed() -> None:
    env = Mock(get_wrapper_attr=lambda _: 0.1)  # a picture each step
    frame = np.zeros((2, 2, 3), dtype=np.uint8)

    def episode(breaks_at: int | None, beliefs: list[str], frames: int) -> Rollout:
        n = len(beliefs)
        return Rollout(
            np.ones(n), np.zeros((n + 1, 0)), *np.zeros((2, n)), beliefs, 1.0, breaks_at, frames=[frame] * frames
        )

    runs = [episode(None, ["intact"], 1), episode(1, ["intact", "intact", "dead"], 3), episode(None, ["dead"] * 2, 2)]
    assert demo._captions(runs, env, "motor 0 dead") == [  # noqa: SLF001
        "truth: intact\nbelief: intact\nreturn: 1",
        "truth: intact\nbelief: intact\nreturn: 1",
        "truth: motor 0 dead\nbelief: intact\nreturn: 2",
        "truth: motor 0 dead\nbelief: dead\nreturn: 3",
        "truth: motor 0 dead\nbelief: dead\nreturn: 1",
        "truth: motor 0 dead\nbelief: dead\nreturn: 2",
    ]


def test_outcome_has_the_mean_reward_of_a_step_before_and_after_the_break() -> None:
    run = Rollout(np.array([2.0, 1.0, 0.0]), np.zeros((4, 0)), *np.zeros((2, 3)), ["intact"] * 3, 1.0, breaks_at=1)
    assert demo._outcome(run) == "3.0 in 3 steps, 2.00 a step before the break, 0.50 after"  # noqa: SLF001


def test_films_have_their_titles_and_captions_above_and_below() -> None:
    films = {"one": [np.zeros((4, 4, 3), dtype=np.uint8)] * 2, "two": [np.zeros((4, 4, 3), dtype=np.uint8)]}
    plain = side_by_side(films, size=64)
    told = side_by_side(films, {"one": ["a", "b"], "two": ["c"]}, size=64)
    assert len(plain) == len(told) == 2
    assert told[0].shape[0] > plain[0].shape[0]
    assert told[0].shape[1] == 128
    below = [picture[plain[0].shape[0] :] for picture in told]
    assert (below[0] < 255).any()
    assert not np.array_equal(below[0][:, :64], below[1][:, :64])
    assert np.array_equal(below[0][:, 64:], below[1][:, 64:])  # the film that has ended


@slow
def test_demo_gives_its_episodes(tmp_path: Path, tiny_budgets: None) -> None:
    runs = run_demo(situation="joint 0 reversed", episodes=2, out=tmp_path, seed=1, candidates=5)
    assert list(runs) == ["with adaptation", "without adaptation"]
    for episodes in runs.values():
        assert [run.breaks_at for run in episodes] == [None, 0]
        assert all(0 < run.total < 6 for run in episodes)
        assert all(len(run.frames) == run.steps == 6 for run in episodes)
    assert set(runs["without adaptation"][1].situations) == {"intact"}


@slow
def test_demo_shows_the_ant_before_at_and_after_the_break(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = run_demo("ant", out=tmp_path, env={"max_episode_steps": 240}, breaks_at=(0, 120))
    (adapting,), (frozen,) = runs.values()
    assert adapting.reward[60:120].mean() > 0.8
    assert adapting.reward[-60:].mean() > 0.8
    assert adapting.situations[119] == "intact"
    assert adapting.situations[-1] == "joint 2 dead + yaw sensor off by 60 deg"
    assert set(frozen.situations) == {"intact"}
    assert "speed.png" in capsys.readouterr().out
    with Image.open(tmp_path / "speed.png") as plot, Image.open(tmp_path / "robot.gif") as film:
        assert min(plot.size) > 100
        assert film.n_frames > 20
    assert FAMLE.load(tmp_path / "agent.zip", device="cpu").dynamics is not None


@slow
def test_demo_shows_the_way_to_the_goal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = run_demo("quadruped", "front left leg blocked", out=tmp_path)
    (adapting,) = runs["with adaptation"]
    assert adapting.success
    assert np.linalg.norm(adapting.position[-1] - (2.5, 0.0)) < 0.5
    assert "at the goal" in " ".join(capsys.readouterr().out.split())
    with Image.open(tmp_path / "path.png") as plot, Image.open(tmp_path / "robot.gif") as film:
        assert min(plot.size) > 100
        assert film.n_frames >= adapting.steps


@pytest.mark.parametrize(
    ("robot", "wrong", "message"),
    [
        ("octopus", {}, "demo of reacher, ant, quadruped, a1, minitaur, not of 'octopus'"),
        ("ant", {"situation": "joint 9 dead"}, "joint"),
        ("ant", {"breaks_at": (0, 900)}, r"within 1 episodes of 900 steps; got \(0, 900\)"),
        ("ant", {"breaks_at": (1, 0)}, "breaks_at"),
        ("quadruped", {"situation": "joint 99 locked"}, "joint"),
        ("quadruped", {"env": {"profile": "dream"}}, "profile"),
    ],
)
def test_mistakes_are_told_before_anything_runs(
    tmp_path: Path, robot: str, wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        run_demo(robot, out=tmp_path / "new", **wrong)
    assert not (tmp_path / "new").exists()
