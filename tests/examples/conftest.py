from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import pytest

from examples.own_mjcf import Arm
from famle_agent import FAMLE
from famle_envs.faults import actuator_faults


@pytest.fixture(scope="session")
def arm_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An agent of the arm that has hardly learnt anything, and plans in little time."""
    quick = {"policy_steps": 0, "hidden": (8,), "members": 2, "candidates": 8, "elites": 2, "planner_iterations": 1}
    agent = FAMLE("OwnArm-v0", seed=0, transitions_per_situation=40, joint_iterations=5, adapt_steps=2, **quick)
    path = tmp_path_factory.mktemp("arm") / "arm.zip"
    agent.meta_learn(actuator_faults(gym.make("OwnArm-v0")), check=False).save(path)
    agent.get_env().close()
    return path


@pytest.fixture
def arm_agent(arm_file: Path) -> FAMLE:
    """That agent on a robot without a simulator."""
    return FAMLE.load(arm_file, reward_fn=Arm.reward_fn, blind_steps=2, safe_action=(0.0, 0.0, 0.0))
