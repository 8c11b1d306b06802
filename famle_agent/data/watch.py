"""Noticing that somebody else has moved or reset a robot, so that what lies between is not taken for a step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import update_wrapper
from traceback import walk_tb
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.data.gate import VecStep, vec_step
from famle_agent.utils.errors import add_note

__all__ = ["VecWatch", "Watch"]


class _Counted:
    """A method that counts its calls."""

    def __init__(self, method: Callable[..., Any]) -> None:
        update_wrapper(self, method)
        self._method, self.calls = method, 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        return self._method(*args, **kwargs)


class Watch:
    """Counts the steps and resets of a robot, whoever asks for them: its user, a wrapper, or the robot itself.

    The innermost environment's own methods are counted, since all others come to them in the end. Gymnasium has no
    other sign of a reset: what :class:`gymnasium.wrappers.Autoreset` does in a step looks like one.

    Args:
        env: The environment, with any wrappers.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._resets, self._steps = (_counted(env.unwrapped, name) for name in ("reset", "step"))

    @property
    def resets(self) -> int:
        """How often the robot was reset."""
        return self._resets.calls

    @property
    def calls(self) -> int:
        """How often it was stepped or reset."""
        return self._resets.calls + self._steps.calls


class VecWatch:
    """The same of the robots of a ``VecEnv``; those in other processes are reached through it alone.

    Args:
        env: The vector environment, with any wrappers.
    """

    def __init__(self, env: VecEnv) -> None:
        base: Any = env.unwrapped
        self._env = env
        self._base = [_counted(base, name) for name in ("reset", "step_wait")]
        inside = getattr(base, "envs", None)
        known = isinstance(inside, list) and len(inside) == env.num_envs
        self._envs: list[gym.Env[Any, Any]] = inside if known and inside is not None else []
        self._robots = [Watch(robot) for robot in self._envs]

    @property
    def calls(self) -> int:
        """How often any of the robots was stepped or reset."""
        return sum(method.calls for method in self._base) + sum(robot.calls for robot in self._robots)

    def step(self, actions: npt.NDArray[Any]) -> tuple[VecStep, npt.NDArray[np.bool_]]:
        """Steps the robots; arguments and errors as of :func:`~famle_agent.data.gate.vec_step`.

        What a robot raises, a wrapper of it included, has a note of its index where the robots are in this process.

        Returns:
            What they returned, and which of them were reset otherwise than by the end of their episode, (n,); none
            where they are in other processes.
        """
        before = self._resets()
        try:
            step = vec_step(self._env, actions)
        except Exception as error:
            if (failed := _robot_in_traceback(self._envs, error)) is not None:
                add_note(
                    error,
                    f"Robot {failed} of {len(self._envs)} raised it. Wrap each robot in famle_agent.TruncateOnError "
                    "for the others to go on where one of them fails.",
                )
            raise
        resets = self._resets() - before
        return step, resets != step.dones if len(resets) else np.zeros_like(step.dones)

    def _resets(self) -> npt.NDArray[np.int64]:
        """How often each robot was reset, (n,); (0,) where they are in other processes."""
        return np.array([robot.resets for robot in self._robots], dtype=np.int64)


def _robot_in_traceback(envs: Sequence[gym.Env[Any, Any]], error: Exception) -> int | None:
    """Finds the environment through a method of which an exception came; None where it came from elsewhere."""
    index = {id(env): i for i, env in enumerate(envs)}
    through = (index.get(id(frame.f_locals.get("self"))) for frame, _ in walk_tb(error.__traceback__))
    return next((i for i in through if i is not None), None)


def _counted(robot: Any, name: str) -> _Counted:
    method = getattr(robot, name)
    if isinstance(method, _Counted):
        return method
    counted = _Counted(method)
    setattr(robot, name, counted)
    return counted
