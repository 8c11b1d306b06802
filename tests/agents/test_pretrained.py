from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from famle_agent import FAMLE, NotLearnedError, Transitions
from famle_agent.agents.presets import Robot, known_robots
from tests.conftest import SMALL

MakeEnv = Callable[..., gym.Env[Any, Any]]


@pytest.fixture
def shipped(agent_file: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """As if the package shipped the small agent for the reacher."""
    monkeypatch.setattr(Robot, "pretrained", property(lambda robot: agent_file if robot.name == "reacher" else None))
    return agent_file


def test_robot_without_a_shipped_agent_begins_without_a_model() -> None:
    assert known_robots()["default"].pretrained is None
    assert FAMLE("Pendulum-v1", device="cpu").dynamics is None


@pytest.mark.parametrize("situation", [None, "joint 3 dead"])
def test_shipped_agent_knows_what_was_learnt(shipped: Path, make_env: MakeEnv, situation: str | None) -> None:
    """In any situation of the robot, and with any planner."""
    agent = FAMLE(
        make_env(situation=situation), device="cpu", seed=0, **SMALL | {"horizon": 3, "planner": "mppi", "elites": 0}
    )
    stored = FAMLE.load(shipped, device="cpu")
    assert agent.situations == stored.situations
    for name, value in stored.dynamics.state_dict().items():
        assert torch.equal(agent.dynamics.state_dict()[name], value)
    assert agent.config.planner.horizon == 3
    assert agent.predict(np.zeros(12, np.float32))[0].shape == (5,)
    stored.get_env().close()


@pytest.mark.parametrize(
    "settings",
    [{"hidden": (8,)}, {"inner_steps": 1}, {"angle_dims": ()}, {"pretrained": False}],
    ids=["network", "learning", "angles", "not wanted"],
)
def test_shipped_agent_that_does_not_fit_is_left(shipped: Path, make_env: MakeEnv, settings: dict[str, Any]) -> None:
    agent = FAMLE(make_env(), device="cpu", seed=0, **SMALL | settings)
    assert agent.dynamics is None
    assert agent.situations == ()
    reason = "" if "pretrained" in settings else f" The model that is shipped has another {next(iter(settings))}."
    with pytest.raises(NotLearnedError, match=rf"no model yet\.{re.escape(reason)} Call meta_learn"):
        agent.posterior()


def test_shipped_agent_serves_another_goal(shipped: Path, make_env: MakeEnv) -> None:
    """What the robot should do is no part of what was learnt of it."""
    assert FAMLE(make_env(goal=(1.0, 0.5)), device="cpu", seed=0, **SMALL).dynamics is not None


def test_wrapped_environment_has_no_shipped_agent(shipped: Path, make_env: MakeEnv) -> None:
    wrapped = gym.wrappers.RescaleAction(make_env(), np.float32(-0.5), np.float32(0.5))
    reward_fn = make_env().get_wrapper_attr("reward_fn")
    assert FAMLE(wrapped, device="cpu", seed=0, reward_fn=reward_fn, **SMALL).dynamics is None


def test_seed_decides_what_a_shipped_agent_does(shipped: Path, make_env: MakeEnv) -> None:
    obs = np.zeros(12, np.float32)
    one, same, other = (FAMLE(make_env(), device="cpu", seed=s, **SMALL).predict(obs)[0] for s in (5, 5, 6))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_meta_learning_learns_anew_all_the_same(shipped: Path, make_env: MakeEnv, transitions: Transitions) -> None:
    agent = FAMLE(make_env(), device="cpu", seed=0, **SMALL)
    before = agent.dynamics
    agent.meta_learn(transitions, callback=lambda *_: False)
    assert agent.dynamics is not before


def test_file_that_is_loaded_is_not_mixed_with_the_shipped_one(shipped: Path, tmp_path: Path) -> None:
    agent = FAMLE("reacher", device="cpu", pretrained=False, **SMALL)
    agent.save(tmp_path / "empty.zip")
    loaded = FAMLE.load(tmp_path / "empty.zip", device="cpu")
    assert loaded.dynamics is None
    for one in (agent, loaded):
        one.get_env().close()
