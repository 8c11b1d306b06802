"""Faults on the way between a robot and its agent: commands that arrive changed, readings that are wrong."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from famle_envs.situation import Situation

__all__ = ["MOTOR_FAULTS", "SENSOR_FAULTS", "MotorFaults", "SensorFaults"]

Array = npt.NDArray[Any]

MOTOR_FAULTS = frozenset({"motor_gain", "motor_delay", "motor_stuck"})
SENSOR_FAULTS = frozenset({"sensor_gain", "sensor_offset", "sensor_noise", "sensor_delay", "sensor_dropout"})


class _Past:
    """The last values of some signals, each of which can be asked for with a delay of its own."""

    def __init__(self, delays: Sequence[int], value: Array) -> None:
        self._delays = np.array(delays, dtype=int)
        self._index = np.arange(len(delays))
        self._values = deque([value], maxlen=int(self._delays.max(initial=0)) + 1)

    def push(self, value: Array) -> Array:
        """Takes the newest values; returns those of each signal's delay ago, or the oldest there are."""
        self._values.append(value)
        rows = len(self._values) - 1 - self._delays
        late: Array = np.stack(self._values)[np.maximum(rows, 0), self._index]
        return late


class MotorFaults:
    """Changes commands as broken motors do: late, scaled, stuck.

    Args:
        space: The action space, whose bounds every command keeps.
    """

    def __init__(self, space: spaces.Box) -> None:
        self._space = space
        self._low, self._high = space.low.astype(np.float64), space.high.astype(np.float64)

    def set(self, situation: Situation) -> None:
        """Takes the faults of a situation that has an entry for every motor."""
        self._active = bool(situation.faults & MOTOR_FAULTS)
        self._gain = np.array(situation.motor_gain)
        self._delay = situation.motor_delay
        self._stuck = np.array([math.nan if at is None else at for at in situation.motor_stuck])
        self.begin()

    def begin(self) -> None:
        """Begins an episode: until a late command arrives, a motor has been told nothing."""
        self._past = _Past(self._delay, np.clip(np.zeros(self._space.shape), self._low, self._high))

    def __call__(self, action: Array) -> Array:
        """What the motors do when they are told an action, (n_motors,).

        Raises:
            ValueError: The action has another shape.
        """
        if not self._active:
            return action
        command = np.asarray(action, dtype=np.float64)
        if command.shape != self._space.shape:
            raise ValueError(f"The action must have the shape {self._space.shape}, got {command.shape}.")
        command = self._gain * self._past.push(np.clip(command, self._low, self._high))
        command = np.where(np.isnan(self._stuck), command, self._stuck)
        return np.clip(command, self._low, self._high).astype(self._space.dtype)


class SensorFaults:
    """Changes readings as broken sensors do: late, scaled, off, noisy, lost.

    A reading saturates at the bounds of the observation space; that of an angle comes round.

    Args:
        space: The observation space.
        angle_dims: The dimensions that are angles in [-pi, pi].
    """

    def __init__(self, space: spaces.Box, angle_dims: Sequence[int] = ()) -> None:
        self._space = space
        self._low, self._high = space.low.astype(np.float64), space.high.astype(np.float64)
        self._is_angle = np.isin(np.arange(space.shape[0]), list(angle_dims))
        self._true = self._last = np.zeros(space.shape)
        self._rng = np.random.default_rng()

    def set(self, situation: Situation) -> None:
        """Takes the faults of a situation that has an entry for every sensor."""
        self._active = bool(situation.faults & SENSOR_FAULTS)
        self._gain, self._offset = np.array(situation.sensor_gain), np.array(situation.sensor_offset)
        self._noise, self._dropout = np.array(situation.sensor_noise), np.array(situation.sensor_dropout)
        self._scaled = (self._gain != 1.0) | (self._offset != 0.0) | (self._noise != 0.0)
        self._faulty = self._scaled | (self._dropout != 0.0) | (np.array(situation.sensor_delay) != 0)
        self._delay = situation.sensor_delay
        self._past = _Past(self._delay, self._true)

    def begin(self, obs: Array, seed: int | None) -> Array:
        """Begins an episode, whose first reading is never late nor lost; returns that reading.

        Args:
            obs: What there is to be sensed, (n_sensors,).
            seed: Of the noise and the losses; None draws on.
        """
        if seed is not None:
            self._rng = np.random.default_rng([seed, 1])  # other numbers than those of the environment's generator
        self._true = self._last = np.array(obs, dtype=np.float64)  # a copy: the same array may be filled again
        self._past = _Past(self._delay, self._true)
        return self._sense(self._true, np.zeros(self._space.shape, dtype=bool)) if self._active else obs

    def __call__(self, obs: Array) -> Array:
        """What the sensors read when there is this to be sensed, (n_sensors,)."""
        self._true = np.array(obs, dtype=np.float64)
        if not self._active:
            self._last = self._true
            return obs
        late, lost = self._past.push(self._true), self._rng.random(self._space.shape) < self._dropout
        return self._sense(late, lost)

    def _sense(self, true: Array, lost: Array) -> Array:
        reading = self._gain * true + self._offset + self._noise * self._rng.standard_normal(self._space.shape)
        turned = np.remainder(reading + math.pi, 2 * math.pi) - math.pi
        reading = np.where(self._is_angle & self._scaled, turned, reading)
        reading = np.where(lost, self._last, np.clip(reading, self._low, self._high))
        self._last = np.where(self._faulty, reading, self._true)
        return self._last.astype(self._space.dtype)
