"""Collecting transitions of N situations, in one process or many (lines 1 to 6 of Algorithm 1)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from joblib import delayed

from famle_agent.data import gate
from famle_agent.data.envs import opened
from famle_agent.data.policies import BatchPolicy, MakeBatchPolicy, MakePolicy
from famle_agent.data.transitions import EnvSource, Transitions
from famle_agent.data.watch import Watch
from famle_agent.utils.errors import in_situation
from famle_agent.utils.parallel import as_completed

__all__ = ["collect"]

Array = npt.NDArray[Any]


def collect(
    envs: Sequence[EnvSource],
    situations: Sequence[str],
    n: int,
    make_policy: MakePolicy | MakeBatchPolicy,
    seed: int,
    callback: Callable[[int], object] = lambda _: None,
    n_jobs: int = 1,
    folder: Path | None = None,
    episode_length: int = 0,
) -> Transitions:
    """Runs a policy in the environment of each situation (lines 1 to 6 of Algorithm 1).

    Args:
        envs: One environment, or what makes it, per situation.
        situations: What each is called.
        n: Transitions per situation.
        make_policy: Makes the policy of a situation, or of several that are simulated side by side.
        seed: Seed of the environments and the policies. What is collected does not depend on ``n_jobs``.
        callback: Called with the number of new transitions after each situation.
        n_jobs: Parallel processes, -1 for one a core; environments that exist already stay in this one, and so do
            those that are simulated beside them.
        folder: Where each situation's transitions are stored as soon as they are there. What it holds of an earlier
            run that was stopped is not collected again.
        episode_length: Steps after which an episode is cut short; 0 leaves its end to the environment.

    Returns:
        The transitions; the step that a reset interrupts is no transition and is not among them.

    Raises:
        ValueError: The folder holds transitions of other situations, or of another number; or an environment returns
            what is no transition.
        Exception: What an environment raises, with a note that names the situation.
    """
    maker = make_policy if isinstance(make_policy, MakeBatchPolicy) else _OneByOne(make_policy)
    sequences = np.random.SeedSequence(seed).spawn(len(envs))
    robots = [_Robot(*robot) for robot in zip(range(len(envs)), envs, situations, sequences, strict=True)]
    # Products of another size round otherwise, so that batches must not depend on the number of processes.
    batches = np.array_split(np.arange(len(robots)), -(-len(robots) // maker.batch_size))
    tasks = [_Task([robots[i] for i in batch], n, maker, folder, episode_length) for batch in batches]
    parts: dict[int, Transitions] = {}
    for here in (True, False):
        some = [task for task in tasks if task.stays_here == here]
        calls = (delayed(_in_process)(task, os.getpid()) for task in some)
        for of_batch in as_completed(calls, n_jobs=1 if here else n_jobs):
            parts |= of_batch
            for _ in of_batch:
                callback(n)
    arrays = {
        name: np.concatenate([getattr(parts[i], name) for i in range(len(envs))])
        for name in ("obs", "action", "reward", "next_obs")
    }
    ended = np.concatenate([parts[i].ended for i in range(len(envs))])
    return Transitions(**arrays, situations=tuple(situations), terminated=ended if ended.any() else None)


@dataclass(frozen=True)
class _OneByOne:
    """Has the policy of one situation act for a batch of one."""

    make_policy: MakePolicy
    batch_size: int = 1

    def __call__(
        self, envs: Sequence[gym.Env[Any, Any]], situations: Sequence[int], rng: np.random.Generator
    ) -> BatchPolicy:
        policy = self.make_policy(envs[0], situations[0], rng)
        return lambda obs, episode_start: np.asarray(policy(obs[0], bool(episode_start[0])))[None]


@dataclass(frozen=True)
class _Robot:
    """A robot in one situation."""

    index: int
    source: EnvSource
    situation: str
    sequence: np.random.SeedSequence


@dataclass(frozen=True)
class _Task:
    """The transitions of a batch of robots, to be collected side by side or to be read where that was done before."""

    robots: Sequence[_Robot]
    n: int
    maker: MakeBatchPolicy
    folder: Path | None
    episode_length: int

    @property
    def stays_here(self) -> bool:
        """Whether an environment is there already, which cannot be sent to another process."""
        return any(isinstance(robot.source, gym.Env) for robot in self.robots)

    def run(self) -> dict[int, Transitions]:
        parts = {robot.index: part for robot in self.robots if (part := self._stored(robot)) is not None}
        if len(parts) == len(self.robots):
            return parts
        # Where some are missing, all are simulated once more: what is planned for one depends on who is beside it.
        for robot, part in zip(self.robots, self._collected(), strict=True):
            if robot.index in parts:
                continue
            parts[robot.index] = part
            if self.folder is not None:
                self.folder.mkdir(parents=True, exist_ok=True)
                part.save(self._path(robot, self.folder))
        return parts

    @staticmethod
    def _path(robot: _Robot, folder: Path) -> Path:
        return folder / f"situation-{robot.index:03d}.npz"

    def _stored(self, robot: _Robot) -> Transitions | None:
        if self.folder is None or not (path := self._path(robot, self.folder)).exists():
            return None
        stored = Transitions.load(path)
        if stored.situations != (robot.situation,) or stored.obs.shape[:2] != (1, self.n):
            raise ValueError(
                f"{path} holds {stored.obs.shape[1]} transitions of {stored.situations[0]!r} instead of {self.n} "
                f"of {robot.situation!r}: it is of another run. Give another folder, or delete this one."
            )
        return stored

    def _collected(self) -> list[Transitions]:
        with ExitStack() as stack:
            envs = [stack.enter_context(opened(robot.source, robot.situation)) for robot in self.robots]
            rng = np.random.default_rng(self.robots[0].sequence)
            policy = self.maker(envs, [robot.index for robot in self.robots], rng)
            rollouts = [_Rollout(env, robot, self.episode_length) for env, robot in zip(envs, self.robots, strict=True)]
            for _ in range(self.n):
                obs = np.stack([rollout.obs for rollout in rollouts])  # (B, obs_dim)
                actions = policy(obs, np.array([rollout.episode_start for rollout in rollouts]))
                for rollout, action in zip(rollouts, actions, strict=True):
                    rollout.step(action)
            return [rollout.transitions() for rollout in rollouts]


class _Rollout:
    """Steps a robot through one episode after the other, and keeps its transitions.

    Attributes:
        obs: Where it is, (obs_dim,).
        episode_start: Whether an episode begins there.
    """

    def __init__(self, env: gym.Env[Any, Any], robot: _Robot, episode_length: int) -> None:
        self._env, self._robot, self._episode_length = env, robot, episode_length
        self._watch, self._age, self.episode_start = Watch(env), 0, True
        self._rows: list[tuple[Array, Array, float, Array]] = []
        self._ended: list[bool] = []
        with in_situation(robot.situation):
            self.obs, _ = gate.reset(env, seed=int(robot.sequence.generate_state(1)[0]))

    def step(self, action: Array) -> None:
        """Takes an action, (action_dim,), and begins another episode where that ends one."""
        with in_situation(self._robot.situation):
            resets = self._watch.resets
            step = gate.step(self._env, action)
            gate.check_not_reset(self._env, self._watch.resets - resets)
            self._rows.append((self.obs, action, step.reward, step.obs))
            self._ended.append(step.terminated)
            self._age += 1
            self.obs, too_long = step.obs, self._age == self._episode_length
            self.episode_start = step.terminated or step.truncated or too_long
            if self.episode_start:
                (self.obs, _), self._age = gate.reset(self._env), 0

    def transitions(self) -> Transitions:
        """Returns all so far, (1, n, ...)."""
        obs, action, reward, next_obs = (np.array(column)[None] for column in zip(*self._rows, strict=True))
        terminated = np.array([self._ended]) if any(self._ended) else None
        return Transitions(obs, action, reward, next_obs, (self._robot.situation,), terminated)


def _in_process(task: _Task, parent: int) -> dict[int, Transitions]:
    if os.getpid() != parent:  # joblib may run it in a thread, or right here
        torch.set_num_threads(1)  # the parallel processes share the cores
    return task.run()
