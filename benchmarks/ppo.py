"""The model-free rival: Stable-Baselines3's PPO as it is, which learns on the broken robot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

from benchmarks.task import Task
from famle_agent.utils.atomic_write import whole_file
from famle_envs.wrappers import RandomSituation

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
    """Makes a PPO that knows nothing when the robot breaks."""
    return PPO("MlpPolicy", Monitor(task.make()), seed=task.seed, device="cpu", **SETTINGS.get(task.robot, {}))


def simulated_first(task: Task) -> PPO:
    """Makes one that was trained in simulation, with a training situation drawn for each episode."""
    agent = from_scratch(task)
    agent.set_parameters(str(learn_simulated(task)), device="cpu")
    with torch.no_grad():
        agent.policy.log_std.clamp_(min=LEAST_LOG_STD)
    return agent


def learn_simulated(task: Task) -> Path:
    """Trains in simulation, unless the cache has such a PPO, and returns the file with the trained agent."""
    path = task.cache / f"{task.robot}-ppo.zip"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        env = make_vec_env(lambda: RandomSituation(task.simulated()), n_envs=8, seed=0)
        agent = PPO("MlpPolicy", env, seed=0, device="cpu", **SIMULATED_SETTINGS)
        agent.learn(SIMULATED_STEPS[task.robot], progress_bar=True)
        with whole_file(path) as partial, partial.open("wb") as file:
            agent.save(file)
        env.close()
    return path
