"""Collecting, storing and loading the transitions D of N situations."""

from __future__ import annotations

import hashlib
import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from joblib import delayed

from famle_agent.cluster import as_completed
from famle_agent.policies import MakePolicy
from famle_agent.whole_file import whole_file

__all__ = ["EnvSource", "Transitions", "collect"]

Array = npt.NDArray[np.float32]
EnvSource = gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]]
"""An environment, used where it is and left open; or what makes one, in whatever process, to be closed after use."""


@dataclass(frozen=True)
class Transitions:
    """n transitions (s, a, r, s') of each of N situations, in the environments' units.

    Attributes:
        obs: (N, n, obs_dim).
        action: (N, n, action_dim).
        reward: (N, n).
        next_obs: (N, n, obs_dim).
        situations: What each situation is called, N of them.

    Raises:
        ValueError: Shapes do not fit, or a value is not finite.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    situations: tuple[str, ...]

    def __post_init__(self) -> None:
        shape = (len(self.situations), self.obs.shape[1] if self.obs.ndim == 3 else -1)
        if 0 in shape:
            raise ValueError("There are no transitions; collect at least one in at least one situation.")
        for name in ("obs", "action", "reward", "next_obs"):
            value = getattr(self, name)
            if value.shape[:2] != shape or value.ndim != (2 if name == "reward" else 3):
                raise ValueError(f"{name} has shape {value.shape}; expected {shape} and the dimensions behind it.")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} holds values that are not finite; collect the transitions again.")
        if self.obs.shape != self.next_obs.shape:
            raise ValueError(f"obs {self.obs.shape} and next_obs {self.next_obs.shape} must have the same shape.")

    def followed_by(self, others: Transitions) -> Transitions:
        """More transitions of the same situations, behind these.

        Raises:
            ValueError: The situations differ.
        """
        if self.situations != others.situations:
            raise ValueError(f"Transitions of {others.situations} cannot follow those of {self.situations}.")
        names = ("obs", "action", "reward", "next_obs")
        arrays = {name: np.concatenate([getattr(self, name), getattr(others, name)], axis=1) for name in names}
        return Transitions(**arrays, situations=self.situations)

    def digest(self) -> str:
        """A short text that other transitions do not share."""
        digest = hashlib.sha256(repr(self.situations).encode())
        for values in (self.obs, self.action, self.reward, self.next_obs):
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()[:16]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a compressed NumPy archive; an older file stays whole until the new one is complete."""
        arrays = {name: getattr(self, name) for name in ("obs", "action", "reward", "next_obs")}
        with whole_file(Path(path)) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays, situations=np.array(self.situations))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Transitions:
        """Reads what :meth:`save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is truncated or holds something else.
        """
        try:
            with np.load(path, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in ("obs", "action", "reward", "next_obs")}
                situations = tuple(str(name) for name in archive["situations"])
        except (
            zipfile.BadZipFile,
            zlib.error,
            EOFError,
            KeyError,
            NotImplementedError,
            TypeError,
            ValueError,
        ) as error:
            raise ValueError(f"{path} holds no transitions, or not all of them; collect them again.") from error
        return cls(**arrays, situations=situations)


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
        calls = (delayed(_in_process if n_jobs != 1 and not here else _Task.run)(task) for task in some)
        for i, part in as_completed(calls, n_jobs=1 if here else n_jobs):
            parts[i] = part
            callback(n)
    arrays = {
        name: np.concatenate([getattr(parts[i], name) for i in range(len(envs))])
        for name in ("obs", "action", "reward", "next_obs")
    }
    return Transitions(**arrays, situations=tuple(situations))


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


def _in_process(task: _Task) -> tuple[int, Transitions]:
    torch.set_num_threads(1)  # the parallel processes share the cores
    return task.run()


def _run_policy(env: gym.Env[Any, Any], task: _Task) -> Transitions:
    policy = task.make_policy(env, task.index, np.random.default_rng(task.sequence))
    rows: list[tuple[Any, Any, Any, Any]] = []
    obs = np.array(env.reset(seed=int(task.sequence.generate_state(1)[0]))[0])
    episode_start, age = True, 0
    while len(rows) < task.n:
        action = policy(obs, episode_start)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        next_obs = np.array(next_obs)  # a copy: an environment may fill the same array again
        rows.append((obs, action, reward, next_obs))
        age += 1
        obs, episode_start = next_obs, terminated or truncated or age == task.episode_length
        if episode_start:
            obs, age = np.array(env.reset()[0]), 0
    columns = [np.array(column, dtype=np.float32)[None] for column in zip(*rows, strict=True)]
    obs_, action_, reward_, next_obs_ = columns
    return Transitions(obs_, action_, reward_, next_obs_, (task.situation,))
