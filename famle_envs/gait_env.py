"""Robots that walk one gait at a time: an action is four numbers, applied for a second by servos in every joint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from famle_envs.engines.world import HOLDING_TORQUE, Array, Camera, Point, Quaternion
from famle_envs.gaits import GAIT_DIM, trot
from famle_envs.profile import SIMULATOR, Profile, resolve_profile
from famle_envs.robot_env import RobotEnv
from famle_envs.situation import Situation

__all__ = ["GaitEnv"]

_SETTLING_STEPS = 50  # until a robot that was put on the floor stands still
_GIMBAL_LOCK = 0.99999  # sine of the pitch


class GaitEnv(RobotEnv):
    """Base of the robots that walk one gait a second. Between two actions the robot walks on; nothing is reset.

    Args:
        profile: What the body is beside its situation: ``"simulator"``, ``"held-out"``, a :class:`Profile` or a mapping
            of its fields. Agents are trained on the simulator only.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Raises:
        TypeError: The profile is of another type; and as :class:`RobotEnv`.
        ValueError: The profile is unknown or not one of this robot; and as :class:`RobotEnv`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (Gymnasium's own type)

    supported_faults = frozenset({"locked_joints", "orientation_error", "friction", "base_mass", "motor_strength"})
    task_arguments = RobotEnv.task_arguments | {"profile"}
    time_step = 0.01
    physics_steps = 100
    substeps = 2
    solver_iterations = 50

    floor_friction: ClassVar[float]
    motor_torque: ClassVar[float]
    """At which a servo saturates, in N m."""
    motor_speed: ClassVar[float]
    """Of a joint at most, in rad/s."""
    position_gain: ClassVar[float] = 0.1
    """Part of the angle's error that a servo would make good in one physics step."""
    rest_angles: ClassVar[Array]
    """Joint angles of the robot at rest in rad, (n_joints,); a blocked joint is held there."""
    swing_angles: ClassVar[Array]
    """What a swing of 1 of each leg adds to the joint angles, in rad, (4, n_joints)."""
    lift_angles: ClassVar[Array]
    """What a lift of 1 of each leg adds to them, (4, n_joints)."""
    profiles: ClassVar[Mapping[str, Profile]]
    """Profiles by name, beside the simulator."""

    def __init__(
        self,
        *,
        profile: Profile | Mapping[str, Any] | str = SIMULATOR,
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.profile = resolve_profile(profile, self.profiles, len(self.joints))
        self.action_space = spaces.Box(-1.0, 1.0, (GAIT_DIM,))
        seconds = self.time_step / self.substeps / self.position_gain  # in which a servo would make good an error
        self._reach = seconds * self.profile.motor_speed * self.motor_speed
        self._zero_errors = np.array(self.profile.zero_errors or (0.0,) * len(self.joints))
        self._times = self.time_step * np.arange(self.physics_steps)
        super().__init__(situation=situation, engine=engine, render_mode=render_mode)

    def _joint_targets(self, swing: Array, lift: Array) -> Array:
        """Joint angles in rad, (n, n_joints), that give each leg the swings and lifts (n, 4) of a gait."""
        return self.rest_angles + lift @ self.lift_angles + swing @ self.swing_angles

    @property
    def position(self) -> Point:
        """Where the body is, in m, whatever the sensors say."""
        return self.world.base_pose()[0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """See :meth:`RobotEnv.reset`."""
        self._on_its_way = np.tile(self.rest_angles, (round(self.profile.latency / self.time_step), 1))
        self._geared: Array = self.rest_angles
        return super().reset(seed=seed, options=options)

    def _simulate(self, action: Array) -> None:
        targets = self._joint_targets(*trot(action, self._times))
        targets = self._with_backlash(self._delayed(targets))
        targets += self._zero_errors
        targets[:, self._blocked] = self.rest_angles[self._blocked]
        for row in targets:
            self.actuate(row)
            self.world.simulate()

    def actuate(self, action: Array) -> None:
        """Sends the servos to joint angles, (n_joints,); no servo sees an error beyond its speed."""
        angles, _ = self.world.joint_states()
        targets = angles + np.minimum(np.maximum(action - angles, -self._reach), self._reach)
        self.world.servo(targets, self._torques, self.position_gain)

    def _delayed(self, targets: Array) -> Array:
        """The targets that arrive in this control step, (n, n_joints), the last ones of the step before first."""
        queue = np.concatenate([self._on_its_way, targets])
        self._on_its_way = queue[len(targets) :]
        return queue[: len(targets)]

    def _with_backlash(self, targets: Array) -> Array:
        """Joints behind gears with play: each rests until the motor has crossed the gap."""
        gap = self.profile.backlash
        geared = np.empty_like(targets)
        for t, target in enumerate(targets):
            self._geared = np.minimum(np.maximum(self._geared, target - gap), target + gap)
            geared[t] = self._geared
        return geared

    def _measured_pose(self) -> tuple[Array, Array]:
        """Position in m and roll, pitch and yaw in rad as the sensors give them; angles are not wrapped."""
        position, quaternion = self.world.base_pose()
        place, angles = np.array(position), np.array(roll_pitch_yaw(quaternion))
        angles[2] += self._situation.orientation_error
        profile = self.profile
        if profile.position_noise or profile.orientation_noise:
            noise = self.np_random.standard_normal(6)
            place += profile.position_noise * noise[:3]
            angles += profile.orientation_noise * noise[3:]
        return place, angles

    def _settle(self) -> None:
        self.world.servo(self.rest_angles, np.full(len(self.joints), self.motor_torque))
        self.world.simulate(_SETTLING_STEPS)

    def _apply_situation(self) -> None:
        super()._apply_situation()
        profile, situation = self.profile, self._situation
        self._blocked = list(situation.locked_joints)
        self._torques = profile.motor_strength * self.motor_torque * np.array(situation.motor_strength)
        self._torques[self._blocked] = HOLDING_TORQUE
        self.world.scale_masses(profile.base_mass * situation.base_mass, profile.leg_mass)
        self.world.add_damping(profile.joint_damping)
        friction = self.floor_friction * profile.floor_friction * situation.friction
        self.world.set_floor(friction, profile.contact_stiffness, profile.contact_damping)

    def _camera(self) -> Camera:
        x, y, _ = self.position
        return Camera((x, y, 0.0), distance=1.2, yaw=30.0, pitch=-35.0)


def roll_pitch_yaw(quaternion: Quaternion) -> Point:
    """The angles in rad about x, y and z, one after the other, of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    sine = -2.0 * (x * z - w * y)
    if abs(sine) >= _GIMBAL_LOCK:  # where only roll and yaw together are known
        side = math.copysign(1.0, sine)
        return 0.0, side * math.pi / 2, 2.0 * math.atan2(-side * x, side * y)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    roll = math.atan2(2.0 * (y * z + w * x), ww - xx - yy + zz)
    return roll, math.asin(sine), math.atan2(2.0 * (x * y + w * z), ww + xx - yy - zz)


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle, 2.0 * math.pi)
