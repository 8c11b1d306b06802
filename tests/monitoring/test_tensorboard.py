from __future__ import annotations

import gc
import io
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stable_baselines3.common.logger import Logger, configure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from famle_agent import FAMLE, Transitions
from famle_agent.app.plots import plot_returns
from famle_agent.monitoring.tensorboard import encode_gif, log_gif
from tests.conftest import QUICK


def read(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def pictures(n: int) -> list[np.ndarray]:
    return [np.full((12, 20, 3), 40 * i, dtype=np.uint8) for i in range(n)]


def test_meta_learning_shows_its_losses_and_the_map_of_the_situations(transitions: Transitions, tmp_path: Path) -> None:
    agent = FAMLE(
        "reacher",
        seed=0,
        device="cpu",
        joint_iterations=3,
        meta_iterations=5,
        inner_steps=2,
        tensorboard_log=str(tmp_path / "tb"),
    )
    agent.get_env().close()
    agent.meta_learn(transitions)
    folder = tmp_path / "tb" / "FAMLE_meta_1"
    events = read(folder)
    for key in ("meta/loss_before", "meta/loss_after"):
        assert [event.step for event in events.Scalars(key)] == [4, 5, 6, 7, 8]
    assert [event.step for event in events.Scalars("meta/joint_loss")] == [1, 2, 3]
    assert all(np.isfinite(event.value) for event in events.Scalars("meta/loss_after"))
    assert "situations" in (folder / "projector_config.pbtxt").read_text()
    names = next(folder.rglob("metadata.tsv")).read_text().splitlines()
    assert tuple(names) == transitions.situations
    assert len(next(folder.rglob("tensors.tsv")).read_text().splitlines()) == 11


@pytest.mark.parametrize(("compose", "total"), [(False, 1.0), (True, 1.5)])
def test_life_shows_returns_and_the_posterior(
    load_agent: Callable[..., FAMLE], tmp_path: Path, compose: bool, total: float
) -> None:
    """Of each situation, alone or as one of two: then all of them are likely once or twice."""
    settings = {"adapt_every": 10, "adapt_steps": 1, "candidates": 5, "planner_iterations": 1, "compose": compose}
    agent = load_agent(**settings, tensorboard_log=str(tmp_path))
    agent.learn(110, tb_log_name="life")
    events = read(tmp_path / "life_1")
    assert [event.step for event in events.Scalars("rollout/ep_rew_mean")] == [50, 100]
    assert all(0 < event.value <= 50 for event in events.Scalars("rollout/ep_rew_mean"))
    names = [tag for tag in events.Tags()["scalars"] if tag.startswith("posterior/")]
    assert set(names) == {f"posterior/{name}" for name in agent.situations}
    assert sum(events.Scalars(name)[-1].value for name in names) == pytest.approx(
        total, abs=1e-4 if not compose else 0.5
    )


def test_log_interval_counts_episodes(load_agent: Callable[..., FAMLE], tmp_path: Path) -> None:
    agent = load_agent(adapt_every=0, candidates=2, planner_iterations=1, tensorboard_log=str(tmp_path))
    agent.learn(200, log_interval=2)
    assert [event.step for event in read(tmp_path / "FAMLE_1").Scalars("rollout/ep_rew_mean")] == [100, 200]


def test_console_shows_the_returns(load_agent: Callable[..., FAMLE], capsys: pytest.CaptureFixture[str]) -> None:
    agent = load_agent(adapt_every=0, candidates=2, planner_iterations=1, verbose=1)
    agent.learn(50)
    shown = capsys.readouterr().out
    assert "ep_rew_mean" in shown
    assert "posterior" not in shown


def test_film_is_a_gif_with_all_its_pictures() -> None:
    film = Image.open(io.BytesIO(encode_gif(pictures(4), fps=10)))
    assert film.format == "GIF"
    assert film.n_frames == 4
    assert film.size == (20, 12)
    assert film.info["duration"] == 100
    film.seek(3)
    assert np.asarray(film.convert("RGB"))[0, 0, 0] == pytest.approx(120, abs=5)


def test_film_is_among_the_images(tmp_path: Path) -> None:
    logger = configure(str(tmp_path), ["tensorboard"])
    log_gif(logger, "robot/film", pictures(3), fps=10, step=7)
    logger.close()
    (event,) = read(tmp_path).Images("robot/film")
    assert (event.step, event.width, event.height) == (7, 20, 12)
    assert Image.open(io.BytesIO(event.encoded_image_string)).n_frames == 3


def test_picture_of_returns(tmp_path: Path) -> None:
    plot_returns({"with": [1.0, 2.0, 3.0], "without": [1.0, 0.5, 0.2]}, "an arm", tmp_path / "returns.png")
    picture = np.asarray(Image.open(tmp_path / "returns.png").convert("RGB"))
    assert picture.shape[0] > 300
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_calls_leave_no_thread_behind(quick_agent: FAMLE, tmp_path: Path) -> None:
    quick_agent.tensorboard_log = str(tmp_path)
    others = set(threading.enumerate())  # which may end meanwhile
    quick_agent.learn(2)
    of_one = len(set(threading.enumerate()) - others)
    for _ in range(3):
        quick_agent.learn(2)
    assert len(set(threading.enumerate()) - others) == of_one
    assert len(list(tmp_path.rglob("events.*"))) == 4


@pytest.mark.parametrize("call", ["learn", "meta_learn"])
def test_agents_that_are_let_go_leave_no_thread_behind(
    agent_file: Path, transitions: Transitions, tmp_path: Path, call: str
) -> None:
    """Not even where somebody has their folder removed; a logger that is held is not closed."""
    gc.collect()
    threads, held = threading.active_count(), list[Logger]()
    for i in range(3):
        agent = FAMLE.load(agent_file, device="cpu", **QUICK, joint_iterations=2, meta_iterations=2, inner_steps=1)
        agent.tensorboard_log = str(tmp_path / str(i))
        agent.learn(2) if call == "learn" else agent.meta_learn(transitions)
        agent.get_env().close()
        assert threading.active_count() > threads
        if i == 1:
            shutil.rmtree(tmp_path / "1")
        if i == 2:
            held.append(agent.logger)
        del agent
        gc.collect()
        assert threading.active_count() == threads + len(held)
    held[0].record("more", 1.0)
    held[0].dump(1)
    held.clear()
    assert threading.active_count() == threads
