"""Learning curves: the returns of one episode after the other since the damage (the paper's figures 3 and 4)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.harness import Result
from benchmarks.lives import History, Repeatable, read_life, write_life
from benchmarks.methods import about
from benchmarks.task import Task
from famle_agent import ModelBasedAgent

__all__ = ["run"]


def run(
    agent: BaseAlgorithm,
    tasks: Sequence[Task],
    steps: int,
    saved: Path | None = None,
    save_every: float = 60.0,
    minutes: float = math.inf,
) -> list[Result]:
    """One replicate, or many in step: an agent learns, adapts or plans, each in its way, on broken robots.

    Args:
        agent: Acts on all the robots.
        tasks: The test robots; the seed of the first is the agent's.
        steps: Of each robot.
        saved: The file of an agent's life, which goes on from there and is saved there.
        save_every: Seconds between two savings at least. It waits for the end of an episode, or where an agent learns
            from rollouts for the beginning of one: the episode that is going on then is not counted.
        minutes: Wall time after which a model-based agent ends with the episode; only whole episodes are counted.

    Raises:
        ValueError: The steps do not suffice for one episode.
    """
    if steps < (episode := gym.spec(tasks[0].env_id).max_episode_steps or 0):
        raise ValueError(f"{steps} robot steps are no whole episode; a curve needs {episode} at least.")
    robots = [Repeatable(task.make()) for task in tasks]
    envs: list[Monitor[Any, Any]] = [Monitor(robot) for robot in robots]
    vec_env = DummyVecEnv([partial(_itself, env) for env in envs])
    agent.set_env(vec_env)
    agent.set_random_seed(tasks[0].seed)
    history = History([[] for _ in tasks], [[] for _ in tasks])
    if saved is not None and (earlier := read_life(saved, agent)) is not None:
        history = earlier
        for robot, state in zip(robots, history.random, strict=True):
            robot.begin_with(state)
    historian = _Historian(history, envs, saved, save_every, minutes)
    if (missing := steps - history.steps) > 0:
        agent.learn(missing * len(envs), callback=historian)
    vec_env.close()
    return [_result(task, historian.history, i, steps) | about(agent, i) for i, task in enumerate(tasks)]


class _Historian(BaseCallback):
    """Notes what robots go through, and saves it now and then."""

    def __init__(
        self,
        earlier: History,
        envs: Sequence[Monitor[Any, Any]],
        saved: Path | None,
        save_every: float,
        minutes: float,
    ) -> None:
        super().__init__()
        self._earlier, self._envs, self._saved, self._save_every = earlier, envs, saved, save_every
        self._minutes = minutes
        self._start = self._saved_at = time.perf_counter()

    @property
    def history(self) -> History:
        """All until now."""
        episodes = zip(self._earlier.returns, self._earlier.lengths, self._envs, strict=True)
        returns, lengths = zip(
            *(([*r, *env.get_episode_rewards()], [*n, *env.get_episode_lengths()]) for r, n, env in episodes),
            strict=True,
        )
        seconds = self._earlier.seconds + time.perf_counter() - self._start
        return History(returns, lengths, seconds, [env.get_wrapper_attr("began_with") for env in self._envs])

    def _on_step(self) -> bool:
        if isinstance(self.model, ModelBasedAgent) and self.locals["dones"].all():
            self._save()
            return time.perf_counter() - self._start < 60.0 * self._minutes
        return True

    def _on_rollout_start(self) -> None:
        if not isinstance(self.model, ModelBasedAgent):
            self._save()

    def _save(self) -> None:
        if self._saved is not None and time.perf_counter() - self._saved_at >= self._save_every:
            write_life(self._saved, self.model, self.history)
            self._saved_at = time.perf_counter()


def _result(task: Task, history: History, i: int, steps: int) -> Result:
    """What is stored of a robot: its whole episodes within some steps."""
    lengths = history.lengths[i]
    whole = int(np.searchsorted(np.cumsum(lengths), steps, side="right"))
    return {
        "situation": str(task.situation),
        "returns": [round(value, 3) for value in history.returns[i][:whole]],
        "lengths": list(lengths[:whole]),
        "wall_seconds": history.seconds,  # of all sittings of a life that was interrupted
        "seconds_per_step": history.seconds / sum(map(sum, history.lengths)),
    }


def _itself(env: Monitor[Any, Any]) -> Monitor[Any, Any]:
    return env
