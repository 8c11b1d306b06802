"""Held-out dynamics: how a test robot differs from every simulator that an agent is trained in (sim-to-sim).

A profile is fixed before any result of an agent on it is looked at, and no agent meta-learns or is tuned on one.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from famle_envs.arguments import number_within

__all__ = ["SIMULATOR", "Profile", "resolve_profile"]


@dataclass(frozen=True)
class Profile:
    """The body behind the situation: what a real robot has and the default simulator has not.

    Attributes:
        name: What to call it.
        motor_strength: Factor on the torque at which a motor saturates.
        motor_speed: Factor on a joint's greatest speed.
        joint_damping: Added to each joint, in N m s/rad.
        zero_errors: By how much each joint stands off the angle that its servo reports, in rad; none where it is empty.
        backlash: Play of the gears between motor and joint, in rad to either side.
        latency: Delay of the joint commands, in s.
        base_mass: Factor on the mass and the inertia of the base.
        leg_mass: Factor on those of all other links.
        floor_friction: Factor on the floor's friction.
        contact_stiffness: Of the floor, in N/m; 0 is rigid.
        contact_damping: Of the floor, in N s/m.
        position_noise: Deviation of measured positions, in m.
        orientation_noise: Deviation of measured angles of the body, in rad.
    """

    name: str = "simulator"
    motor_strength: float = 1.0
    motor_speed: float = 1.0
    joint_damping: float = 0.0
    zero_errors: tuple[float, ...] = ()
    backlash: float = 0.0
    latency: float = 0.0
    base_mass: float = 1.0
    leg_mass: float = 1.0
    floor_friction: float = 1.0
    contact_stiffness: float = 0.0
    contact_damping: float = 0.0
    position_noise: float = 0.0
    orientation_noise: float = 0.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self)[1:]:
            value = getattr(self, field.name)
            if field.name == "zero_errors":
                object.__setattr__(
                    self, field.name, tuple(number_within(field.name, x, -10.0, 10.0, "rad") for x in value)
                )
            elif field.name in _FACTORS:
                number = number_within(field.name, value, 1e-3, 1e3, "times that of the simulator")
                object.__setattr__(self, field.name, number)
            else:
                number = number_within(field.name, value, 0.0, 1e6, "(see the profile's fields for units)")
                object.__setattr__(self, field.name, number)

    @property
    def is_simulator(self) -> bool:
        """Whether agents may be trained on it."""
        return self == SIMULATOR

    def __str__(self) -> str:
        fields = {key: value for key, value in vars(self).items() if key != "name"}
        differs = [f"{key} {value}" for key, value in fields.items() if value != getattr(SIMULATOR, key)]
        return ": ".join([self.name, ", ".join(differs)]) if differs else self.name


_FACTORS = {"motor_strength", "motor_speed", "base_mass", "leg_mass", "floor_friction"}
SIMULATOR = Profile()


def resolve_profile(profile: Profile | Mapping[str, Any] | str, known: Mapping[str, Profile], n_joints: int) -> Profile:
    """Returns a profile, be it given or named.

    Args:
        profile: A profile, a mapping of its fields or a name.
        known: The robot's profiles by name, beside the simulator.
        n_joints: The number of its joints.

    Raises:
        TypeError: It is neither a profile nor a mapping nor a name, or a field is unknown.
        ValueError: The robot has no profile of that name, or another number of joints.
    """
    if isinstance(profile, Mapping):
        profile = Profile(**profile)
    if isinstance(profile, str):
        if profile == "reality":
            warnings.warn(
                "The profile 'reality' is 'held-out' now; the old name goes with the next version.",
                DeprecationWarning,
                stacklevel=3,
            )
            profile = "held-out"
        profiles = {SIMULATOR.name: SIMULATOR, **known}
        if profile not in profiles:
            raise ValueError(f"There is no profile {profile!r}. Profiles: {', '.join(profiles)}.")
        profile = profiles[profile]
    if not isinstance(profile, Profile):
        raise TypeError(f"profile must be a Profile, a mapping of its fields or a name, got {type(profile).__name__}.")
    if len(profile.zero_errors) not in (0, n_joints):
        raise ValueError(f"zero_errors must name each of the {n_joints} joints or none, got {profile.zero_errors}.")
    return profile
