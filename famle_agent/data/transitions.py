"""The transitions D of N situations, and storing them."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from famle_agent.data.gate import floats
from famle_agent.utils.archive import DAMAGE, check_sizes
from famle_agent.utils.atomic_write import whole_file

__all__ = ["EnvSource", "Transitions", "check_names"]

Array = npt.NDArray[np.float32]
EnvSource = gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]]
"""An environment, used where it is and left open; or what makes one, in whatever process, to be closed after use."""


def check_names(names: Sequence[Any]) -> None:
    """Refuses names of situations that could not be told apart where they are written.

    Raises:
        ValueError: A name is no line of text, or two situations have it, be it because it is composed of others' names.
    """
    for name in names:
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ValueError(f"The name of a situation must be a line of text, got {name!r}.")
        if list(names).count(name) > 1:
            raise ValueError(f"Two situations are called {name!r}; give each a name of its own.")
        parts = name.split(" + ")
        if len(parts) == 2 and all(part in names for part in parts):
            raise ValueError(
                f"A situation is called {name!r}, as an agent calls the two together that are named so; give it "
                "another name."
            )


@dataclass(frozen=True)
class Transitions:
    """n transitions (s, a, r, s') of each of N situations, in the environments' units.

    Attributes:
        obs: (N, n, obs_dim).
        action: (N, n, action_dim).
        reward: (N, n).
        next_obs: (N, n, obs_dim).
        situations: What each situation is called, N of them.
        terminated: Whether an episode ended by itself, (N, n); None where nobody knows, or none did.

    Raises:
        ValueError: Shapes do not fit, or a value is not finite.
    """

    obs: Array
    action: Array
    reward: Array
    next_obs: Array
    situations: tuple[str, ...]
    terminated: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        for name in ("obs", "action", "reward", "next_obs"):
            object.__setattr__(self, name, floats(name, getattr(self, name)))  # which nobody else can change
        shape = (len(self.situations), self.obs.shape[1] if self.obs.ndim == 3 else -1)
        if 0 in shape:
            raise ValueError("There are no transitions; collect at least one in at least one situation.")
        for name in ("obs", "action", "reward", "next_obs"):
            value = getattr(self, name)
            if value.shape[:2] != shape or value.ndim != (2 if name == "reward" else 3):
                raise ValueError(f"{name} has shape {value.shape}; expected {shape} and the dimensions behind it.")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} holds values that are not finite; collect the transitions again.")
        if self.terminated is not None:
            flags = np.array(self.terminated)
            if flags.shape != shape:
                raise ValueError(f"terminated has shape {flags.shape}; expected {shape}.")
            if flags.dtype != np.bool_ and not np.isin(flags, (0, 1)).all():
                raise ValueError(f"terminated must hold True or False, got {flags.dtype}.")
            object.__setattr__(self, "terminated", flags.astype(np.bool_))
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
        ended = None
        if self.terminated is not None or others.terminated is not None:
            ended = np.concatenate([self.ended, others.ended], axis=1)
        return Transitions(**arrays, situations=self.situations, terminated=ended)

    @property
    def ended(self) -> npt.NDArray[np.bool_]:
        """Whether an episode ended by itself, (N, n); nowhere, where nobody knows."""
        return np.zeros(self.reward.shape, dtype=bool) if self.terminated is None else self.terminated

    def digest(self) -> str:
        """A short text that other transitions do not share."""
        digest = hashlib.sha256(repr(self.situations).encode())
        for values in (self.obs, self.action, self.reward, self.next_obs):
            digest.update(np.ascontiguousarray(values).tobytes())
        if self.terminated is not None:
            digest.update(self.terminated.tobytes())
        return digest.hexdigest()[:16]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a compressed NumPy archive; an older file stays whole until the new one is complete."""
        arrays = {name: getattr(self, name) for name in ("obs", "action", "reward", "next_obs")}
        if self.terminated is not None:
            arrays["terminated"] = self.terminated
        with whole_file(Path(path)) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays, situations=np.array(self.situations))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Transitions:
        """Reads what :meth:`save` wrote.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is truncated or holds something else.
        """
        content = Path(path).read_bytes()
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                check_sizes(archive.zip, len(content))
                arrays = {name: archive[name] for name in ("obs", "action", "reward", "next_obs")}
                situations = tuple(str(name) for name in archive["situations"])
                ended = archive.get("terminated")
        except DAMAGE as error:
            raise ValueError(f"{path} holds no transitions, or not all of them; collect them again.") from error
        return cls(**arrays, situations=situations, terminated=ended)
