"""Learning curves: the returns of one episode after the other since the damage (the paper's figures 3 and 4)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.harness import Result
from benchmarks.methods import Task

__all__ = ["run"]


def run(agent: BaseAlgorithm, tasks: Sequence[Task], steps: int) -> list[Result]:
    """One replicate, or many in step: an agent learns, adapts or plans, each in its way, on broken robots.

    Args:
        agent: Acts on all the robots.
        tasks: The test robots; the seed of the first is the agent's.
        steps: Of each robot.
    """
    envs: list[Monitor[Any, Any]] = [Monitor(task.make()) for task in tasks]
    agent.set_env(DummyVecEnv([partial(_itself, env) for env in envs]))
    agent.set_random_seed(tasks[0].seed)
    start = time.perf_counter()
    agent.learn(steps * len(envs))
    seconds = time.perf_counter() - start
    results = [
        {
            "situation": str(task.situation),
            "returns": [round(value, 3) for value in env.get_episode_rewards()],
            "lengths": env.get_episode_lengths(),
            "seconds_per_step": seconds / sum(env.get_total_steps() for env in envs),
        }
        for task, env in zip(tasks, envs, strict=True)
    ]
    for env in envs:
        env.close()
    return results


def _itself(env: Monitor[Any, Any]) -> Monitor[Any, Any]:
    return env
