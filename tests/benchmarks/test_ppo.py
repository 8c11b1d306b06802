from __future__ import annotations

from pathlib import Path

import pytest
import torch
from stable_baselines3 import PPO

from benchmarks import ppo
from tests.small_reacher import task_of

pytestmark = pytest.mark.usefixtures("small_reacher")


def weights_of(agent: PPO) -> torch.Tensor:
    return torch.cat([value.detach().flatten() for value in agent.policy.parameters()])


def test_what_was_trained_in_simulation_is_where_the_broken_robot_begins(tmp_path: Path) -> None:
    task = task_of(1, tmp_path)
    path = ppo.learn_simulated(task)
    trained = PPO.load(path)
    assert list(tmp_path.iterdir()) == [path]
    assert torch.equal(weights_of(ppo.simulated_first(task)), weights_of(trained))
    assert not torch.equal(weights_of(ppo.from_scratch(task)), weights_of(trained))


def test_broken_robot_is_explored_however_little_was_left_to_explore_in_simulation(tmp_path: Path) -> None:
    task = task_of(1, tmp_path)
    path = ppo.learn_simulated(task)
    trained = PPO.load(path, device="cpu")
    with torch.no_grad():
        trained.policy.log_std.copy_(torch.tensor([-3.0, -2.0, -1.0, 0.0, 1.0]))
    trained.save(path)
    begins_with = ppo.simulated_first(task).policy.log_std
    assert begins_with.tolist() == [-1.0, -1.0, -1.0, 0.0, 1.0]
