"""Learning curves: the returns of one episode after the other since the damage (the paper's figures 3 and 4)."""

from __future__ import annotations

import time
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor

from benchmarks.harness import Result
from benchmarks.methods import Task

__all__ = ["run"]


def run(agent: BaseAlgorithm, task: Task, steps: int) -> Result:
    """One replicate: an agent learns, adapts or plans, each in its way, for some steps on the broken robot."""
    env: Monitor[Any, Any] = Monitor(task.make())
    agent.set_env(env)
    agent.set_random_seed(task.seed)
    start = time.perf_counter()
    agent.learn(steps)
    seconds = time.perf_counter() - start
    result = {
        "situation": str(task.situation),
        "returns": [round(value, 3) for value in env.get_episode_rewards()],
        "lengths": env.get_episode_lengths(),
        "seconds_per_step": seconds / max(1, env.get_total_steps()),
    }
    env.close()
    return result
