from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.agents.presets import known_robots
from famle_agent.rollout import rollout

MakeEnv = Callable[..., gym.Env[Any, Any]]
ROBOTS = {"quadruped": 20, "a1": 20, "minitaur": 9}
TO_A_GOAL = ["quadruped", "a1"]


@pytest.mark.parametrize(("robot", "n_situations"), ROBOTS.items())
def test_package_ships_a_small_model_of_these_settings(robot: str, n_situations: int) -> None:
    agent = FAMLE(robot, seed=0, device="cpu")
    agent.get_env().close()
    assert agent.dynamics is not None
    assert agent.dynamics.members == agent.config.model.members
    assert len(agent.situations) == n_situations
    assert agent.situations[0] == "intact"
    file = known_robots()[robot].pretrained
    assert file is not None
    assert len(file.read_bytes()) < 400_000


@pytest.mark.parametrize("robot", ROBOTS)
def test_shipped_model_serves_held_out_dynamics(robot: str, make_env: MakeEnv) -> None:
    env = make_env(known_robots()[robot].env_id, profile="held-out")
    assert FAMLE(env, device="cpu").dynamics is not None


@pytest.mark.parametrize("robot", TO_A_GOAL)
def test_shipped_model_serves_any_goal(robot: str, make_env: MakeEnv) -> None:
    for goal in ((0.0, 1.0), (-1.0, -0.5)):
        env = make_env(known_robots()[robot].env_id, goal=goal)
        served = FAMLE(env, seed=0, device="cpu")
        run = rollout(FAMLEWrapper(env, served), seed=0)
        assert run.success
        assert run.steps < 20


@pytest.mark.slow
@pytest.mark.parametrize("robot", TO_A_GOAL)
@pytest.mark.parametrize("situation", ["back right leg blocked", "yaw sensor off by 30 deg"])
def test_robot_reaches_its_goal_on_held_out_dynamics(robot: str, situation: str, make_env: MakeEnv) -> None:
    agent = FAMLE(robot, seed=0, device="cpu")
    agent.get_env().close()
    env = make_env(known_robots()[robot].env_id, situation=situation, profile="held-out")
    assert rollout(FAMLEWrapper(env, agent), seed=0).success


@pytest.mark.slow
def test_minitaur_walks_on_held_out_dynamics(make_env: MakeEnv) -> None:
    agent = FAMLE("minitaur", seed=0, device="cpu")
    agent.get_env().close()
    env = make_env("FamleMinitaur-v0", profile="held-out", max_episode_steps=20)
    run = rollout(FAMLEWrapper(env, agent), seed=0)
    assert not run.fell
    assert run.position[-1, 0] > 2.0
