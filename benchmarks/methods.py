"""The methods that are compared, each through the face of a Stable-Baselines3 algorithm."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor

import famle_envs  # noqa: F401 (registers the robots)
from benchmarks.harness import Result
from famle_agent import FAMLE
from famle_envs import Situation

__all__ = ["METHODS", "Task", "shipped"]


@dataclass(frozen=True)
class Task:
    """A robot that is broken from its first step on.

    Attributes:
        robot: The robot's name.
        env_id: Its environment.
        situation: What is wrong with it.
        steps: Robot steps to run.
        ppo_steps: Robot steps for PPO, which needs more.
        cache: Folder for meta-trained agents, which the methods of one seed share.
    """

    robot: str
    env_id: str
    situation: Situation
    steps: int
    ppo_steps: int
    cache: Path


def famle(task: Task, seed: int, mode: str = "ours", **overrides: Any) -> Result:
    """FAMLE, meta-trained over the robot's training situations, adapting on the broken robot."""
    agent = _meta_trained(task, seed, mode)
    return _live(FAMLE.load(agent, device="cpu", **overrides), task, seed)


def oracle(task: Task, seed: int) -> Result:
    """The upper line: a model of the very test situation, of as many transitions; it has nothing to adapt to."""
    probe = FAMLE(task.robot, device="cpu")
    situations = len(gym.make(task.env_id).get_wrapper_attr("training_situations"))
    n = situations * probe.hyperparameters.transitions_per_situation
    agent = FAMLE(task.robot, seed=seed, device="cpu", transitions_per_situation=n, adapt_every=0)
    agent.meta_learn([task.situation])
    return _live(agent, task, seed)


def shipped(robot: str, seed: int, **overrides: Any) -> FAMLE:
    """The agent that the package ships."""
    agent = FAMLE(robot, seed=seed, device="cpu", **overrides)
    if agent.dynamics is None:
        raise RuntimeError(f"The package ships no model that fits; make it with: famle meta-learn --robot {robot}")
    return agent


def ppo(task: Task, seed: int) -> Result:
    """Stable-Baselines3's PPO from scratch on the broken robot."""
    env = Monitor(gym.make(task.env_id, situation=task.situation))
    start = time.perf_counter()
    # 100 steps between updates instead of 2,048, or it would not learn at all in the steps the others need.
    PPO("MlpPolicy", env, n_steps=100, batch_size=50, seed=seed, device="cpu").learn(task.ppo_steps)
    return _result(env, time.perf_counter() - start)


METHODS: dict[str, Callable[[Task, int], Result]] = {
    "famle": famle,
    "famle-frozen": lambda task, seed: famle(task, seed, adapt_every=0),
    "famle-select": lambda task, seed: famle(task, seed, adapt_steps=0),
    "famle-paper": lambda task, seed: famle(task, seed, mode="paper"),
    "oracle": oracle,
    "ppo": ppo,
}
"""Method by name."""


def _meta_trained(task: Task, seed: int, mode: str) -> Path:
    """The agent of a seed, meta-trained once for all methods that start from it."""
    path = task.cache / f"{task.robot}-{mode}-{seed}.zip"
    if not path.exists():
        FAMLE(task.robot, mode, seed=seed, device="cpu").meta_learn().save(path)
    return path


def _live(agent: FAMLE, task: Task, seed: int) -> Result:
    env = Monitor(gym.make(task.env_id, situation=task.situation))
    agent.set_env(env)
    agent.set_random_seed(seed)
    start = time.perf_counter()
    agent.learn(task.steps)
    return _result(env, time.perf_counter() - start)


def _result(env: Monitor[Any, Any], seconds: float) -> Result:
    return {
        "situation": str(env.get_wrapper_attr("situation")),
        "returns": [round(value, 3) for value in env.get_episode_rewards()],
        "lengths": env.get_episode_lengths(),
        "seconds_per_step": seconds / max(1, env.get_total_steps()),
    }
