"""The last look at planning in simulation: how long it was, and what errors it takes for usual."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from famle_agent import FAMLE
from famle_agent.agents.check import check_plans
from tests.helpers import random_transitions

SITUATIONS = ["intact", "joint 0 dead"]


@pytest.fixture
def filtering(load_agent: Callable[..., FAMLE]) -> FAMLE:
    """An agent that measures its own errors, as by default, and adapts and plans in little time."""
    quick = {"adapt_steps": 0, "candidates": 4, "planner_iterations": 1, "elites": 2}
    return load_agent(hazard=1e-3, adapt_every=2, memory_size=20, **quick)


def test_errors_are_those_of_the_robots_in_the_end(filtering: FAMLE) -> None:
    found = check_plans(filtering, filtering.situation_envs(SITUATIONS), seed=0)
    assert found.situations == tuple(SITUATIONS)
    assert found.steps == 50  # an episode of the arm, though 200 were allowed
    assert found.errors.shape == (2,)
    assert found.errors.min() > 0.0
    np.testing.assert_array_equal(
        check_plans(filtering, filtering.situation_envs(SITUATIONS), seed=0).errors, found.errors
    )


def test_environment_that_fails_names_its_situation(filtering: FAMLE) -> None:
    def failing() -> gym.Env[Any, Any]:
        env = gym.make("FamleReacher-v0")
        env.unwrapped.step = lambda action: 1 / 0  # type: ignore[assignment]
        return env

    envs = filtering.situation_envs({"good": lambda: gym.make("FamleReacher-v0"), "bad": failing})
    with pytest.raises(ZeroDivisionError, match="in the situation 'bad'"):
        check_plans(filtering, envs, seed=0)


def test_diagnosis_measures_errors_in_usual_ones(filtering: FAMLE) -> None:
    transitions = random_transitions(filtering.model, 1, 30)
    for i in range(30):
        filtering.observe(*(values[0, i].numpy() for values in transitions))
    error = filtering.diagnose().error
    filtering.model.usual_error.fill_(4.0)
    assert filtering.diagnose().error == pytest.approx(error / 4.0)


def test_meta_learning_measures_what_is_usual(tmp_path: Path) -> None:
    little: dict[str, Any] = {"transitions_per_situation": 20, "meta_iterations": 2, "candidates": 4, "elites": 2}
    agent = FAMLE("reacher", seed=0, device="cpu", planner_iterations=1, **little)
    agent.meta_learn(SITUATIONS, check=False)
    assert float(agent.model.usual_error) == 1.0
    agent.meta_learn(SITUATIONS)
    assert agent.last_check is not None
    usual = float(np.median(agent.last_check.errors).clip(min=1.0))
    assert float(agent.model.usual_error) == pytest.approx(usual)
    agent.save(tmp_path / "agent.zip")
    assert float(FAMLE.load(tmp_path / "agent.zip", device="cpu").model.usual_error) == pytest.approx(usual)


def test_weights_of_older_files_take_fitted_errors_for_usual(filtering: FAMLE) -> None:
    weights = filtering.model.state_dict()
    del weights["usual_error"]
    filtering.model.usual_error.fill_(4.0)
    filtering.model.load_state_dict(weights)
    assert torch.equal(filtering.model.usual_error, torch.ones(()))
