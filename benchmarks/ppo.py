"""The model-free rival: Stable-Baselines3's PPO as it is, which learns on the broken robot."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

from benchmarks.task import Task
from famle_agent.utils.atomic_write import whole_file
from famle_envs.wrappers import RandomSituation

__all__ = ["from_scratch", "learn_simulated", "simulated_first"]

SETTINGS: Mapping[str, Mapping[str, Any]] = {
    # 100 steps between updates instead of 2,048, or it would not learn at all in the steps the others need.
    "reacher": {"n_steps": 100, "batch_size": 50},
}
"""What differs from Stable-Baselines3's own defaults on the broken robot."""

SIMULATED_SETTINGS: Mapping[str, Any] = {"n_steps": 256, "batch_size": 256}
"""The same in simulation, where it has eight robots at once."""

SIMULATED_STEPS = {"reacher": 500_000, "ant": 2_000_000}
"""Of the PPO that is trained over the training situations first; FAMLE has 22,000 and 300,000."""

LEAST_LOG_STD = -1.0
"""Logarithm of the least deviation by which the latter explores when the robot breaks, 0.37: what training in
simulation leaves may be too little to learn by. It is 0.1 to 0.36 on the ant, and 0.42 to 0.66 on the arm."""


def from_scratch(task: Task) -> PPO:
    """A PPO that knows nothing when the robot breaks."""
    return PPO("MlpPolicy", Monitor(task.make()), seed=task.seed, device="cpu", **SETTINGS.get(task.robot, {}))


def simulated_first(task: Task) -> PPO:
    """One that was trained in simulation, with a training situation drawn for each episode."""
    agent = from_scratch(task)
    agent.set_parameters(str(learn_simulated(task)), device="cpu")
    with torch.no_grad():
        agent.policy.log_std.clamp_(min=LEAST_LOG_STD)
    return agent


def learn_simulated(task: Task, save_every: float = 60.0) -> Path:
    """Trains in simulation, unless the cache has such a PPO.

    Training that is stopped goes on, if it is asked for again, from the beginning of a rollout: with the networks and
    the optimizer, but with other random numbers.

    Args:
        task: Says the robot and the cache.
        save_every: Seconds between two savings at least.

    Returns:
        The file with the trained agent.
    """
    path = task.cache / f"{task.robot}-ppo.zip"
    on_its_way = path.with_suffix(".on-its-way.zip")
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        env = make_vec_env(lambda: RandomSituation(gym.make(task.env_id)), n_envs=8, seed=0)
        if on_its_way.exists():
            agent = PPO.load(on_its_way, env=env, device="cpu")
            agent.set_random_seed(agent.num_timesteps)
        else:
            agent = PPO("MlpPolicy", env, seed=0, device="cpu", **SIMULATED_SETTINGS)
        missing = SIMULATED_STEPS[task.robot] - agent.num_timesteps
        saving = _Saving(on_its_way, save_every)
        agent.learn(missing, callback=saving, reset_num_timesteps=False, progress_bar=True)
        _save(agent, path)
        env.close()
    on_its_way.unlink(missing_ok=True)
    return path


class _Saving(BaseCallback):
    """Saves an agent now and then, when a rollout begins."""

    def __init__(self, path: Path, save_every: float) -> None:
        super().__init__()
        self._path, self._save_every = path, save_every
        self._saved_at = time.perf_counter()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if time.perf_counter() - self._saved_at >= self._save_every:
            _save(self.model, self._path)
            self._saved_at = time.perf_counter()


def _save(agent: Any, path: Path) -> None:
    with whole_file(path) as partial, partial.open("wb") as file:
        agent.save(file)
