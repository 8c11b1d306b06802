"""What TensorBoard shows of a robot while it lives, read back from the files."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from PIL import Image
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from famle_agent import AMPC, FAMLE, AdaptationLog, FAMLEWrapper, ModelBasedAgent, Transitions
from famle_agent.adaptation.belief import Belief
from famle_agent.monitoring.pictures import PredictedPath, draw_paths, draw_posterior, liveliest
from famle_agent.utils.allowance import Allowance

Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]

FAST: dict[str, Any] = {"adapt_every": 5, "adapt_steps": 2, "candidates": 4, "planner_iterations": 1}
NUMBERS = {
    "adapt/adaptations",
    "adapt/diverged",
    "adapt/recognised",
    "episode/return_so_far",
    "health/blind",
    "health/cut_short",
    "health/dropped",
    "health/left_out",
    "health/overruns",
    "health/quarantined",
    "health/repeated",
    "posterior/joint 3 dead",
    "prediction/error_after",
    "prediction/error_before",
    "prediction/error_unadapted",
    "step/reward",
    "time/adapt_ms",
    "time/plan_ms",
}


@pytest.fixture(autouse=True)
def all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets every adaptation be shown, however long that takes."""
    monkeypatch.setattr(Allowance, "is_left", lambda _: True)


class Breaks(BaseCallback):
    """Breaks the robot in mid-episode."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self._step = step

    def _on_step(self) -> bool:
        if self.num_timesteps == self._step:
            self.training_env.env_method("set_situation", "joint 3 dead")
        return True


def read(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0, "tensors": 0})
    events.Reload()
    return events


def steps_of(events: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in events.Scalars(tag)]


def words(events: EventAccumulator, tag: str) -> list[str]:
    return [event.tensor_proto.string_val[0].decode() for event in events.Tensors(f"{tag}/text_summary")]


def picture(events: EventAccumulator, tag: str) -> Image.Image:
    return Image.open(io.BytesIO(events.Images(tag)[-1].encoded_image_string))


def test_a_robot_that_breaks_is_seen_within_its_episode(load_agent: Load, tmp_path: Path) -> None:
    agent = load_agent(**FAST, tensorboard_log=str(tmp_path))
    agent.set_env(gym.make("FamleReacher-v0", max_episode_steps=1000))
    agent.learn(60, callback=Breaks(30))
    events = read(tmp_path / "FAMLE_1")
    tags = events.Tags()
    assert set(tags["scalars"]) >= NUMBERS
    for tag in NUMBERS:
        assert steps_of(events, tag) == list(range(5, 61, 5))
        assert all(np.isfinite(event.value) for event in events.Scalars(tag))
    assert [event.value for event in events.Scalars("adapt/adaptations")] == list(range(1, 13))
    assert all(event.value > 0 for event in events.Scalars("time/plan_ms"))
    dead = [event.value for event in events.Scalars("posterior/joint 3 dead")]
    assert dead[-1] > 0.5 > dead[4]
    assert "joint 3 dead" in words(events, "diagnosis")[-1]
    assert "joint 3 dead" not in words(events, "diagnosis")[0]
    assert [event.step for event in events.Images("posterior")] == [25, 50, 60]
    assert picture(events, "posterior").width == picture(events, "prediction/path").width == 760
    assert "situations" in (tmp_path / "FAMLE_1" / "projector_config.pbtxt").read_text()


def test_runs_can_be_compared_by_their_settings(quick_agent: FAMLE, tmp_path: Path) -> None:
    quick_agent.tensorboard_log = str(tmp_path)
    quick_agent.learn(5)
    events = read(tmp_path / "FAMLE_1")
    (settings,) = words(events, "settings")
    assert "| adapt_every | 5 |" in settings
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    chosen = HParamsPluginData.FromString(content).session_start_info.hparams
    assert chosen["adapt_every"].number_value == 5
    assert chosen["agent"].string_value == "FAMLE"
    content = events.SummaryMetadata("_hparams_/experiment").plugin_data.content
    metrics = {one.name.tag for one in HParamsPluginData.FromString(content).experiment.metric_infos}
    assert metrics >= {"episode/return_so_far", "prediction/error_after"}


def test_errors_are_of_transitions_that_no_adaptation_had_seen(
    load_agent: Load, make_env: MakeEnv, tmp_path: Path
) -> None:
    agent = load_agent(**FAST)
    logger = configure(str(tmp_path), ["tensorboard"])
    env = FAMLEWrapper(make_env(situation="joint 3 dead"), agent, AdaptationLog(agent, logger))
    obs, beliefs = env.reset(seed=0)[0], [agent.belief]
    for _ in range(10):
        obs, *_ = env.step(agent.predict(obs)[0])
        beliefs.append(agent.belief)
    logger.close()
    memory, model = agent.state_of(1).memory, agent.model

    def error(belief: Belief, steps: slice) -> float:
        batch = model.encode(memory.obs[:, steps], memory.action[:, steps], memory.next_obs[:, steps])
        return float(model.residuals(batch, belief.h, belief.theta).square().mean().sqrt() / model.usual_error)

    shown = {
        name: [event.value for event in read(tmp_path).Scalars(f"prediction/error_{name}")]
        for name in ("unadapted", "before", "after")
    }
    first, second = slice(-10, -5), slice(-5, None)
    untouched, adapted = error(beliefs[0], second), error(beliefs[5], second)
    selected = replace(beliefs[0], h=model.embeddings_of(beliefs[4].log_posterior.argmax(dim=1)))
    assert [values[0] for values in shown.values()] == pytest.approx([error(beliefs[0], first)] * 3, rel=1e-3)
    assert [values[1] for values in shown.values()] == pytest.approx(
        [untouched, error(selected, second), adapted], rel=1e-3
    )
    assert adapted < untouched


def test_logging_changes_nothing(load_agent: Load, tmp_path: Path) -> None:
    beliefs = []
    for folder in (None, str(tmp_path)):
        agent = load_agent(**FAST, tensorboard_log=folder)
        agent.set_random_seed(3)
        beliefs.append(agent.learn(30).belief)
    for name, value in beliefs[0].theta.items():
        assert torch.equal(value, beliefs[1].theta[name])
    assert torch.equal(beliefs[0].log_posterior, beliefs[1].log_posterior)


def test_entries_come_as_rarely_as_their_share_of_the_time_asks(
    load_agent: Load, make_env: MakeEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    agent, logger = load_agent(**FAST), configure(str(tmp_path), ["tensorboard"])
    env = FAMLEWrapper(make_env(), agent, AdaptationLog(agent, logger, share=1e-9))
    obs, _ = env.reset(seed=0)
    for _ in range(23):
        obs, *_ = env.step(agent.predict(obs)[0])
    env.close()
    logger.close()
    assert steps_of(read(tmp_path), "adapt/adaptations") == [5, 23]  # the first, and what had come until the end


def test_what_came_before_an_error_is_shown(load_agent: Load, tmp_path: Path) -> None:
    class Fails(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 8:
                raise RuntimeError("a cable broke")
            return True

    agent = load_agent(**FAST, tensorboard_log=str(tmp_path))
    with pytest.raises(RuntimeError, match="a cable broke"):
        agent.learn(20, callback=Fails())
    events = read(tmp_path / "FAMLE_1")
    assert steps_of(events, "adapt/adaptations") == [5, 8]
    assert [event.step for event in events.Images("posterior")] == [8]


@pytest.mark.filterwarnings("ignore:An observation of robot 0 cannot be a measurement")
def test_readings_that_are_no_measurements_are_no_part_of_the_errors(
    load_agent: Load, make_env: MakeEnv, tmp_path: Path
) -> None:
    class Blinks(gym.ObservationWrapper):
        steps = 0

        def observation(self, observation: Any) -> Any:
            self.steps += 1
            return np.full_like(observation, np.nan) if self.steps % 4 == 0 else observation

    agent, logger = load_agent(**FAST), configure(str(tmp_path), ["tensorboard"])
    env = FAMLEWrapper(Blinks(make_env()), agent, AdaptationLog(agent, logger))
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        obs, *_ = env.step(agent.predict(obs)[0])
    env.close()
    logger.close()
    events = read(tmp_path)
    assert events.Scalars("health/quarantined")[-1].value == 10
    assert all(0 < event.value < 100 for event in events.Scalars("prediction/error_after"))


def test_nothing_is_written_without_a_folder_or_an_interval(load_agent: Load, tmp_path: Path) -> None:
    agent = load_agent(**FAST, tensorboard_log=str(tmp_path))
    agent.learn(10, log_interval=None)
    assert read(tmp_path / "FAMLE_1").Tags()["scalars"] == []
    AdaptationLog(agent, Logger(None, [])).step(agent.newest, [1.0], [False])


def test_robots_side_by_side_are_counted_together(load_agent: Load, tmp_path: Path) -> None:
    agent = load_agent(**FAST, tensorboard_log=str(tmp_path))
    agent.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0", max_episode_steps=7)] * 2))
    agent.learn(40)
    events = read(tmp_path / "FAMLE_1")
    assert steps_of(events, "prediction/error_after") == [10, 20, 30, 40]
    assert len(events.Images("prediction/path")) > 0


def test_an_agent_without_embeddings_is_shown_too(transitions: Transitions, tmp_path: Path) -> None:
    agent = AMPC("reacher", device="cpu", seed=0, hidden=(8,), tensorboard_log=str(tmp_path), **FAST)
    agent.meta_learn(transitions).learn(10)
    agent.get_env().close()
    assert set(read(tmp_path / "AMPC_1").Tags()["scalars"]) >= NUMBERS - {"posterior/joint 3 dead"}


def test_an_agent_that_never_adapts_is_shown_all_the_same(load_agent: Load, tmp_path: Path) -> None:
    agent = load_agent(adapt_every=0, candidates=4, planner_iterations=1, tensorboard_log=str(tmp_path))
    agent.learn(25)
    events = read(tmp_path / "FAMLE_1")
    assert steps_of(events, "prediction/error_after") == [10, 20, 25]
    unadapted, after = ([e.value for e in events.Scalars(f"prediction/error_{n}")] for n in ("unadapted", "after"))
    assert unadapted == after
    assert "time/adapt_ms" not in events.Tags()["scalars"]


def test_return_begins_anew_in_each_episode(load_agent: Load, make_env: MakeEnv, tmp_path: Path) -> None:
    agent: ModelBasedAgent = load_agent(**FAST)
    agent.learn(5)
    logger = configure(str(tmp_path), ["tensorboard"])
    log = AdaptationLog(agent, logger)
    newest = agent.newest
    assert newest is not None
    assert newest.adapted
    for reward, done in ((1.0, False), (2.0, True), (4.0, False)):
        log.step(newest, [reward], [done])
    log.step(None, [8.0], [False])  # which was no transition
    log.step(newest, [16.0], [False])
    logger.close()
    events = read(tmp_path)
    assert [(e.step, e.value) for e in events.Scalars("episode/return_so_far")] == [(1, 1), (2, 3), (3, 4), (5, 28)]
    assert [e.value for e in events.Scalars("step/reward")] == [1, 2, 4, 12]


# --- pictures -----------------------------------------------------------------------------------------------


def test_picture_of_the_posterior_is_bright_where_a_situation_is_likely() -> None:
    posterior = np.zeros((100, 30))
    posterior[:50, 3], posterior[50:, 20] = 1.0, 1.0
    drawn = np.asarray(draw_posterior(posterior, [f"situation {i}" for i in range(30)], 1, 100).convert("L"))
    bars = drawn[:-18, 280:]
    rows = bars.reshape(12, 18, -1).mean(axis=1)
    likely = rows > 150
    assert likely[:, 10].sum() == likely[:, -10].sum() == 1
    assert likely[:, 10].argmax() < likely[:, -10].argmax()


def test_picture_of_a_path_shows_what_changes_and_where_predictions_are_off() -> None:
    real = np.zeros((11, 6))
    real[:, 2], real[:, 4] = np.linspace(0, 1, 11), np.linspace(0, 9, 11)
    ways = [PredictedPath(0, real, real), PredictedPath(10, real, real[::-1])]
    dims = liveliest(ways, np.array([1, 1, 1, 1, 100, 1.0]))
    assert 2 in dims
    assert len(dims) == 4
    pixels = np.asarray(draw_paths(ways, [2]))
    red = (pixels[:110] == (255, 0, 0)).all(axis=2)
    black = (pixels[:110, 120:] == (0, 0, 0)).all(axis=2)
    assert red[:, 450:].sum() > 100  # over the right half, where the prediction goes the other way
    assert black[:, 330:].sum() > 100
    assert not black[:, :300].any()  # hidden where both are the same
