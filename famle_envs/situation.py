"""What is wrong with a robot: the situations c ~ p(c) of the FAMLE paper, as data."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

from famle_envs.situation_fields import MULTIPLIERS, PER_PART, angle, entries_of, indices, multiplier
from famle_envs.situation_text import UnreadableError, describe, read

__all__ = ["Situation", "resolve_situation"]


@dataclass(frozen=True, eq=False)
class Situation:
    """A circumstance that perturbs the dynamics of a robot. Immutable, hashable, comparable.

    Joints, motors, sensors and bodies are counted from 0; one beyond the end of a tuple is as built, of which
    ``motor_gain`` has to say so (``partial``). The robots of famle_envs have the first six faults, those that walk by
    gaits ``motor_strength`` too; :mod:`famle_envs.faults` puts all others, and most of these, into any robot.
    Two situations are equal when the same things are wrong: the name is a label and takes no part in it.

    Args:
        motor_gain: Factor on the command of each joint, from -1 (reversed) over 0 (dead) to 1 (intact).
        locked_joints: Indices of the joints that are held where they are.
        joint_offset: Error of each joint's angle sensor, in rad.
        orientation_error: Error of the measured yaw, in rad; kept in (-pi, pi].
        friction: Multiplier of the robot's own floor friction, above 0.
        base_mass: Multiplier of the mass of the robot's base, above 0.
        name: What to call the situation; :attr:`label` falls back on its description.
        motor_strength: Multiplier of the force of each motor, above 0. Unlike a gain, it can exceed 1.
        motor_delay: By how many steps the command of each motor comes late, 0 to 1,000.
        motor_stuck: The command that each motor carries out whatever it is told; None for one that obeys.
        sensor_gain: Factor on each dimension of the observation; 0 is a dead sensor.
        sensor_offset: Error of each, in its unit.
        sensor_noise: Standard deviation of the noise on each, in its unit.
        sensor_delay: By how many steps each comes late, 0 to 1,000.
        sensor_dropout: Probability that a reading of each is lost and the last one is repeated; 1 is a frozen sensor.
        mass: Multiplier of the masses of all bodies, above 0.
        body_mass: Multiplier of the mass of each body, above 0.
        damping: Multiplier of the damping of all joints, above 0.
        partial: Whether joints beyond the end of ``motor_gain`` are as built; otherwise a robot refuses one that does
            not speak of all its joints. It is no fault.

    Raises:
        TypeError: A field holds something that is not a number, or not a sequence of numbers.
        ValueError: A value is not finite or out of its range, or an index is negative.

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
    _: KW_ONLY
    motor_strength: tuple[float, ...] = ()
    motor_delay: tuple[int, ...] = ()
    motor_stuck: tuple[float | None, ...] = ()
    sensor_gain: tuple[float, ...] = ()
    sensor_offset: tuple[float, ...] = ()
    sensor_noise: tuple[float, ...] = ()
    sensor_delay: tuple[int, ...] = ()
    sensor_dropout: tuple[float, ...] = ()
    mass: float = 1.0
    body_mass: tuple[float, ...] = ()
    damping: float = 1.0
    partial: bool = False

    def __post_init__(self) -> None:
        for name in PER_PART:
            object.__setattr__(self, name, entries_of(name, getattr(self, name)))
        object.__setattr__(self, "locked_joints", indices("locked_joints", self.locked_joints))
        object.__setattr__(self, "orientation_error", angle("orientation_error", self.orientation_error))
        for name in MULTIPLIERS:
            object.__setattr__(self, name, multiplier(name, getattr(self, name)))
        if not isinstance(self.name, str):
            raise TypeError(f"name must be a string, got {type(self.name).__name__}.")
        if not isinstance(self.partial, bool):
            raise TypeError(f"partial must be True or False, got {self.partial!r}.")

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
        """Returns all fields that are faults, without the parts at the end of a tuple that are as built."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in _LABELS}
        return values | {name: _strip(values[name], entries.as_built) for name, entries in PER_PART.items()}

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Situation):
            return NotImplemented
        return self.canonical() == other.canonical()

    def __hash__(self) -> int:
        return hash(tuple(self.canonical().values()))

    def __str__(self) -> str:
        return describe(self.canonical(), _INTACT | {name: entries.as_built for name, entries in PER_PART.items()})

    def to_dict(self) -> dict[str, Any]:
        """The fields that differ from an intact robot, and the labels, as JSON types."""
        values = {name: getattr(self, name) for name in sorted(self.faults)}
        if self.name:
            values["name"] = self.name
        if self.partial and "motor_gain" in values:
            values["partial"] = True
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
        """Reads what :meth:`__str__` writes; a motor may be called a motor or by its joint.

        The tuples end at the last part mentioned; :meth:`for_robot` completes them.

        Raises:
            TypeError: It is no string.
            ValueError: A clause cannot be read, contradicts another one, or says an impossible value.
        """
        if not isinstance(text, str):
            raise TypeError(f"Expected a description such as 'joint 3 dead', got {type(text).__name__}.")
        fields: dict[str, Any] = {}
        for name, said in read(text).items():
            if name == "locked_joints":
                fields[name] = tuple(said)
            elif name in PER_PART:
                fields[name] = tuple(said.get(i, PER_PART[name].as_built) for i in range(max(said) + 1))
            else:
                fields[name] = said[0]
        return cls(**fields, partial="motor_gain" in fields)

    def for_robot(
        self, robot: str, n_joints: int, supported: frozenset[str], *, n_sensors: int = 0, n_bodies: int = 0
    ) -> Situation:
        """Completes the situation for a robot and refuses what that robot cannot have.

        Args:
            robot: The robot's name, for the messages.
            n_joints: The number of motorised joints.
            supported: The fields that this robot can have.
            n_sensors: The dimensions of its observation, where sensors are supported.
            n_bodies: Its bodies, where their masses are supported.

        Returns:
            The situation with an entry for each part in all tuples.

        Raises:
            ValueError: A field is not supported, a tuple is too long, or a joint does not exist; or ``motor_gain`` is
                too short without saying so.
        """
        for fault in sorted(self.faults - supported):
            raise ValueError(
                f"{robot} cannot have the fault {fault!r}; remove it. It supports: {', '.join(sorted(supported))}."
            )
        numbers = {"joint": n_joints, "motor": n_joints, "sensor": n_sensors, "body": n_bodies}
        complete: dict[str, Any] = {}
        for name, (part, as_built, _) in PER_PART.items():
            values, n = getattr(self, name), numbers[part]
            if len(values) > n > 0:
                plural = {"body": "bodies"}.get(part, f"{part}s")
                raise ValueError(f"{name} speaks of {len(values)} {plural}; those of {robot} are 0 to {n - 1}.")
            if name == "motor_gain" and name in self.faults and len(values) < n and not self.partial:
                raise ValueError(
                    f"motor_gain speaks of {len(values)} of the {n} joints of {robot}: give a gain for each; or say "
                    f"{str(Situation(motor_gain=self.motor_gain))!r}, or partial=True, where all others are as built."
                )
            complete[name] = values[:n] + (as_built,) * (n - len(values))
        if self.locked_joints and self.locked_joints[-1] >= n_joints:
            raise ValueError(
                f"locked_joints names joint {self.locked_joints[-1]}; the joints of {robot} are 0 to {n_joints - 1}."
            )
        return dataclasses.replace(self, **complete, partial=False)


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
        ValueError: The name is neither a preset nor a description, or what it says cannot be.
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
        # An agent that composes presets writes "a + b".
        return Situation.from_string(" + ".join(str(presets.get(part, part)) for part in situation.split(" + ")))
    except UnreadableError as error:
        if not presets:
            raise
        raise ValueError(
            f"No situation is called {situation!r}{_suggest(situation, list(presets))} Presets: {'; '.join(presets)}."
        ) from error


def _strip(values: tuple[Any, ...], default: Any) -> tuple[Any, ...]:
    wrong = (i for i in range(len(values), 0, -1) if values[i - 1] != default)
    return values[: next(wrong, 0)]


def _suggest(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else "."


_LABELS = ("name", "partial")
"""The fields that are no faults."""

_INTACT = Situation().canonical()
