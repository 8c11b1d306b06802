"""Robots in MuJoCo, from the same descriptions and under the same laws of motors and contacts as in PyBullet.

PyBullet's constraints let an error vanish: a motor's or a contact's speed v within a step, a distance r by a fifth a
step. MuJoCo's pull towards a reference acceleration, so that this is

    a_ref = -v / dt - 0.2 r / dt^2,

to which a time constant of 2 dt and a damping ratio of 1 / sqrt(0.8) amount. Contacts, joint limits and loops are as
rigid as MuJoCo makes them by default, 0.9 to 0.95.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from importlib.resources import as_file
from xml.etree import ElementTree

import mujoco
import numpy as np
import numpy.typing as npt

from famle_envs.engines.mujoco_model import LINK_FRICTION, Contacts, compile_model
from famle_envs.engines.mujoco_pictures import Pictures
from famle_envs.engines.world import (
    DEFAULT_GAIN,
    FAULTY_COLOUR,
    GRAVITY,
    HOLDING_TORQUE,
    Array,
    Body,
    Camera,
    Marker,
    Point,
    Quaternion,
    Steps,
)

__all__ = ["MujocoWorld"]

_ERROR_REDUCTION = 0.2  # PyBullet's
_MOTOR_RIGIDITY, _LOCK_RIGIDITY = 0.95, 0.999  # of constraints, where 1 would have no give at all
_FRICTION_RIGIDITY = 10.0  # times that of the pressure; with MuJoCo's own 1, feet creep
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class MujocoWorld:
    """A :class:`~famle_envs.engines.world.World`, which documents the methods, of a MuJoCo model.

    Attributes:
        model: The ``mujoco.MjModel``.
        data: Its ``mujoco.MjData``.
    """

    def __init__(self, body: Body, steps: Steps, marker: Marker | None) -> None:
        with as_file(body.urdf) as file:
            description = ElementTree.parse(file).getroot()
            self.model = compile_model(description, file.parent, body, marker)
        self.data = mujoco.MjData(self.model)
        self._set_laws(steps)
        self._substeps = steps.substeps
        self._base = int(self.model.body_rootid[-1])
        joints = np.array([self.model.joint(name).id for name in body.joints])
        self._angle_at, self._speed_at = self.model.jnt_qposadr[joints], self.model.jnt_dofadr[joints]
        self._link_of_joint = self.model.jnt_bodyid[joints]
        limits = np.where(self.model.jnt_limited[joints] != 0, self.model.jnt_range[joints].T, [[-np.inf], [np.inf]])
        self.joint_limits: Array = limits
        self._targets, self._gains, self._speeds = np.zeros((3, len(joints)))
        self._bounds: Array = np.zeros(len(joints))
        self._driven = np.empty(0, dtype=np.intp)
        names = ("body_mass", "body_inertia", "dof_damping", "geom_rgba")
        self._as_built = {name: getattr(self.model, name).copy() for name in names}
        self._contacts = Contacts(description, self.model)
        self._pictures: Pictures | None = None
        self.set_floor(LINK_FRICTION)
        for name, angle in body.start_angles.items():
            self.data.joint(name).qpos[:] = angle
        self._start = np.empty(mujoco.mj_stateSize(self.model, _STATE))

    def _set_laws(self, steps: Steps) -> None:
        model, option = self.model, self.model.opt
        option.timestep = steps.time_step / steps.substeps
        option.gravity[:] = (0.0, 0.0, -GRAVITY)
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = _FRICTION_RIGIDITY
        # Damping within the step would take from a motor what its constraint has given, and a robot that explodes
        # should be seen to do so, and not be back at its start.
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        law = (2.0 * option.timestep, 1.0 / math.sqrt(4.0 * _ERROR_REDUCTION))
        model.eq_solref[:], model.jnt_solref[:], model.geom_solref[:] = law, law, law

    def set_start(self) -> None:
        mujoco.mj_getState(self.model, self.data, self._start, _STATE)

    def restart(self) -> None:
        mujoco.mj_setState(self.model, self.data, self._start, _STATE)

    def simulate(self, calls: int = 1) -> None:
        for _ in range(calls):
            if len(self._driven):
                self._step_with_motors()
            else:
                mujoco.mj_step(self.model, self.data, nstep=self._substeps)
            self.data.qfrc_applied[:] = 0.0

    def _step_with_motors(self) -> None:
        """Lets a call pass in which each motor is friction, of a bounded torque, against what has its wanted speed."""
        model, data, motors, dt = self.model, self.data, self._driven, self.model.opt.timestep
        angle_at, speed_at = self._angle_at[motors], self._speed_at[motors]
        targets, gains, speeds = self._targets[motors], self._gains[motors], self._speeds[motors]
        for _ in range(self._substeps):
            mujoco.mj_step1(model, data)
            wanted = speeds + gains * (targets - data.qpos[angle_at]) / dt
            data.efc_aref[data.ne : data.ne + data.nf] = (wanted - data.qvel[speed_at]) / dt
            mujoco.mj_step2(model, data)

    def close(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
            self._pictures = None

    def joint_states(self) -> tuple[Array, Array]:
        return self.data.qpos[self._angle_at], self.data.qvel[self._speed_at]

    def base_pose(self) -> tuple[Point, Quaternion]:
        x, y, z, qw, qx, qy, qz = self.data.qpos[:7].tolist()
        return (x, y, z), (qx, qy, qz, qw)

    def base_velocity(self) -> tuple[Point, Point]:
        turning = np.empty(3)
        mujoco.mju_rotVecQuat(turning, self.data.qvel[3:6], self.data.qpos[3:7])  # MuJoCo's is in the base's axes
        (vx, vy, vz), (wx, wy, wz) = self.data.qvel[:3].tolist(), turning.tolist()
        return (vx, vy, vz), (wx, wy, wz)

    def link_position(self, link: str) -> Point:
        mujoco.mj_kinematics(self.model, self.data)  # which a step does before it moves on
        x, y, z = self.data.body(link).xpos.tolist()
        return x, y, z

    def place_joints(self, angles: Array) -> None:
        self.data.qpos[self._angle_at] = angles
        self.data.qvel[self._speed_at] = 0.0

    def release(self) -> None:
        self._set_bounds(np.zeros(len(self._speed_at)))

    def apply_torques(self, torques: Array) -> None:
        self.data.qfrc_applied[self._speed_at] = torques

    def turn(self, speeds: Array, torque: float) -> None:
        self._speeds[:], self._gains[:] = speeds, 0.0
        self._set_bounds(np.full(len(speeds), torque))

    def servo(self, angles: Array, torques: Array, gain: float = DEFAULT_GAIN) -> None:
        self._speeds[:], self._gains[:], self._targets[:] = 0.0, gain, angles
        self._set_bounds(torques)

    def hold(self, angles: Mapping[int, float]) -> None:
        joints, bounds = list(angles), self._bounds.copy()
        self._speeds[joints], self._gains[joints], self._targets[joints] = 0.0, DEFAULT_GAIN, list(angles.values())
        bounds[joints] = HOLDING_TORQUE
        self._set_bounds(bounds)

    def _set_bounds(self, torques: Array) -> None:
        if (torques == self._bounds).all():
            return
        self._bounds = torques.copy()
        # PyBullet lets a motor give in each substep the impulse that its torque has in a whole call.
        self.model.dof_frictionloss[self._speed_at] = self._substeps * torques
        rigidity = np.where(torques < HOLDING_TORQUE, _MOTOR_RIGIDITY, _LOCK_RIGIDITY)
        self.model.dof_solimp[self._speed_at, :2] = rigidity[:, None]
        order = np.argsort(self._speed_at)  # of the model's frictions
        self._driven = order[torques[order] > 0.0]

    def set_floor(self, friction: float, stiffness: float = 0.0, damping: float = 0.0) -> None:
        self._floor = friction, stiffness, damping
        self._contacts.apply(self.model, *self._floor)

    def scale_masses(self, base: float, links: float) -> None:
        factor = np.full(self.model.nbody, links)
        factor[self._base] = base
        self.model.body_mass[:] = factor * self._as_built["body_mass"]
        self.model.body_inertia[:] = factor[:, None] * self._as_built["body_inertia"]
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))  # which would move the robot in its own data
        self._contacts.apply(self.model, *self._floor)

    def add_damping(self, damping: float) -> None:
        self.model.dof_damping[self._speed_at] = self._as_built["dof_damping"][self._speed_at] + damping

    def paint(self, joints: frozenset[int]) -> None:
        faulty = np.isin(self.model.geom_bodyid, self._link_of_joint[list(joints)])
        self.model.geom_rgba[:] = np.where(faulty[:, None], FAULTY_COLOUR, self._as_built["geom_rgba"])

    def picture(self, camera: Camera) -> npt.NDArray[np.uint8]:
        if self._pictures is None:
            self._pictures = Pictures(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        return self._pictures.take(self.model, self.data, camera)
