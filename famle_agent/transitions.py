"""Collecting, storing and loading the transitions D of N situations."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

__all__ = ["HeldUniformPolicy", "Policy", "Transitions", "collect"]

Array = npt.NDArray[np.float32]


class Policy(Protocol):
    """What chooses the actions while data are collected."""

    def __call__(self, obs: npt.NDArray[Any], episode_start: bool) -> npt.NDArray[Any]:
        """The action for an observation, in the environment's action space."""


class HeldUniformPolicy:
    """Uniformly random actions, each held for some steps.

    ``hold=1`` are the paper's independent actions. Held ones carry a robot further from its start for the
    same number of steps.
    """

    def __init__(self, action_space: gym.spaces.Box, hold: int, rng: np.random.Generator) -> None:
        self._space, self._hold, self._rng = action_space, hold, rng
        self._age = 0
        self._action: npt.NDArray[Any] | None = None

    def __call__(self, obs: npt.NDArray[Any], episode_start: bool) -> npt.NDArray[Any]:
        """The held action, or a new one when its time is over or an episode begins."""
        if episode_start or self._action is None or self._age >= self._hold:
            self._action, self._age = self._rng.uniform(self._space.low, self._space.high), 0
        self._age += 1
        return self._action.astype(self._space.dtype)


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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a compressed NumPy archive; an older file stays whole until the new one is complete."""
        target = Path(path)
        partial = target.with_name(target.name + ".partial")
        arrays = {name: getattr(self, name) for name in ("obs", "action", "reward", "next_obs")}
        try:
            with partial.open("wb") as file:
                np.savez_compressed(file, **arrays, situations=np.array(self.situations))
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

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
    envs: Sequence[gym.Env[Any, Any]],
    situations: Sequence[str],
    n: int,
    make_policy: Callable[[gym.spaces.Box, np.random.Generator], Policy],
    seed: int,
    callback: Callable[[int], object] = lambda _: None,
) -> Transitions:
    """Runs a policy in the environment of each situation (lines 1 to 6 of Algorithm 1).

    Args:
        envs: One environment per situation.
        situations: What each is called.
        n: Transitions per situation.
        make_policy: Makes the policy of a situation from its action space and a generator.
        seed: Seed of the environments and the policies.
        callback: Called with the number of new transitions after each situation.

    Returns:
        The transitions; the step that a reset interrupts is no transition and is not among them.
    """
    parts = []
    for env, sequence in zip(envs, np.random.SeedSequence(seed).spawn(len(envs)), strict=True):
        policy = make_policy(env.action_space, np.random.default_rng(sequence))  # type: ignore[arg-type]
        parts.append(_collect_one(env, n, policy, sequence))
        callback(n)
    obs, action, reward, next_obs = (np.stack(values) for values in zip(*parts, strict=True))
    return Transitions(obs, action, reward, next_obs, tuple(situations))


def _collect_one(
    env: gym.Env[Any, Any], n: int, policy: Policy, sequence: np.random.SeedSequence
) -> tuple[Array, Array, Array, Array]:
    rows: list[tuple[Any, Any, Any, Any]] = []
    obs = np.array(env.reset(seed=int(sequence.generate_state(1)[0]))[0])
    episode_start = True
    while len(rows) < n:
        action = policy(obs, episode_start)
        next_obs, reward, terminated, truncated, _ = env.step(action)
        next_obs = np.array(next_obs)  # a copy: an environment may fill the same array again
        rows.append((obs, action, reward, next_obs))
        obs, episode_start = next_obs, terminated or truncated
        if episode_start:
            obs = np.array(env.reset()[0])
    obs_, action_, reward_, next_obs_ = (np.array(column, dtype=np.float32) for column in zip(*rows, strict=True))
    return obs_, action_, reward_, next_obs_
