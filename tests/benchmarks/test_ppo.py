from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from benchmarks import ppo
from tests.small_reacher import SMALL_ROLLOUTS, task_of

ROLLOUT = 8 * SMALL_ROLLOUTS["n_steps"]
"""Steps of the eight simulated robots together."""

pytestmark = pytest.mark.usefixtures("small_reacher")


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, torch.Tensor]]:
    """After how many steps a PPO learnt from a rollout, and with which weights."""
    seen: list[tuple[int, torch.Tensor]] = []
    train = PPO.train

    def watch(self: PPO) -> None:
        seen.append((self.num_timesteps, weights_of(self)))
        train(self)

    monkeypatch.setattr(PPO, "train", watch)
    monkeypatch.setitem(ppo.SIMULATED_STEPS, "reacher", 4 * ROLLOUT)  # type: ignore[arg-type]
    return seen


def weights_of(agent: PPO) -> torch.Tensor:
    return torch.cat([value.detach().flatten() for value in agent.policy.parameters()])


def stop_after(rollouts: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupts the next training as Ctrl-C would."""
    collect_rollouts, collected = PPO.collect_rollouts, list[int]()

    def collect(self: PPO, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any) -> bool:
        collected.append(1)
        done = collect_rollouts(self, env, callback, *args, **kwargs)
        if len(collected) > rollouts:
            monkeypatch.setattr(PPO, "collect_rollouts", collect_rollouts)
            callback.on_training_end()  # closes the progress bar
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(PPO, "collect_rollouts", collect)


def test_stopped_training_in_simulation_goes_on(
    tmp_path: Path, trained: list[tuple[int, torch.Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(0, tmp_path)
    stop_after(2, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        ppo.learn_simulated(task, save_every=0.0)
    assert not (tmp_path / "reacher-ppo.zip").exists()
    path = ppo.learn_simulated(task, save_every=0.0)
    steps, weights = zip(*trained, strict=True)
    assert steps == (ROLLOUT, 2 * ROLLOUT, 3 * ROLLOUT, 4 * ROLLOUT)
    assert all(not torch.equal(one, other) for one, other in pairwise(weights))
    assert list(tmp_path.iterdir()) == [path]
    assert PPO.load(path).num_timesteps == 4 * ROLLOUT


def test_training_in_simulation_goes_on_with_the_weights_it_had(
    tmp_path: Path, trained: list[tuple[int, torch.Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    ppo.learn_simulated(task_of(0, tmp_path / "whole"))
    (_, (_, second), (_, third), _), _ = list(trained), trained.clear()
    stop_after(2, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        ppo.learn_simulated(task_of(0, tmp_path / "stopped"), save_every=0.0)
    assert torch.equal(trained[1][1], second)
    ppo.learn_simulated(task_of(0, tmp_path / "stopped"), save_every=0.0)
    assert torch.equal(trained[2][1], third)


def test_what_was_trained_in_simulation_is_where_the_broken_robot_begins(tmp_path: Path) -> None:
    task = task_of(1, tmp_path)
    trained = PPO.load(ppo.learn_simulated(task))
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
