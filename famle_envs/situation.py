"""What is wrong with a robot: the situations c ~ p(c) of the FAMLE paper, as data."""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

__all__ = ["Situation", "resolve_situation"]

_GAIN_OF_WORD = {"dead": 0.0, "reversed": -1.0}
_WORD_OF_GAIN = {gain: word for word, gain in _GAIN_OF_WORD.items()}
_NUMBER = r"(-?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)"
_CLAUSES = {
    "dead": re.compile(r"joint (\d+) dead"),
    "reversed": re.compile(r"joint (\d+) reversed"),
    "gain": re.compile(rf"joint (\d+) at gain {_NUMBER}"),
    "locked": re.compile(r"joint (\d+) locked"),
    "offset": re.compile(rf"joint (\d+) sensor off by {_NUMBER} (deg|rad)"),
    "yaw": re.compile(rf"yaw sensor off by {_NUMBER} (deg|rad)"),
    "friction": re.compile(rf"friction x {_NUMBER}"),
    "base_mass": re.compile(rf"base mass x {_NUMBER}"),
}


class UnreadableError(ValueError):
    """A text is no description of a situation."""


@dataclass(frozen=True, eq=False)
class Situation:
    """A circumstance that perturbs the dynamics of a robot. Immutable, hashable, comparable.

    Joints are counted from 0, and a joint beyond the end of a tuple is as built. Two situations are
    equal when the same things are wrong: the name is a label and takes no part in it.

    Args:
        motor_gain: Factor on the command of each joint, from -1 (reversed) over 0 (dead) to 1 (intact).
        locked_joints: Indices of the joints that are held where they are.
        joint_offset: Error of each joint's angle sensor, in rad.
        orientation_error: Error of the measured yaw, in rad; kept in (-pi, pi].
        friction: Multiplier of the robot's own floor friction, above 0.
        base_mass: Multiplier of the mass of the robot's base, above 0.
        name: What to call the situation; :attr:`label` falls back on its description.

    Raises:
        TypeError: A field holds something that is not a number, or not a sequence of numbers.
        ValueError: A value is not finite, a gain lies outside [-1, 1], a multiplier is not above 0,
            or a joint index is negative.

    Example:
        >>> broken = Situation(motor_gain=(-1, 1, 1, 0, 1))
        >>> print(broken)
        joint 0 reversed, joint 3 dead
        >>> Situation.from_string(str(broken)) == broken
        True
    """

    motor_gain: tuple[float, ...] = ()
    locked_joints: tuple[int, ...] = ()
    joint_offset: tuple[float, ...] = ()
    orientation_error: float = 0.0
    friction: float = 1.0
    base_mass: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        gains = _floats("motor_gain", self.motor_gain)
        if any(abs(gain) > 1.0 for gain in gains):
            raise ValueError(
                f"motor_gain must lie in [-1, 1] for every joint, got {list(gains)}. "
                "Use -1 for a reversed motor, 0 for a dead one, 1 for an intact one."
            )
        object.__setattr__(self, "motor_gain", gains)
        object.__setattr__(self, "locked_joints", _indices("locked_joints", self.locked_joints))
        object.__setattr__(self, "joint_offset", _floats("joint_offset", self.joint_offset))
        object.__setattr__(self, "orientation_error", _wrap(_float("orientation_error", self.orientation_error)))
        for multiplier in ("friction", "base_mass"):
            value = _float(multiplier, getattr(self, multiplier))
            if value <= 0.0:
                raise ValueError(f"{multiplier} multiplies the robot's own value and must be above 0, got {value}.")
            object.__setattr__(self, multiplier, value)
        if not isinstance(self.name, str):
            raise TypeError(f"name must be a string, got {type(self.name).__name__}.")

    @property
    def label(self) -> str:
        """The name where there is one, else the description."""
        return self.name or str(self)

    @property
    def is_intact(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults

    @property
    def faults(self) -> frozenset[str]:
        """The names of the fields that differ from an intact robot."""
        return frozenset(name for name, value in self.canonical().items() if value != _INTACT[name])

    def canonical(self) -> dict[str, Any]:
        """Returns all fields but the name, without the joints at the end of a tuple that are as built."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "name"}
        return values | {
            "motor_gain": _strip(self.motor_gain, 1.0),
            "joint_offset": _strip(self.joint_offset, 0.0),
        }

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Situation):
            return NotImplemented
        return self.canonical() == other.canonical()

    def __hash__(self) -> int:
        return hash(tuple(self.canonical().values()))

    def __str__(self) -> str:
        clauses = [_describe_gain(joint, gain) for joint, gain in enumerate(self.motor_gain) if gain != 1.0]
        clauses += [f"joint {joint} locked" for joint in self.locked_joints]
        clauses += [f"joint {i} sensor off by {_angle(off)}" for i, off in enumerate(self.joint_offset) if off != 0.0]
        if self.orientation_error != 0.0:
            clauses.append(f"yaw sensor off by {_angle(self.orientation_error)}")
        if self.friction != 1.0:
            clauses.append(f"friction x {_number(self.friction)}")
        if self.base_mass != 1.0:
            clauses.append(f"base mass x {_number(self.base_mass)}")
        return ", ".join(clauses) or "intact"

    def to_dict(self) -> dict[str, Any]:
        """The fields that differ from an intact robot, and the name, as JSON types."""
        values = {name: getattr(self, name) for name in sorted(self.faults)}
        if self.name:
            values["name"] = self.name
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_dict(cls, mapping: Mapping[str, Any]) -> Situation:
        """Builds a situation from a mapping of field names to values.

        Raises:
            TypeError: It is no mapping, or a value is of the wrong type.
            ValueError: A key is not a field of a situation, or a value is out of range.
        """
        if not isinstance(mapping, Mapping):
            raise TypeError(f"Expected a mapping of a situation's fields, got {type(mapping).__name__}.")
        known = [f.name for f in dataclasses.fields(cls)]
        for key in mapping:
            if key not in known:
                raise ValueError(
                    f"A situation has no field {key!r}{_suggest(str(key), known)} Fields: {', '.join(known)}."
                )
        return cls(**mapping)

    @classmethod
    def from_string(cls, text: str) -> Situation:
        """Reads what :meth:`__str__` writes.

        The tuples end at the last joint mentioned; :meth:`for_robot` completes them.

        Raises:
            TypeError: It is no string.
            ValueError: A clause cannot be read, contradicts another one, or says an impossible value.
        """
        if not isinstance(text, str):
            raise TypeError(f"Expected a description such as 'joint 3 dead', got {type(text).__name__}.")
        clauses = [clause.strip() for clause in text.split(",")]
        if clauses == ["intact"]:
            return cls()
        gain: dict[int, float] = {}
        offset: dict[int, float] = {}
        locked: list[int] = []
        scalars: dict[str, float] = {}
        for clause in clauses:
            kind, groups = _match(clause)
            if kind in _GAIN_OF_WORD:
                _say(gain, _joint(groups[0]), _GAIN_OF_WORD[kind], clause)
            elif kind == "gain":
                _say(gain, _joint(groups[0]), float(groups[1]), clause)
            elif kind == "locked":
                locked.append(_joint(groups[0]))
            elif kind == "offset":
                _say(offset, _joint(groups[0]), _radians(groups[1], groups[2]), clause)
            elif kind == "yaw":
                _say(scalars, "orientation_error", _radians(groups[0], groups[1]), clause)
            else:
                _say(scalars, kind, float(groups[0]), clause)
        tuples = {"motor_gain": _dense(gain, 1.0), "locked_joints": tuple(locked), "joint_offset": _dense(offset, 0.0)}
        return cls.from_dict({**tuples, **scalars})

    def for_robot(self, robot: str, n_joints: int, supported: frozenset[str]) -> Situation:
        """Completes the situation for a robot and refuses what that robot cannot have.

        Args:
            robot: The robot's name, for the messages.
            n_joints: The number of joints; per-joint fields get this length.
            supported: The fields that this robot can have.

        Raises:
            ValueError: A field is not supported, a tuple is too long, or a joint does not exist.
        """
        for fault in sorted(self.faults - supported):
            raise ValueError(
                f"{robot} cannot have the fault {fault!r}; remove it. It supports: {', '.join(sorted(supported))}."
            )
        for name in ("motor_gain", "joint_offset"):
            if len(getattr(self, name)) > n_joints:
                raise ValueError(
                    f"{name} speaks of {len(getattr(self, name))} joints; those of {robot} are 0 to {n_joints - 1}."
                )
        if self.locked_joints and self.locked_joints[-1] >= n_joints:
            raise ValueError(
                f"locked_joints names joint {self.locked_joints[-1]}; the joints of {robot} are 0 to {n_joints - 1}."
            )
        return dataclasses.replace(
            self,
            motor_gain=_pad(self.motor_gain, n_joints, 1.0),
            joint_offset=_pad(self.joint_offset, n_joints, 0.0),
        )


def resolve_situation(
    situation: Situation | Mapping[str, Any] | str | None, presets: Mapping[str, Situation]
) -> Situation:
    """Turns whatever a user may write for a situation into a :class:`Situation`.

    Args:
        situation: A situation, a mapping of its fields, the name of a preset or a description as
            ``str(situation)`` writes it; None means intact.
        presets: The presets by name.

    Raises:
        TypeError: The argument is of no such type.
        ValueError: The name is neither a preset nor a description.
    """
    if situation is None:
        return Situation()
    if isinstance(situation, Situation):
        return situation
    if isinstance(situation, Mapping):
        return Situation.from_dict(situation)
    if not isinstance(situation, str):
        raise TypeError(
            f"situation must be a Situation, a mapping, a preset's name or None, got {type(situation).__name__}."
        )
    if situation in presets:
        return presets[situation]
    try:
        return Situation.from_string(situation)
    except UnreadableError as error:
        raise ValueError(
            f"No situation is called {situation!r}{_suggest(situation, list(presets))} Presets: {', '.join(presets)}."
        ) from error


def _describe_gain(joint: int, gain: float) -> str:
    return f"joint {joint} {_WORD_OF_GAIN.get(gain, f'at gain {_number(gain)}')}"


def _number(value: float) -> str:
    """The shortest text that reads back as the same float."""
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)


def _angle(value: float) -> str:
    """Degrees where they are exact, since people think in them; radians otherwise."""
    degrees = f"{math.degrees(value):g}"
    return f"{degrees} deg" if math.radians(float(degrees)) == value else f"{_number(value)} rad"


def _radians(number: str, unit: str) -> float:
    return math.radians(float(number)) if unit == "deg" else float(number)


def _match(clause: str) -> tuple[str, tuple[str, ...]]:
    for kind, pattern in _CLAUSES.items():
        if match := pattern.fullmatch(clause):
            return kind, match.groups()
    raise UnreadableError(f"Cannot read {clause!r}. Write faults like 'joint 3 dead, yaw sensor off by 30 deg'.")


def _joint(index: str) -> int:
    if len(index) > 3:
        raise ValueError(f"No robot has a joint {index}.")
    return int(index)


def _say(values: dict[Any, float], key: Any, value: float, clause: str) -> None:
    if key in values:
        raise ValueError(f"{clause!r} contradicts what was said before it; say one thing of each motor and sensor.")
    values[key] = value


def _dense(values: Mapping[int, float], default: float) -> tuple[float, ...]:
    return tuple(values.get(joint, default) for joint in range(max(values) + 1)) if values else ()


def _pad(values: tuple[float, ...], length: int, default: float) -> tuple[float, ...]:
    return values + (default,) * (length - len(values))


def _strip(values: tuple[float, ...], default: float) -> tuple[float, ...]:
    while values and values[-1] == default:
        values = values[:-1]
    return values


def _wrap(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    if not -math.pi < angle <= math.pi:
        angle = math.remainder(angle, 2 * math.pi)
    return math.pi if angle <= -math.pi else angle


def _float(name: str, value: Any) -> float:
    if not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r}.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {number}.")
    return number


def _floats(name: str, values: Sequence[float]) -> tuple[float, ...]:
    if isinstance(values, (str, bytes, Mapping)) or not hasattr(values, "__iter__"):
        raise TypeError(f"{name} must be a sequence with one number per joint, got {values!r}.")
    return tuple(_float(name, value) for value in values)


def _indices(name: str, values: Sequence[int]) -> tuple[int, ...]:
    indices = _floats(name, values)
    if any(index != int(index) or index < 0 for index in indices):
        raise ValueError(f"{name} must hold joint indices (0, 1, ...), got {list(values)}.")
    return tuple(sorted({int(index) for index in indices}))


def _suggest(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else "."


_INTACT = Situation().canonical()
