"""Robots that walk one gait at a time: an action is four numbers, applied for a second by servos in every joint."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pybullet
from gymnasium import spaces

from famle_envs.bullet_env import HOLDING_FORCE, Array, BulletEnv
from famle_envs.gaits import GAIT_DIM, trot
from famle_envs.profile import SIMULATOR, Profile, resolve_profile
from famle_envs.situation import Situation

__all__ = ["GaitEnv"]

_SETTLING_STEPS = 50  # until a robot that was put on the floor stands still


class GaitEnv(BulletEnv):
    """Base of the robots that walk one gait a second. Between two actions the robot walks on; nothing is reset.

    Args:
        profile: What the body is beside its situation: ``"simulator"``, ``"held-out"``, a :class:`Profile` or a mapping
            of its fields. Agents are trained on the simulator only.
        situation: See :class:`BulletEnv`.
        render_mode: See :class:`BulletEnv`.

    Raises:
        TypeError: The profile is of another type; and as :class:`BulletEnv`.
        ValueError: The profile is unknown or not one of this robot; and as :class:`BulletEnv`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012 (Gymnasium's own type)

    supported_faults = frozenset({"locked_joints", "orientation_error", "friction", "base_mass"})
    task_arguments = BulletEnv.task_arguments | {"profile"}
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
    """Joint angles of the robot at rest, (n_joints,); a blocked joint is held there."""
    profiles: ClassVar[Mapping[str, Profile]]
    """Profiles by name, beside the simulator."""

    def __init__(
        self,
        *,
        profile: Profile | Mapping[str, Any] | str = SIMULATOR,
        situation: Situation | Mapping[str, Any] | str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.profile = resolve_profile(profile, self.profiles, len(self.joints))
        self.action_space = spaces.Box(-1.0, 1.0, (GAIT_DIM,))
        self._gains = [self.position_gain] * len(self.joints)
        seconds = self.time_step / self.substeps / self.position_gain  # in which a servo would make good an error
        self._reach = seconds * self.profile.motor_speed * self.motor_speed
        self._zero_errors = np.array(self.profile.zero_errors or (0.0,) * len(self.joints))
        self._times = self.time_step * np.arange(self.physics_steps)
        super().__init__(situation=situation, render_mode=render_mode)

    @abstractmethod
    def _joint_targets(self, swing: Array, lift: Array) -> Array:
        """Joint angles in rad, (n, n_joints), that give each leg the swings and lifts (n, 4) of a gait."""

    @property
    def position(self) -> tuple[float, float, float]:
        """Where the body is, in m, whatever the sensors say."""
        x, y, z = pybullet.getBasePositionAndOrientation(self.robot, physicsClientId=self._world)[0]
        return x, y, z

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """See :meth:`BulletEnv.reset`."""
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
            pybullet.stepSimulation(physicsClientId=self._world)

    def actuate(self, action: Array) -> None:
        """Sends the servos to joint angles, (n_joints,); no servo sees an error beyond its speed."""
        states = pybullet.getJointStates(self.robot, self.joints, physicsClientId=self._world)
        angles = np.array([state[0] for state in states])
        targets = angles + np.minimum(np.maximum(action - angles, -self._reach), self._reach)
        pybullet.setJointMotorControlArray(
            self.robot,
            self.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=targets.tolist(),
            forces=self._forces,
            positionGains=self._gains,
            physicsClientId=self._world,
        )

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

    def _measured_pose(self) -> tuple[list[float], list[float]]:
        """Position in m and roll, pitch and yaw in rad as the sensors give them; angles are not wrapped."""
        position, quaternion = pybullet.getBasePositionAndOrientation(self.robot, physicsClientId=self._world)
        roll, pitch, yaw = pybullet.getEulerFromQuaternion(quaternion)
        angles = [roll, pitch, yaw + self._situation.orientation_error]
        profile = self.profile
        if profile.position_noise or profile.orientation_noise:
            noise = self.np_random.standard_normal(6)
            position = position + profile.position_noise * noise[:3]
            angles = angles + profile.orientation_noise * noise[3:]
        return list(position), list(angles)

    def _load_robot(self, path: str, client: int) -> int:
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        self._floor = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
        robot = self._place_robot(path, client)
        links = range(-1, pybullet.getNumJoints(robot, physicsClientId=client))
        self._as_built = {link: pybullet.getDynamicsInfo(robot, link, physicsClientId=client) for link in links}
        info = [pybullet.getJointInfo(robot, joint, physicsClientId=client) for joint in self.joints]
        self._damping_as_built = [row[6] for row in info]
        pybullet.setJointMotorControlArray(
            robot,
            self.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=self.rest_angles.tolist(),
            forces=[self.motor_torque] * len(self.joints),
            physicsClientId=client,
        )
        for _ in range(_SETTLING_STEPS):
            pybullet.stepSimulation(physicsClientId=client)
        return robot

    @abstractmethod
    def _place_robot(self, path: str, client: int) -> int:
        """Loads the robot at rest above the origin."""

    def _apply_situation(self) -> None:
        super()._apply_situation()
        profile, situation = self.profile, self._situation
        self._blocked = list(situation.locked_joints)
        self._forces = [profile.motor_strength * self.motor_torque] * len(self.joints)
        for joint in self._blocked:
            self._forces[joint] = HOLDING_FORCE
        for link, built in self._as_built.items():
            factor = profile.base_mass * situation.base_mass if link == -1 else profile.leg_mass
            self._change(self.robot, link, mass=factor * built[0])
            self._change(self.robot, link, localInertiaDiagonal=[factor * value for value in built[2]])
        for joint, built in zip(self.joints, self._damping_as_built, strict=True):
            self._change(self.robot, joint, jointDamping=built + profile.joint_damping)
        friction = self.floor_friction * profile.floor_friction * situation.friction
        self._change(self._floor, -1, lateralFriction=friction)
        if profile.contact_stiffness:
            stiffness, damping = profile.contact_stiffness, profile.contact_damping
            self._change(self._floor, -1, contactStiffness=stiffness, contactDamping=damping)

    def _change(self, body: int, link: int, **dynamics: Any) -> None:
        pybullet.changeDynamics(body, link, physicsClientId=self._world, **dynamics)

    def _camera(self) -> dict[str, Any]:
        x, y, _ = self.position
        return {"cameraTargetPosition": (x, y, 0.0), "distance": 1.2, "yaw": 30, "pitch": -35, "roll": 0}


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi]."""
    return math.remainder(angle, 2.0 * math.pi)
