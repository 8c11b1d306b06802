"""Saving without pickle: JSON and safetensors in one zip, so that loading a file runs no code of it."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from operator import index
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any, BinaryIO

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from torch import Tensor

from famle_agent.agents.config import Config
from famle_agent.agents.presets import known_robots
from famle_agent.models.observation import DIMS
from famle_agent.utils.archive import pack, part_of, unpack
from famle_agent.utils.atomic_write import whole_file

__all__ = ["Checkpoint", "File", "check_writable", "joined", "read_checkpoint", "write_checkpoint"]

_FORMAT = "famle-agent"
_VERSION = 2
_OPTIONAL: Mapping[str, Any] = {
    **dict.fromkeys(("env", "seed", "live", "tensorboard_log")),
    **dict.fromkeys(("num_timesteps", "episodes", "verbose"), 0),
}
"""What a file can go without, and what stands in its place."""
_META = "agent.json"
_TYPES: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("class", "mode"), (str,)),
    **dict.fromkeys(("hyperparameters", "observation_space", "action_space"), (dict,)),
    **dict.fromkeys(("needs_reward_fn", "needs_termination_fn"), (bool,)),
    **dict.fromkeys(("num_timesteps", "episodes", "verbose"), (int,)),
    **dict.fromkeys(("env", "live"), (dict, type(None))),
    **{"situations": (list,), "seed": (int, type(None)), "tensorboard_log": (str, type(None))},
}
"""What the parts of a description are, where it has them."""

File = str | os.PathLike[str] | BinaryIO


def write_checkpoint(file: File, meta: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Writes an agent; an older file at the same path stays whole until the new one is complete.

    Args:
        file: A path (``.zip`` is appended where it has no suffix; folders are made) or a binary file.
        meta: What JSON can say.
        tensors: What it cannot.
    """
    content = pack({"format": _FORMAT, "version": _VERSION, **meta}, tensors, _META)
    if not isinstance(file, (str, os.PathLike)):
        file.write(content)
        return
    path = _with_suffix(file)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        partial.write_bytes(content)


def check_writable(file: str | os.PathLike[str]) -> None:
    """Refuses a path at which :func:`write_checkpoint` could not write; makes its folder.

    Raises:
        OSError: It is a folder, or nothing can be written beside it.
    """
    path = _with_suffix(file)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; give the path of a file in it.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with NamedTemporaryFile(dir=path.parent, prefix=f"{path.name}.", suffix=".partial"):
        pass


def read_checkpoint(file: File) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Reads what :func:`write_checkpoint` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is truncated, foreign, or of a newer version.
    """
    source: io.BytesIO | BinaryIO
    if isinstance(file, (str, os.PathLike)):
        path = Path(file) if Path(file).is_file() else _with_suffix(file)
        source = io.BytesIO(path.read_bytes())
    else:
        path, source = Path("the file"), file
    try:
        meta, tensors = unpack(source, _META)
    except ValueError as error:
        raise ValueError(
            f"{path} is no FAMLE checkpoint, or it is damaged ({error}). "
            "Give a file written by agent.save(); Stable-Baselines3's own zip files are another format."
        ) from error
    if not isinstance(meta, dict) or meta.get("format") != _FORMAT:
        raise ValueError(f"{path} is no FAMLE checkpoint. Give a file written by agent.save().")
    if (version := meta.get("version")) != _VERSION:
        newer = isinstance(version, int) and version > _VERSION
        remedy = "upgrade famle" if newer else "use the release of famle that wrote it, or meta-learn again"
        raise ValueError(f"{path} has checkpoint version {version}, this package reads {_VERSION}; {remedy}.")
    return meta, tensors


@dataclass(frozen=True)
class Checkpoint:
    """All that a stored agent is.

    Attributes:
        kind: The name of its class.
        mode: Its mode.
        config: All its settings.
        observation_space: Of its robot.
        action_space: Of its robot.
        dims: The special dimensions of an observation by name.
        situations: The names of the training situations.
        env: Id and arguments of its environment; None where that cannot be named.
        needs_reward_fn: Whether it was made with a ``reward_fn``, which no file can hold.
        needs_termination_fn: The same of a ``termination_fn``.
        seed: Its seed.
        num_timesteps: Steps that it has lived on robots.
        episodes: Episodes that it has lived on robots.
        live: The counts of its online state; None where it has none.
        tensors: Its weights, its online state and its random numbers, as "part/name".
        verbose: How much it prints.
        tensorboard_log: Its folder for TensorBoard.
    """

    kind: str
    mode: str
    config: Config
    observation_space: spaces.Box
    action_space: spaces.Box
    dims: dict[str, tuple[int, ...]]
    situations: tuple[str, ...]
    env: dict[str, Any] | None
    needs_reward_fn: bool
    needs_termination_fn: bool
    seed: int | None
    num_timesteps: int
    episodes: int
    live: dict[str, int] | None
    tensors: dict[str, Tensor]
    verbose: int = 0
    tensorboard_log: str | None = None

    def write(self, file: File) -> None:
        """Writes the file, see :func:`write_checkpoint`."""
        meta = {
            "class": self.kind,
            "mode": self.mode,
            "hyperparameters": self.config.to_dict(),
            "observation_space": box_to_json(self.observation_space),
            "action_space": box_to_json(self.action_space),
            **{name: list(dims) for name, dims in self.dims.items()},
            "situations": list(self.situations),
            "env": self.env,
            "needs_reward_fn": self.needs_reward_fn,
            "needs_termination_fn": self.needs_termination_fn,
            "seed": self.seed,
            "num_timesteps": self.num_timesteps,
            "episodes": self.episodes,
            "verbose": self.verbose,
            "tensorboard_log": self.tensorboard_log,
            "live": self.live,
        }
        write_checkpoint(file, meta, self.tensors)

    @classmethod
    def read(cls, file: File) -> Checkpoint:
        """Reads a file.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, foreign or of another version.
        """
        meta, tensors = read_checkpoint(file)
        try:
            _check_types(meta)
            if not any(meta["mode"] in robot.modes for robot in known_robots().values()):
                raise ValueError(f"no robot has a mode {meta['mode']!r}")
            return cls(
                kind=meta["class"],
                mode=meta["mode"],
                config=Config.of(meta["hyperparameters"]),
                observation_space=box_from_json(meta["observation_space"]),
                action_space=box_from_json(meta["action_space"]),
                dims={name: tuple(map(index, meta.get(name, ()))) for name in DIMS},
                situations=tuple(str(name) for name in meta["situations"]),
                env=meta["env"],
                needs_reward_fn=meta["needs_reward_fn"],
                needs_termination_fn=meta.get("needs_termination_fn", False),  # which version 0.1 did not know
                seed=meta["seed"],
                num_timesteps=meta.get("num_timesteps", 0),
                episodes=meta.get("episodes", 0),
                live=meta["live"],
                tensors=tensors,
                verbose=meta.get("verbose", 0),
                tensorboard_log=meta.get("tensorboard_log"),
            )
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise ValueError(
                f"The file is no FAMLE checkpoint that this package knows: its description of the agent is damaged or "
                f"of another version ({error!r}). Save the agent again."
            ) from error

    def part(self, name: str) -> dict[str, Tensor]:
        """The tensors of one part of the agent, by name; empty where it has none."""
        return part_of(self.tensors, f"{name}/")

    def weights(self) -> dict[str, dict[str, Tensor]]:
        """The weights of each network by its name."""
        names = {key.split("/")[0] for key in self.tensors} - {"live", "generator"}
        return {name: self.part(name) for name in sorted(names)}

    def without(self, exclude: Iterable[str], include: Iterable[str] = ()) -> Checkpoint:
        """Returns the same without some of it; names that no file holds change nothing.

        Args:
            exclude: Names of attributes, and ``"generator"``.
            include: What stays although it is in ``exclude``.

        Raises:
            ValueError: No agent can be made without what is excluded, or no file holds what is included.
        """
        exclude, include = set(exclude), set(include)
        needed = {field.name for field in fields(self)} - _OPTIONAL.keys() | {"tensors", "dynamics"}
        if unknown := sorted(include - needed - _OPTIONAL.keys() - {"generator"}):
            raise ValueError(f"A file holds JSON and tensors alone, and can hold no {', '.join(unknown)}.")
        exclude -= include
        if lost := sorted(exclude & needed):
            raise ValueError(f"No agent could be loaded without its {', '.join(lost)}; do not exclude that.")
        kept = {key: value for key, value in self.tensors.items() if key.split("/")[0] not in exclude}
        return replace(self, tensors=kept, **{name: _OPTIONAL[name] for name in exclude & _OPTIONAL.keys()})

    def replaced_by(self, objects: Mapping[str, Any]) -> dict[str, Any]:
        """Those of some objects that stand for something that the file holds or names."""
        known = self.config.to_dict().keys() | {"seed", "verbose", "tensorboard_log", "reward_fn", "termination_fn"}
        return {name: value for name, value in objects.items() if name in known}

    def model_alone(self) -> Checkpoint:
        """Returns the same with the weights only: no online state, and no random numbers."""
        weights = {name: value for name, value in self.tensors.items() if not name.startswith(("live/", "generator/"))}
        return replace(self, live=None, tensors=weights)

    def check_agent(self, kind: str, has_reward_fn: bool, has_termination_fn: bool) -> None:
        """Refuses an agent that cannot be what the file describes.

        Raises:
            ValueError: It is of another kind, or lacks a ``reward_fn`` or ``termination_fn`` that the stored one had.
        """
        if self.kind != kind:
            raise ValueError(
                f"The file is no FAMLE checkpoint of {kind} but of {self.kind}; load it with {self.kind}.load()."
            )
        for name, had, has in (
            ("reward_fn", self.needs_reward_fn, has_reward_fn),
            ("termination_fn", self.needs_termination_fn, has_termination_fn),
        ):
            if had and not has:
                raise ValueError(
                    f"The agent was made with a {name}, which no file can hold: give load(..., {name}=...)."
                )

    def check_spaces(self, env: Any) -> None:
        """Refuses an environment with other spaces than the agent's.

        Raises:
            ValueError: The spaces differ.
        """
        if env.observation_space != self.observation_space or env.action_space != self.action_space:
            raise ValueError(
                f"The environment's spaces, {env.observation_space} and {env.action_space}, are not the agent's, "
                f"{self.observation_space} and {self.action_space}."
            )

    def make_env(self) -> gym.Env[Any, Any] | None:
        """Makes the environment that the file names, if it is one of ours: another one's arguments might run anything.

        Raises:
            ValueError: It cannot be made.
        """
        try:
            if self.env is None or self.env["id"] not in gym.registry:
                return None
            name, limit, kwargs = self.env["id"], self.env.get("max_episode_steps"), self.env["kwargs"]
            entry_point = gym.registry[name].entry_point
            if not isinstance(entry_point, str) or not entry_point.startswith("famle_envs."):
                return None
            return gym.make(name, max_episode_steps=limit, **kwargs)
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, gym.error.Error) as error:
            raise ValueError(f"The file's environment cannot be made ({error!r}); give load(..., env=...).") from error


def _check_types(meta: Mapping[str, Any]) -> None:
    """Refuses a description of which a part is of another type."""
    for name, kinds in _TYPES.items():
        if name in meta and not isinstance(meta[name], kinds):
            raise ValueError(f"{name} is a {type(meta[name]).__name__}")


def joined(**parts: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of all parts of an agent as "part/name", the inverse of :meth:`Checkpoint.part`."""
    return {f"{part}/{name}": value for part, values in parts.items() for name, value in values.items()}


def box_to_json(space: spaces.Box) -> dict[str, Any]:
    """A Box space as JSON; infinite bounds are written as null."""

    def bound(values: Any) -> list[float | None]:
        return [float(value) if np.isfinite(value) else None for value in values.ravel()]

    return {"low": bound(space.low), "high": bound(space.high), "shape": list(space.shape), "dtype": str(space.dtype)}


def box_from_json(values: dict[str, Any]) -> spaces.Box:
    """The inverse of :func:`box_to_json`.

    Raises:
        ValueError: The numbers of the space are of no kind that a robot has.
    """
    dtype, shape = np.dtype(values["dtype"]), tuple(values["shape"])
    if dtype.kind not in "iuf" or len(shape) != 1:
        raise ValueError(f"a space of {dtype} {shape}")
    low = np.array([-np.inf if value is None else value for value in values["low"]], dtype=dtype).reshape(shape)
    high = np.array([np.inf if value is None else value for value in values["high"]], dtype=dtype).reshape(shape)
    return spaces.Box(low, high, dtype=dtype)


def _with_suffix(file: str | os.PathLike[str]) -> Path:
    path = Path(file)
    return path if path.suffix or not path.name else path.with_name(path.name + ".zip")
