"""Situations in words, as a person writes them and a log shows them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

__all__ = ["UnreadableError", "describe", "read"]

_GAIN_OF_WORD = {"dead": 0.0, "reversed": -1.0}
_WORD_OF_GAIN = {gain: word for word, gain in _GAIN_OF_WORD.items()}


class UnreadableError(ValueError):
    """A text is no description of a situation."""


def describe(values: Mapping[str, Any], as_built: Mapping[str, Any]) -> str:
    """Describes what is wrong, in clauses that :func:`read` understands.

    Args:
        values: The fields of a situation by name.
        as_built: What each field is where nothing is wrong; of one with an entry per part, what each entry is.
    """
    clauses: list[str] = []
    for field, write in _WRITERS.items():
        if field == "locked_joints":
            clauses += [write(joint, None) for joint in values[field]]
        elif isinstance(values[field], tuple):
            clauses += [write(i, value) for i, value in enumerate(values[field]) if value != as_built[field]]
        elif values[field] != as_built[field]:
            clauses.append(write(0, values[field]))
    return ", ".join(clauses) or "intact"


def read(text: str) -> dict[str, dict[int, Any]]:
    """Reads what :func:`describe` writes, with commas or plus signs between the clauses.

    Returns:
        For each field that is mentioned, its value by index. A field of the whole robot has the index 0.

    Raises:
        UnreadableError: A clause cannot be read.
        ValueError: Two clauses say something of the same thing, or an index has more than three digits.
    """
    said: dict[str, dict[int, Any]] = {}
    clauses = [clause.strip() for clause in re.split(r",| \+ ", text)]
    if clauses == ["intact"]:
        return said
    for clause in clauses:
        field, index, value = _read_clause(clause)
        entries = said.setdefault(field, {})
        if index in entries and field != "locked_joints":
            raise ValueError(f"{clause!r} contradicts what was said before it; say one thing of each part.")
        entries[index] = value
    return said


def _read_clause(clause: str) -> tuple[str, int, Any]:
    for field, pattern, value_of in _READERS:
        if match := pattern.fullmatch(clause):
            groups = match.groups()
            if field in _OF_THE_ROBOT:
                return field, 0, value_of(*groups)
            if len(groups[0]) > 3:
                raise ValueError(f"No robot has a joint, motor, sensor or body {groups[0]}.")
            return field, int(groups[0]), value_of(*groups[1:])
    raise UnreadableError(
        f"Cannot read {clause!r}. Write faults like 'joint 3 dead, motor 1 delayed by 2 steps, sensor 0 off by 0.1, "
        "yaw sensor off by 30 deg, friction x 0.5'."
    )


def _number(value: float) -> str:
    """The shortest text that reads back as the same float."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _gain(value: float) -> str:
    return _WORD_OF_GAIN.get(value) or f"at gain {_number(value)}"


def _steps(value: int) -> str:
    return f"{value} step" if value == 1 else f"{value} steps"


def _angle(value: float) -> str:
    """Degrees where they are exact, since people think in them; radians otherwise."""
    degrees = f"{math.degrees(value):g}"
    return f"{degrees} deg" if math.radians(float(degrees)) == value else f"{_number(value)} rad"


def _dropout(value: float) -> str:
    return "frozen" if value == 1.0 else f"loses {_number(value)} of its readings"


_WRITERS: dict[str, Callable[[int, Any], str]] = {
    "motor_gain": lambda i, x: f"joint {i} {_gain(x)}",
    "locked_joints": lambda i, _: f"joint {i} locked",
    "motor_strength": lambda i, x: f"motor {i} strength x {_number(x)}",
    "motor_delay": lambda i, x: f"motor {i} delayed by {_steps(x)}",
    "motor_stuck": lambda i, x: f"motor {i} stuck at {_number(x)}",
    "joint_offset": lambda i, x: f"joint {i} sensor off by {_angle(x)}",
    "sensor_gain": lambda i, x: f"sensor {i} {_gain(x)}",
    "sensor_offset": lambda i, x: f"sensor {i} off by {_number(x)}",
    "sensor_noise": lambda i, x: f"sensor {i} noise {_number(x)}",
    "sensor_delay": lambda i, x: f"sensor {i} delayed by {_steps(x)}",
    "sensor_dropout": lambda i, x: f"sensor {i} {_dropout(x)}",
    "orientation_error": lambda _, x: f"yaw sensor off by {_angle(x)}",
    "friction": lambda _, x: f"friction x {_number(x)}",
    "base_mass": lambda _, x: f"base mass x {_number(x)}",
    "body_mass": lambda i, x: f"body {i} mass x {_number(x)}",
    "mass": lambda _, x: f"mass x {_number(x)}",
    "damping": lambda _, x: f"damping x {_number(x)}",
}
"""How a fault is written, by field, in the order of a description."""

_OF_THE_ROBOT = {"orientation_error", "friction", "base_mass", "mass", "damping"}
"""Fields without an index."""


def _pattern(text: str) -> re.Pattern[str]:
    """A clause in which ``#`` is an index and ``@`` a number."""
    number = r"(-?(?:\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?)"  # digits in one way only, or long ones would take for ever
    return re.compile(text.replace("#", r"(\d+)").replace("@", number), re.ASCII)


def _radians(number: str, unit: str) -> float:
    return math.radians(float(number)) if unit == "deg" else float(number)


_READERS: list[tuple[str, re.Pattern[str], Callable[..., Any]]] = [
    ("motor_gain", _pattern("(?:joint|motor) # (dead|reversed)"), _GAIN_OF_WORD.__getitem__),
    ("motor_gain", _pattern("(?:joint|motor) # at gain @"), float),
    ("locked_joints", _pattern("joint # locked"), lambda: True),
    ("motor_strength", _pattern("motor # strength x @"), float),
    ("motor_delay", _pattern(r"motor # delayed by (\d{1,9}) steps?"), int),
    ("motor_stuck", _pattern("motor # stuck at @"), float),
    ("joint_offset", _pattern("joint # sensor off by @ (deg|rad)"), _radians),
    ("sensor_gain", _pattern("sensor # (dead|reversed)"), _GAIN_OF_WORD.__getitem__),
    ("sensor_gain", _pattern("sensor # at gain @"), float),
    ("sensor_offset", _pattern("sensor # off by @"), float),
    ("sensor_noise", _pattern("sensor # noise @"), float),
    ("sensor_delay", _pattern(r"sensor # delayed by (\d{1,9}) steps?"), int),
    ("sensor_dropout", _pattern("sensor # frozen"), lambda: 1.0),
    ("sensor_dropout", _pattern("sensor # loses @ of its readings"), float),
    ("orientation_error", _pattern("yaw sensor off by @ (deg|rad)"), _radians),
    ("friction", _pattern("friction x @"), float),
    ("base_mass", _pattern("base mass x @"), float),
    ("body_mass", _pattern("body # mass x @"), float),
    ("mass", _pattern("mass x @"), float),
    ("damping", _pattern("damping x @"), float),
]
"""Each kind of clause: its field, what it looks like, and its value from what stands behind the index."""
