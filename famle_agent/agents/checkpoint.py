"""Saving without pickle: JSON and safetensors in one zip, so that loading a file runs no code of it."""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from famle_agent.adaptation.controller import OnlineState
from famle_agent.agents.config import Hyperparameters
from famle_agent.agents.presets import known_robots, make_env
from famle_agent.data.envs import env_attribute
from famle_agent.models.observation import DIMS
from famle_agent.utils.atomic_write import whole_file

if TYPE_CHECKING:
    from famle_agent.agents.agent import ModelBasedAgent

__all__ = [
    "File",
    "load_agent",
    "load_pretrained",
    "read_checkpoint",
    "restore_agent",
    "save_agent",
    "write_checkpoint",
]

_FORMAT = "famle-agent"
_VERSION = 2
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, EOFError, KeyError, SafetensorError),
    *(ValueError, RuntimeError, NotImplementedError),  # what zipfile and json make of flipped bits
)
_META, _TENSORS = "agent.json", "tensors.safetensors"

Agent = TypeVar("Agent", bound="ModelBasedAgent")
File = str | os.PathLike[str] | BinaryIO


def write_checkpoint(file: File, meta: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Writes an agent; an older file at the same path stays whole until the new one is complete.

    Args:
        file: A path (``.zip`` is appended where it has no suffix; folders are made) or a binary file.
        meta: What JSON can say.
        tensors: What it cannot.
    """
    if not isinstance(file, (str, os.PathLike)):
        file.write(_pack(meta, tensors))
        return
    path = _with_suffix(file)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        partial.write_bytes(_pack(meta, tensors))


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
        with zipfile.ZipFile(source) as archive:
            meta = json.loads(archive.read(_META))
            tensors = load_tensors(archive.read(_TENSORS))
    except _DAMAGE as error:
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


def save_agent(agent: ModelBasedAgent, file: File) -> None:
    """Writes all that an agent is: see :meth:`ModelBasedAgent.save`."""
    if not hasattr(agent, "observation_space"):
        raise ValueError("This agent has no environment, so that there is nothing to save; make it with one.")
    live = agent._live
    meta = {
        "class": type(agent).__name__,
        "mode": agent.mode,
        "hyperparameters": agent.hyperparameters.to_dict(),
        "observation_space": _box_to_json(agent.observation_space),
        "action_space": _box_to_json(agent.action_space),
        **{name: list(dims) for name, dims in agent._dims.items()},
        "situations": list(agent.situations),
        "env": agent._env_spec,
        "needs_reward_fn": agent._reward_fn is not None,
        "seed": agent.seed,
        "num_timesteps": agent.num_timesteps,
        "episodes": agent._episode_num,
        "live": None if live is None else live.counts,
    }
    parts: dict[str, dict[str, Tensor]] = {
        "dynamics": {} if agent.dynamics is None else agent.dynamics.state_dict(),
        "reward": {} if agent._learned_reward is None else agent._learned_reward.state_dict(),
        "live": {} if live is None else live.to_tensors(),
        # The state of another device's generator means nothing elsewhere.
        "generator": {"state": agent._generator.get_state()} if agent.device.type == "cpu" else {},
    }
    tensors = {f"{part}/{name}": value for part, values in parts.items() for name, value in values.items()}
    write_checkpoint(file, meta, tensors)


def load_agent(
    cls: type[Agent], file: File, env: Any, *, reward_fn: Any, device: torch.device | str, **overrides: Any
) -> Agent:
    """Makes an agent from a file: see :meth:`ModelBasedAgent.load`."""
    if "mode" in overrides:
        raise ValueError("A stored agent has all its settings, and no other mode; give load() the settings to change.")
    meta, tensors = read_checkpoint(file)
    if (kind := meta.get("class")) != cls.__name__:
        raise ValueError(
            f"The file is no FAMLE checkpoint of {cls.__name__} but of {kind}; load it with {kind}.load()."
        )
    try:
        observation_space, action_space = (_box_from_json(meta[f"{name}_space"]) for name in ("observation", "action"))
        situations = tuple(str(name) for name in list(meta["situations"]))
        settings = Hyperparameters.from_dict(meta["hyperparameters"]).to_dict()
        mode, seed, live = meta["mode"], meta["seed"], meta["live"]
        num_timesteps, episodes = int(meta.get("num_timesteps", 0)), int(meta.get("episodes", 0))
        if not any(mode in robot.modes for robot in known_robots().values()):
            raise ValueError(f"no robot has a mode {mode!r}")
        dims = {name: tuple(meta.get(name, ())) for name in DIMS}
        needs_reward_fn, named_env = meta["needs_reward_fn"], meta["env"]
        env = _named_env(named_env) if env is None else env
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"The file's description of the agent is damaged or of another version ({error!r}). Save the agent again; "
            "if it is the environment that cannot be made, give load(..., env=...)."
        ) from error
    if needs_reward_fn and reward_fn is None:
        raise ValueError("The agent was made with a reward_fn, which no file can hold: give load(..., reward_fn=...).")
    if env is not None:
        env = make_env(env)
        _check_env(env, observation_space, action_space)
    # All settings are in the file, so that its mode need not be known for this environment.
    agent = cls(env, reward_fn=reward_fn, device=device, pretrained=False, **{**settings, **dims, **overrides})
    agent.mode, agent.situations = mode, situations
    agent.num_timesteps, agent._episode_num = num_timesteps, episodes
    if env is None:
        agent.observation_space, agent.action_space, agent.n_envs = observation_space, action_space, 1
    agent.set_random_seed(seed)
    try:
        _restore_tensors(agent, tensors, live)
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(
            f"The file's weights do not fit its settings; it is damaged, or an override changed the network: {error}"
        ) from error
    agent.set_random_seed(overrides.get("seed"))
    return agent


def restore_agent(agent: ModelBasedAgent, file: File) -> None:
    """Gives an agent the weights, the belief and the random numbers of a stored agent with the same settings.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is damaged, or its weights are of other settings.
    """
    meta, tensors = read_checkpoint(file)
    try:
        agent.situations = tuple(str(name) for name in meta["situations"])
        _restore_tensors(agent, tensors, meta["live"])
    except (KeyError, RuntimeError, TypeError) as error:
        raise ValueError(f"{file} does not fit the agent's settings, or it is damaged: {error}") from error


def load_pretrained(agent: ModelBasedAgent, file: File) -> list[str]:
    """Gives an agent the model of a stored one, if that is of the same kind, environment and settings of learning.

    Returns:
        In what the two differ; nothing where the model was taken.
    """
    meta, tensors = read_checkpoint(file)
    differing = [] if meta["class"] == type(agent).__name__ else ["kind of agent"]
    if _world(meta["env"], agent) != _world(agent._env_spec, agent):
        differing.append("environment")
    differing += [name for name, dims in agent._dims.items() if tuple(meta.get(name, ())) != dims]
    differing += Hyperparameters.from_dict(meta["hyperparameters"]).learnt_otherwise(agent.hyperparameters)
    if not differing:
        agent.situations = tuple(meta["situations"])
        weights = {name: value for name, value in tensors.items() if name.startswith(("dynamics/", "reward/"))}
        _restore_tensors(agent, weights, None)
    return differing


def _world(env: dict[str, Any] | None, agent: ModelBasedAgent) -> dict[str, Any] | None:
    """What of an environment's description matters to a model of all its situations."""
    if env is None or agent.env is None:
        return None
    other = env_attribute(agent.env, "task_arguments", ())
    kwargs = {key: value for key, value in env["kwargs"].items() if key not in other}
    return {"id": env["id"], "kwargs": kwargs}


def _named_env(named: dict[str, Any] | None) -> gym.Env[Any, Any] | None:
    """The environment that a file names, if it is one of ours: another one's arguments might run anything."""
    if named is None or named["id"] not in gym.registry:
        return None
    entry_point = gym.registry[named["id"]].entry_point
    if not isinstance(entry_point, str) or not entry_point.startswith("famle_envs."):
        return None
    return gym.make(named["id"], max_episode_steps=named.get("max_episode_steps"), **named["kwargs"])


def _check_env(env: Any, observation_space: spaces.Box, action_space: spaces.Box) -> None:
    if env.observation_space != observation_space or env.action_space != action_space:
        raise ValueError(
            f"The environment's spaces, {env.observation_space} and {env.action_space}, are not the agent's, "
            f"{observation_space} and {action_space}."
        )


def _restore_tensors(agent: ModelBasedAgent, tensors: dict[str, Tensor], live: dict[str, int] | None) -> None:
    def part(name: str) -> dict[str, Tensor]:
        prefix = f"{name}/"
        return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}

    if weights := part("dynamics"):
        robots = max(1, len(weights["embeddings"]) // agent.hyperparameters.members)
        agent.dynamics = agent._new_dynamics(robots)
        agent.dynamics.load_state_dict(weights)
    if weights := part("reward"):
        agent._learned_reward = agent._new_reward()
        agent._learned_reward.load_state_dict(weights)
    if live is not None:
        state = {name: value.to(agent.device) for name, value in part("live").items()}
        settings = agent.hyperparameters
        stored = OnlineState.from_tensors(state, **live)
        stored = stored.resized(settings.memory_size, settings.selection_window, settings.horizon)
        # With other candidates than the stored agent's, what it has seen cannot be judged by what it knew of them.
        begins = agent.adapter.initial(stored.robots)
        comparable = stored.belief.log_posterior.shape == begins.log_posterior.shape
        agent._live = stored if comparable else None
    if agent.device.type == "cpu" and "generator/state" in tensors:
        agent._generator.set_state(tensors["generator/state"])


def _box_to_json(space: spaces.Box) -> dict[str, Any]:
    """A Box space as JSON; infinite bounds are written as null."""

    def bound(values: Any) -> list[float | None]:
        return [float(value) if np.isfinite(value) else None for value in values.ravel()]

    return {"low": bound(space.low), "high": bound(space.high), "shape": list(space.shape), "dtype": str(space.dtype)}


def _box_from_json(values: dict[str, Any]) -> spaces.Box:
    """The inverse of :func:`_box_to_json`."""
    dtype, shape = np.dtype(values["dtype"]), tuple(values["shape"])
    low = np.array([-np.inf if value is None else value for value in values["low"]], dtype=dtype).reshape(shape)
    high = np.array([np.inf if value is None else value for value in values["high"]], dtype=dtype).reshape(shape)
    return spaces.Box(low, high, dtype=dtype)


def _pack(meta: dict[str, Any], tensors: dict[str, Tensor]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(_META, json.dumps({"format": _FORMAT, "version": _VERSION, **meta}, indent=1))
        contiguous = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
        archive.writestr(_TENSORS, save_tensors(contiguous))
    return buffer.getvalue()


def _with_suffix(file: str | os.PathLike[str]) -> Path:
    path = Path(file)
    return path if path.suffix or not path.name else path.with_name(path.name + ".zip")
