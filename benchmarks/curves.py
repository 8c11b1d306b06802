"""Learning curves: the returns of one episode after the other since the damage (the paper's figures 3 and 4)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.methods import about
from benchmarks.results import Result
from benchmarks.task import Task
from famle_agent import ModelBasedAgent


def run(agent: BaseAlgorithm, tasks: Sequence[Task], steps: int, minutes: float = math.inf) -> list[Result]:
    """Lets an agent learn, adapt or plan, each in its way, on one broken robot or on many in step.

    Args:
        agent: Acts on all the robots.
        tasks: The test robots; the seed of the first is the agent's.
        steps: Of each robot.
        minutes: Wall time after which a model-based agent ends with the episode; only whole episodes are counted.

    Raises:
        ValueError: The steps do not suffice for one episode.
    """
    if steps < (episode := gym.spec(tasks[0].env_id).max_episode_steps or 0):
        raise ValueError(f"{steps} robot steps are no whole episode; a curve needs {episode} at least.")
    envs = [Monitor(task.make()) for task in tasks]
    vec_env = DummyVecEnv([_maker(env) for env in envs])
    agent.set_env(vec_env)
    agent.set_random_seed(tasks[0].seed)
    start = time.perf_counter()
    agent.learn(steps * len(envs), callback=_TimeLimit(60.0 * minutes))
    seconds_per_step = (time.perf_counter() - start) / sum(sum(env.get_episode_lengths()) for env in envs)
    vec_env.close()
    curves = zip(tasks, envs, strict=True)
    return [
        _result(task, env, steps) | {"seconds_per_step": seconds_per_step} | about(agent, i)
        for i, (task, env) in enumerate(curves)
    ]


class _TimeLimit(BaseCallback):
    """Stops a model-based agent at the end of an episode when its time is over."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._end = time.perf_counter() + seconds

    def _on_step(self) -> bool:
        if isinstance(self.model, ModelBasedAgent) and self.locals["dones"].all():
            return time.perf_counter() < self._end
        return True


def _result(task: Task, env: Monitor[Any, Any], steps: int) -> Result:
    """What is stored of a robot: its whole episodes within some steps."""
    returns, lengths = env.get_episode_rewards(), env.get_episode_lengths()
    whole = int(np.searchsorted(np.cumsum(lengths), steps, side="right"))
    return {
        "situation": str(task.situation),
        "returns": [round(value, 3) for value in returns[:whole]],
        "lengths": lengths[:whole],
    }


def _maker(env: Monitor[Any, Any]) -> Callable[[], Monitor[Any, Any]]:
    return lambda: env
