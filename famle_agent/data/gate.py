"""The gate through which values of foreign code enter: what an environment or a user returns is checked and copied.

A copy, since an environment may fill the same array again, and since what it does to an action is its own business.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

__all__ = [
    "Step",
    "VecStep",
    "check_action",
    "check_not_reset",
    "check_observation",
    "floats",
    "numbers",
    "reading",
    "reset",
    "robot_reset",
    "robot_step",
    "step",
    "vec_readings",
    "vec_step",
]

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Step:
    """What one step of an environment returned.

    Attributes:
        obs: A copy in the environment's own dtype, (obs_dim,); None where no observation came.
        reward: A number.
        terminated: Whether the episode ended by itself.
        truncated: Whether it was cut short.
        info: A shallow copy.
    """

    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]

    @property
    def final_obs(self) -> Any:
        """Where an environment that has already begun another episode got to; None where it does not say that."""
        return self.info.get("final_obs", self.info.get("terminal_observation"))


@dataclass(frozen=True)
class VecStep:
    """What one step of n robots returned; observations and rewards need not be finite.

    Attributes:
        obs: Where the robots are now, (n, obs_dim), float32; of one whose episode has ended, the next one's start.
        reached: Where the actions led, (n, obs_dim), float32.
        rewards: Of the step, (n,).
        known: Whether ``reached`` is known, (n,): whose episode has ended and who does not say where, has none.
        dones: Whose episode has ended, (n,).
        infos: One mapping a robot.
    """

    obs: Array
    reached: Array
    rewards: Array
    known: npt.NDArray[np.bool_]
    dones: npt.NDArray[np.bool_]
    infos: list[dict[str, Any]]


# --- single values ------------------------------------------------------------------------------------------


def floats(name: str, values: Any) -> Array:
    """Any numbers as a float32 array of its own; what single precision cannot hold becomes infinite.

    Raises:
        ValueError: They are no numbers.
    """
    try:
        with np.errstate(over="ignore"):
            return np.array(_numeric(values), dtype=np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"The {name} must be an array of numbers, got {type(values).__name__}.") from error


def numbers(name: str, values: Any) -> Array:
    """The same, where all of them are finite.

    Raises:
        ValueError: They are no numbers, or not finite in single precision.
    """
    array = floats(name, values)
    _check_finite(name, array)
    return array


def _check_finite(name: str, array: Array) -> None:
    if not np.isfinite(array).all():
        raise ValueError(
            f"The {name} holds NaN or infinite values, or such that are not finite in single precision: {array}. Check "
            "the robot's sensors and commands."
        )


def check_observation(observation: Any, space: spaces.Box) -> Array:
    """An observation (obs_dim,) or (B, obs_dim) as a float32 array of its own.

    Raises:
        ValueError: It has another shape, is not finite, or is the pair that Gymnasium's ``reset`` returns.
    """
    array = reading(observation, space)
    _check_finite("observation", array)
    return array


def reading(observation: Any, space: spaces.Box) -> Array:
    """The same of a robot whose sensors may fail: any floats, and None for an observation that did not come.

    Returns:
        (obs_dim,) or (B, obs_dim), float32; NaN in the place of what did not come.

    Raises:
        ValueError: It has another shape, is of no numbers, or is the pair that Gymnasium's ``reset`` returns.
    """
    if observation is None:
        return np.full(space.shape, np.nan, dtype=np.float32)
    if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], Mapping):
        raise ValueError("Got (obs, info), as Gymnasium's reset() returns it; give obs alone.")
    return _of_space("observation", floats("observation", observation), space)


def check_action(action: Any, space: spaces.Box) -> Array:
    """An action (action_dim,) or (B, action_dim) as a float32 array of its own.

    Raises:
        ValueError: It has another shape or is not finite.
    """
    return _of_space("action", numbers("action", action), space)


def _of_space(name: str, array: Array, space: spaces.Box) -> Array:
    if array.ndim not in (1, 2) or array.shape[-1:] != space.shape:
        raise ValueError(
            f"The {name} must have shape {space.shape}, or (B, {space.shape[0]}) for B robots, got {array.shape}."
        )
    return array


def _numeric(values: Any) -> Array:
    """The values as an array, unless a conversion to float would make numbers of what are none."""
    array = np.asarray(values)
    if array.dtype.kind == "O":
        array = np.array([float(value) for value in array.ravel()]).reshape(array.shape)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"values of dtype {array.dtype}")
    return array


def _one(name: str, value: Any) -> float:
    array = floats(name, value)
    if array.size != 1:
        raise ValueError(f"The {name} must be one number, got an array of shape {array.shape}.")
    return float(np.asarray(value, dtype=np.float64).reshape(()))


def _flag(name: str, value: Any) -> bool:
    if isinstance(value, bool):
        return value
    number = _one(name, value)
    if number not in (0.0, 1.0):  # nor NaN
        raise ValueError(f"{name} must be True or False, got {value!r}.")
    return bool(number)


def _info(value: Any) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"info must be a mapping, got {type(value).__name__}; return {{}} where there is nothing.")
    return dict(value)


# --- one environment ----------------------------------------------------------------------------------------


def reset(env: gym.Env[Any, Any], **arguments: Any) -> tuple[Array, dict[str, Any]]:
    """Resets a simulated environment.

    Args:
        env: The environment.
        **arguments: Those of its ``reset``.

    Returns:
        A copy of the observation in the environment's dtype, (obs_dim,), and of the info.

    Raises:
        ValueError: Something that it returned has a wrong type or shape, or is not finite.
    """
    obs, info = robot_reset(env, **arguments)
    numbers("observation", obs)
    return obs, info


def robot_reset(env: gym.Env[Any, Any], **arguments: Any) -> tuple[Any, dict[str, Any]]:
    """Resets a robot, whose sensors may fail: its observation may hold no finite numbers, or be None.

    Arguments, returns and errors otherwise as of :func:`reset`.
    """
    returned = env.reset(**arguments)
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise ValueError(f"reset() of {env} must return (obs, info), got {_what(returned)}.")
    obs, info = returned
    return None if obs is None else _observed(obs, env), _info(info)


def step(env: gym.Env[Any, Any], action: Any) -> Step:
    """Steps a simulated environment with a copy of an action.

    Args:
        env: The environment.
        action: What to send, (action_dim,).

    Raises:
        ValueError: Something that it returned has a wrong type or shape, or is not finite.
    """
    stepped = robot_step(env, action)
    numbers("observation", stepped.obs)
    numbers("reward", stepped.reward)
    return stepped


def robot_step(env: gym.Env[Any, Any], action: Any) -> Step:
    """Steps a robot, whose sensors may fail: what it observes and its reward may be no finite numbers.

    Args:
        env: The robot's environment.
        action: What to send, (action_dim,).

    Raises:
        ValueError: Something that it returned has a wrong type or shape.
    """
    returned = env.step(np.array(action))
    if not isinstance(returned, tuple) or len(returned) != 5:
        raise ValueError(
            f"step() of {env} must return (obs, reward, terminated, truncated, info), got {_what(returned)}; make the "
            "environment one of Gymnasium's."
        )
    obs, reward, terminated, truncated, info = returned
    return Step(
        None if obs is None else _observed(obs, env),
        _one("reward", reward),
        _flag("terminated", terminated),
        _flag("truncated", truncated),
        _info(info),
    )


def check_not_reset(env: gym.Env[Any, Any], resets: int) -> None:
    """Refuses a simulated step in which an environment was reset.

    Raises:
        ValueError: It was.
    """
    if resets:
        raise ValueError(
            f"{env} resets itself within a step, so that nobody sees where that led: give the environment without what "
            "resets it (gymnasium.wrappers.Autoreset). In simulation, episodes begin with reset() alone."
        )


def _observed(obs: Any, env: gym.Env[Any, Any]) -> Array:
    array, shape = floats("observation", obs), env.observation_space.shape
    if array.shape != shape:
        raise ValueError(f"The observation of {env} must have the shape of its space, {shape}, got {array.shape}.")
    return np.array(obs)


def _what(returned: Any) -> str:
    return f"{len(returned)} values" if isinstance(returned, tuple) else type(returned).__name__


# --- vector environments ------------------------------------------------------------------------------------


def vec_readings(obs: Any, env: VecEnv) -> Array:
    """The observations of n robots as a float32 array of their own, (n, obs_dim), finite or not.

    Raises:
        ValueError: They have another shape.
    """
    array, shape = floats("observation", obs), (env.num_envs, *(env.observation_space.shape or ()))
    if array.shape != shape:
        raise ValueError(f"The observations of a VecEnv must have shape {shape}, got {array.shape}.")
    return array


def vec_step(env: VecEnv, actions: Array) -> VecStep:
    """Steps n robots, whose sensors may fail, with copies of their actions, (n, action_dim).

    Raises:
        ValueError: Something that they returned has a wrong type or shape.
    """
    n = env.num_envs
    obs, rewards, dones, infos = env.step(np.array(actions))
    for name, values, check in (("rewards", rewards, floats), ("dones", dones, numbers)):
        if (array := check(name, values)).shape != (n,):
            raise ValueError(f"The {name} of a VecEnv of {n} robots must have shape ({n},), got {array.shape}.")
    if len(infos) != n:
        raise ValueError(f"A VecEnv of {n} robots must return {n} infos, got {len(infos)}.")
    now, ended = vec_readings(obs, env), np.array(dones, dtype=bool)
    copies = [_info(info) for info in infos]
    reached, known = now.copy(), np.ones(n, dtype=bool)
    for i in np.flatnonzero(ended):
        known[i] = "terminal_observation" in copies[i]
        if known[i]:
            reached[i] = reading(copies[i]["terminal_observation"], env.observation_space)  # type: ignore[arg-type]
    return VecStep(now, reached, np.array(rewards), known, ended, copies)
