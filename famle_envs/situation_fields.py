"""The fields of a situation: where nothing is wrong with them, and what they may hold."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from typing import Any, NamedTuple

__all__ = ["MULTIPLIERS", "PER_PART", "Entries", "angle", "entries_of", "finite", "indices", "multiplier"]

MAX_DELAY = 1000  # steps, all of which are kept in memory


def angle(name: str, value: Any) -> float:
    """The same angle in (-pi, pi]; errors as of :func:`finite`."""
    number = finite(name, value)
    if not -math.pi < number <= math.pi:
        number = math.remainder(number, 2 * math.pi)
    return math.pi if number <= -math.pi else number


def finite(name: str, value: Any) -> float:
    """A finite number as a float.

    Raises:
        TypeError: It is no number.
        ValueError: It is not finite.
    """
    if not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {reprlib.repr(value)}.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {number}.")
    return number + 0.0  # -0 is 0


def multiplier(name: str, value: Any) -> float:
    """A number above 0; errors as of :func:`finite`."""
    number = finite(name, value)
    if number <= 0.0:
        raise ValueError(f"{name} multiplies the robot's own value and must be above 0, got {number}.")
    return number


def _gain(name: str, value: Any) -> float:
    number = finite(name, value)
    if not -1.0 <= number <= 1.0:
        raise ValueError(
            f"{name} must lie in [-1, 1] for every joint, got {number}. "
            "Use -1 for a reversed motor, 0 for a dead one, 1 for an intact one."
        )
    return number


def _deviation(name: str, value: Any) -> float:
    number = finite(name, value)
    if number < 0.0:
        raise ValueError(f"{name} must be standard deviations of at least 0, got {number}.")
    return number


def _probability(name: str, value: Any) -> float:
    number = finite(name, value)
    if not 0.0 <= number <= 1.0:
        raise ValueError(f"{name} must be probabilities in [0, 1], got {number}.")
    return number


def _steps(name: str, value: Any) -> int:
    number = finite(name, value)
    if number != int(number) or not 0 <= number <= MAX_DELAY:
        raise ValueError(f"{name} must be whole numbers of steps, 0 to {MAX_DELAY}, got {value}.")
    return int(number)


def _command(name: str, value: Any) -> float | None:
    return None if value is None else finite(name, value)


class Entries(NamedTuple):
    """A field with an entry for each part of a robot: what they are of, where nothing is wrong, and their check."""

    part: str
    as_built: Any
    check: Callable[[str, Any], Any]


PER_PART = {
    "motor_gain": Entries("joint", 1.0, _gain),
    "joint_offset": Entries("joint", 0.0, finite),
    "motor_strength": Entries("motor", 1.0, multiplier),
    "motor_delay": Entries("motor", 0, _steps),
    "motor_stuck": Entries("motor", None, _command),
    "sensor_gain": Entries("sensor", 1.0, finite),
    "sensor_offset": Entries("sensor", 0.0, finite),
    "sensor_noise": Entries("sensor", 0.0, _deviation),
    "sensor_delay": Entries("sensor", 0, _steps),
    "sensor_dropout": Entries("sensor", 0.0, _probability),
    "body_mass": Entries("body", 1.0, multiplier),
}
"""The fields that are tuples with an entry for each part, by name."""
MULTIPLIERS = ("friction", "base_mass", "mass", "damping")


def entries_of(name: str, values: Sequence[Any]) -> tuple[Any, ...]:
    """Checks and converts the entries of a field of :data:`PER_PART`.

    Raises:
        TypeError: It is no sequence, or an entry is no number.
        ValueError: An entry is not finite or out of range.
    """
    part, _, check = PER_PART[name]
    return tuple(check(name, value) for value in _sequence(name, values, part))


def indices(name: str, values: Sequence[int]) -> tuple[int, ...]:
    """Sorts indices of joints, each once; errors as of :func:`entries_of`."""
    numbers = [finite(name, value) for value in _sequence(name, values, "joint")]
    if any(number != int(number) or number < 0 for number in numbers):
        raise ValueError(f"{name} must hold joint indices (0, 1, ...), got {list(values)}.")
    return tuple(sorted({int(number) for number in numbers}))


def _sequence(name: str, values: Any, part: str) -> Sequence[Any]:
    if isinstance(values, (str, bytes, Mapping)) or not hasattr(values, "__iter__"):
        raise TypeError(f"{name} must be a sequence with one number per {part}, got {reprlib.repr(values)}.")
    return tuple(values)
