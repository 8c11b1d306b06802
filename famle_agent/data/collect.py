"""Collecting transitions of N situations, in one process or many (lines 1 to 6 of Algorithm 1)."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from joblib import delayed

from famle_agent.data import gate
from famle_agent.data.policies import MakePolicy
from famle_agent.data.transitions import EnvSource, Transitions
from famle_agent.data.watch import Watch
from famle_agent.utils.parallel import as_completed

__all__ = ["collect"]


def collect(
    envs: Sequence[EnvSource],
    situations: Sequence[str],
    n: int,
    make_policy: MakePolicy,
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
        make_policy: Makes the policy of a situation.
        seed: Seed of the environments and the policies. What is collected does not depend on ``n_jobs``.
        callback: Called with the number of new transitions after each situation.
        n_jobs: Parallel processes, -1 for one a core; environments that exist already stay in this one.
        folder: Where each situation's transitions are stored as soon as they are there. What it holds of an earlier
            run that was stopped is not collected again.
        episode_length: Steps after which an episode is cut short; 0 leaves its end to the environment.

    Returns:
        The transitions; the step that a reset interrupts is no transition and is not among them.

    Raises:
        ValueError: The folder holds transitions of other situations, or of another number.
    """
    sequences = np.random.SeedSequence(seed).spawn(len(envs))
    tasks = [
        _Task(i, env, situations[i], n, make_policy, sequence, folder, episode_length)
        for i, (env, sequence) in enumerate(zip(envs, sequences, strict=True))
    ]
    parts: dict[int, Transitions] = {}
    for here in (True, False):
        some = [task for task in tasks if isinstance(task.env, gym.Env) == here]
        calls = (delayed(_in_process)(task, os.getpid()) for task in some)
        for i, part in as_completed(calls, n_jobs=1 if here else n_jobs):
            parts[i] = part
            callback(n)
    arrays = {
        name: np.concatenate([getattr(parts[i], name) for i in range(len(envs))])
        for name in ("obs", "action", "reward", "next_obs")
    }
    ended = np.concatenate([parts[i].ended for i in range(len(envs))])
    return Transitions(**arrays, situations=tuple(situations), terminated=ended if ended.any() else None)


@dataclass(frozen=True)
class _Task:
    """The transitions of one situation, to be collected or to be read where that was done before."""

    index: int
    env: EnvSource
    situation: str
    n: int
    make_policy: MakePolicy
    sequence: np.random.SeedSequence
    folder: Path | None
    episode_length: int

    def run(self) -> tuple[int, Transitions]:
        path = None if self.folder is None else self.folder / f"situation-{self.index:03d}.npz"
        if path is not None and path.exists():
            stored = Transitions.load(path)
            if stored.situations != (self.situation,) or stored.obs.shape[:2] != (1, self.n):
                raise ValueError(
                    f"{path} holds {stored.obs.shape[1]} transitions of {stored.situations[0]!r} instead of {self.n} "
                    f"of {self.situation!r}: it is of another run. Give another folder, or delete this one."
                )
            return self.index, stored
        env = self.env if isinstance(self.env, gym.Env) else self.env()
        try:
            part = _run_policy(env, self)
        finally:
            if env is not self.env:
                env.close()
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.save(path)
        return self.index, part


def _in_process(task: _Task, parent: int) -> tuple[int, Transitions]:
    if os.getpid() != parent:  # joblib may run it in a thread, or right here
        torch.set_num_threads(1)  # the parallel processes share the cores
    return task.run()


def _run_policy(env: gym.Env[Any, Any], task: _Task) -> Transitions:
    policy = task.make_policy(env, task.index, np.random.default_rng(task.sequence))
    rows: list[tuple[Any, Any, Any, Any]] = []
    ended: list[bool] = []
    watch = Watch(env)
    obs, _ = gate.reset(env, seed=int(task.sequence.generate_state(1)[0]))
    episode_start, age = True, 0
    while len(rows) < task.n:
        action = policy(obs, episode_start)
        resets = watch.resets
        step = gate.step(env, action)
        gate.check_not_reset(env, watch.resets - resets)
        rows.append((obs, action, step.reward, step.obs))
        ended.append(step.terminated)
        age += 1
        obs, episode_start = step.obs, step.terminated or step.truncated or age == task.episode_length
        if episode_start:
            (obs, _), age = gate.reset(env), 0
    columns = [np.array(column)[None] for column in zip(*rows, strict=True)]
    obs_, action_, reward_, next_obs_ = columns
    terminated_ = np.array([ended]) if any(ended) else None
    return Transitions(obs_, action_, reward_, next_obs_, (task.situation,), terminated_)
