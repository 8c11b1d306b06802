from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import configure

from famle_agent import FAMLE, FAMLEWrapper, ModelBasedAgent

Load = Callable[..., FAMLE]
EXPLODES: dict[str, Any] = {"adapt_optimizer": "sgd", "adapt_lr": 1e6, "adapt_every": 5}


@pytest.fixture
def exploding(load_agent: Load) -> FAMLE:
    """An agent whose gradient steps always leave the finite numbers."""
    return load_agent(**EXPLODES)


def test_divergence_is_counted_and_warned_of_once(exploding: FAMLE) -> None:
    meta_learned = exploding.belief.theta
    env = FAMLEWrapper(gym.make("FamleReacher-v0"), exploding)
    obs, info = env.reset(seed=0)
    assert info["famle"]["diverged"] == 0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(15):
            obs, *_, info = env.step(exploding.predict(obs)[0])
    (told,) = (str(one.message) for one in caught if "diverged" in str(one.message))
    assert "Adaptation 1 diverged" in told
    assert "smaller rates (adapt_lr, adapt_embedding_lr)" in told
    assert (info["famle"]["adaptations"], info["famle"]["diverged"]) == (3, 3)
    for name, value in exploding.belief.theta.items():
        assert torch.equal(value, meta_learned[name])
    env.close()


def test_steps_that_go_well_are_not_counted(load_agent: Load) -> None:
    agent = load_agent(adapt_every=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent.learn(15)
    assert (agent.belief.adaptations, agent.belief.diverged.tolist()) == (3, [0])


@pytest.mark.filterwarnings("ignore:.*diverged")
def test_count_outlasts_saving_and_episodes(exploding: FAMLE, tmp_path: Path) -> None:
    exploding.learn(60)
    assert exploding.belief.diverged.tolist() == [12]
    exploding.save(tmp_path / "agent.zip")
    loaded = FAMLE.load(tmp_path / "agent.zip", device="cpu")
    assert loaded.belief.diverged.tolist() == [12]
    loaded.forget()
    assert loaded.belief.diverged.tolist() == [0]
    loaded.get_env().close()


@pytest.mark.filterwarnings("ignore:.*diverged")
def test_tensorboard_is_told(exploding: FAMLE, tmp_path: Path) -> None:
    exploding.set_logger(configure(str(tmp_path), ["csv"]))
    exploding.learn(50)
    header, row = (tmp_path / "progress.csv").read_text().splitlines()[:2]
    values = dict(zip(header.split(","), row.split(","), strict=True))
    assert (values["adapt/adaptations"], values["adapt/diverged"]) == ("10", "10")


@pytest.mark.filterwarnings("ignore:.*diverged")
def test_state_counts_for_each_robot(exploding: FAMLE) -> None:
    agent: ModelBasedAgent = exploding
    obs, state = np.zeros((2, 12), dtype=np.float32), None
    for t in range(11):
        start = np.array([False, t == 10])
        _, state = agent.predict(obs, state, start)
    assert state is not None
    assert state.belief.diverged.tolist() == [2, 2]
