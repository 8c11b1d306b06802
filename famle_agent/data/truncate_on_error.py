"""A robot among many that fails by an exception, which ends its own episode and no other robot's."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from famle_agent.data import gate

__all__ = ["TruncateOnError"]

Array = npt.NDArray[Any]


class TruncateOnError(gym.Wrapper[Array, Array, Array, Array], RecordConstructorArgs):
    """Truncates the episode of a robot whose ``step`` or ``reset`` raises an exception, or returns something malformed.

    A vector environment passes an exception on, which ends the steps of all its robots. With this wrapper around each,
    the one that fails has an observation of NaN and the reward 0, ``info["error"]`` says why, and the others go on. The
    vector environment then resets it. Where the reset fails as well, the robot is left alone until the next one, and
    observes NaN; a ``TimeLimit`` around this wrapper asks for one. Nobody learns from that, and
    ``agent.health(robot=i)`` counts it.

    Only an :class:`Exception` is caught: Ctrl-C still ends everything.

    Args:
        env: The robot's environment. Wrappers around it see the observation of NaN, those within the exception.

    Attributes:
        errors: How often the robot has failed.

    Raises:
        ValueError: Observations are no Box of floats; only these can be NaN.

    Example:
        >>> from famle_agent import TruncateOnError
        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> robots = make_vec_env("famle_envs:FamleReacher-v0", n_envs=2, wrapper_class=TruncateOnError)
        >>> robots.get_attr("errors")
        [0, 0]
        >>> robots.close()
    """

    def __init__(self, env: gym.Env[Array, Array]) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or space.dtype.kind != "f":
            raise ValueError(f"TruncateOnError needs observations in a Box of floats, got {space}.")
        self.errors = 0
        self._nothing = np.full(space.shape, np.nan, space.dtype)
        self._error = ""  # of a robot that has not been reset since

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Resets the robot; one that cannot be reset observes NaN."""
        try:
            obs, info = gate.robot_reset(self.env, seed=seed, options=options)
        except Exception as error:
            return self._nothing.copy(), self._failed("reset", error)
        self._error = ""
        return self._measured(obs), info

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Steps the robot, unless it has failed since its last reset."""
        if self._error:
            return self._nothing.copy(), 0.0, False, False, {"error": self._error}
        try:
            step = gate.robot_step(self.env, action)
        except Exception as error:
            return self._nothing.copy(), 0.0, False, True, self._failed("step", error)
        return self._measured(step.obs), step.reward, step.terminated, step.truncated, step.info

    def _measured(self, obs: Array | None) -> Array:
        return self._nothing.copy() if obs is None else obs

    def _failed(self, what: str, error: Exception) -> dict[str, Any]:
        self.errors += 1
        self._error = f"{type(error).__name__}: {error}"
        warnings.warn(
            f"{what}() of {self.env} failed ({self._error}). Its episode ends, and it observes NaN until it is reset.",
            stacklevel=3,
        )
        return {"error": self._error}
