"""Robots in PyBullet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import as_file, files
from typing import Any

import numpy as np
import numpy.typing as npt
import pybullet

from famle_envs.engines.world import (
    DEFAULT_GAIN,
    FAULTY_COLOUR,
    FIELD_OF_VIEW,
    GRAVITY,
    HOLDING_TORQUE,
    MARKER_COLOUR,
    PICTURE_SIZE,
    Array,
    Body,
    Camera,
    Marker,
    Point,
    Quaternion,
    Steps,
)

__all__ = ["BulletWorld"]

_OWN_DESCRIPTIONS = {"minitaur.urdf": files("pybullet_data") / "quadruped/minitaur.urdf"}
"""Robots that PyBullet describes itself."""
_INERTIA_OF_SHAPES = {"minitaur.urdf", "reacher.urdf"}
"""Robots whose inertias PyBullet computes from their shapes, whatever the description says."""
_BASE = -1


class BulletWorld:
    """A :class:`~famle_envs.engines.world.World`, which documents the methods, in a PyBullet server of its own.

    Attributes:
        client: The server.
        robot: The robot in it.
        joints: PyBullet's indices of the motorised joints.
    """

    def __init__(self, body: Body, steps: Steps, marker: Marker | None) -> None:
        client = pybullet.connect(pybullet.DIRECT)
        if client < 0:
            raise RuntimeError("PyBullet gives no more physics worlds; close() environments that are not needed.")
        self.client = client
        # Sleeping and unordered contact pairs would make a run depend on the runs before it.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=steps.time_step,
            numSubSteps=steps.substeps if steps.substeps > 1 else 0,
            numSolverIterations=steps.solver_iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        if not body.fixed:
            plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
            self._floor = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
        self.robot = self._load(body)
        self._index, self._links = self._read_names()
        self.joints = [self._index[name] for name in body.joints]
        self._put_together(body)
        if marker is not None:
            self._show(marker)
        self.joint_limits = self._read_joint_limits()
        self._as_built = {
            link: pybullet.getDynamicsInfo(self.robot, link, physicsClientId=client)
            for link in (_BASE, *self._links.values())
        }
        self._base_in_mass = _frame_in_mass(self._as_built[_BASE])
        self._damping_as_built = [
            pybullet.getJointInfo(self.robot, joint, physicsClientId=client)[6] for joint in self.joints
        ]
        shapes = pybullet.getVisualShapeData(self.robot, physicsClientId=client)
        links = [shape[1] for shape in shapes]
        # (link, index among the link's shapes): colour
        self._colours = {(link, links[:i].count(link)): shapes[i][7] for i, link in enumerate(links)}

    def _load(self, body: Body) -> int:
        flags = 0 if body.description in _INERTIA_OF_SHAPES else pybullet.URDF_USE_INERTIA_FROM_FILE
        with as_file(_OWN_DESCRIPTIONS.get(body.description) or body.urdf) as path:
            robot = pybullet.loadURDF(
                str(path),
                (0.0, 0.0, body.height),
                useFixedBase=body.fixed,
                flags=flags,
                physicsClientId=self.client,
            )
        return int(robot)

    def _read_names(self) -> tuple[dict[str, int], dict[str, int]]:
        """Joints and links by their names; a joint has the index of the link behind it."""
        n = pybullet.getNumJoints(self.robot, physicsClientId=self.client)
        info = [pybullet.getJointInfo(self.robot, joint, physicsClientId=self.client) for joint in range(n)]
        return {row[1].decode(): row[0] for row in info}, {row[12].decode(): row[0] for row in info}

    def _put_together(self, body: Body) -> None:
        for name, angle in body.start_angles.items():
            pybullet.resetJointState(self.robot, self._index[name], angle, physicsClientId=self.client)
            # A joint has a motor of its own, which would brake it.
            if name not in body.joints:
                pybullet.setJointMotorControl2(
                    self.robot,
                    self._index[name],
                    pybullet.VELOCITY_CONTROL,
                    force=0.0,
                    physicsClientId=self.client,
                )
        for (one, its_point), (other, other_point) in body.loops:
            links = (self.robot, self._links[one], self.robot, self._links[other])
            free_axis, kind = (0.0, 0.0, 0.0), pybullet.JOINT_POINT2POINT
            pybullet.createConstraint(*links, kind, free_axis, its_point, other_point, physicsClientId=self.client)

    def _show(self, marker: Marker) -> None:
        size: dict[str, Any] = {"radius": marker.radius, "rgbaColor": MARKER_COLOUR, "physicsClientId": self.client}
        if marker.height:
            shape = pybullet.createVisualShape(pybullet.GEOM_CYLINDER, length=marker.height, **size)
        else:
            shape = pybullet.createVisualShape(pybullet.GEOM_SPHERE, **size)
        pybullet.createMultiBody(baseVisualShapeIndex=shape, basePosition=marker.position, physicsClientId=self.client)

    def _read_joint_limits(self) -> Array:
        info = [pybullet.getJointInfo(self.robot, joint, physicsClientId=self.client) for joint in self.joints]
        # PyBullet says "no limit" by a lower end above the upper one.
        ends = [(lower, upper) if lower <= upper else (-np.inf, np.inf) for lower, upper in (row[8:10] for row in info)]
        return np.array(ends).T

    def set_start(self) -> None:
        self._start = pybullet.saveState(physicsClientId=self.client)

    def restart(self) -> None:
        pybullet.restoreState(self._start, physicsClientId=self.client)

    def simulate(self, calls: int = 1) -> None:
        for _ in range(calls):
            pybullet.stepSimulation(physicsClientId=self.client)

    def close(self) -> None:
        pybullet.disconnect(physicsClientId=self.client)

    def joint_states(self) -> tuple[Array, Array]:
        states = pybullet.getJointStates(self.robot, self.joints, physicsClientId=self.client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def base_pose(self) -> tuple[Point, Quaternion]:
        position, quaternion = pybullet.getBasePositionAndOrientation(self.robot, physicsClientId=self.client)
        if self._base_in_mass is not None:
            position, quaternion = pybullet.multiplyTransforms(position, quaternion, *self._base_in_mass)
        return position, quaternion

    def base_velocity(self) -> tuple[Point, Point]:
        velocity, angular_velocity = pybullet.getBaseVelocity(self.robot, physicsClientId=self.client)
        return velocity, angular_velocity

    def link_position(self, link: str) -> Point:
        state = pybullet.getLinkState(
            self.robot, self._links[link], computeForwardKinematics=True, physicsClientId=self.client
        )
        position: Point = state[4]
        return position

    def place_joints(self, angles: Array) -> None:
        for joint, angle in zip(self.joints, angles.tolist(), strict=True):
            pybullet.resetJointState(self.robot, joint, angle, physicsClientId=self.client)

    def release(self) -> None:
        self._command(self.joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * len(self.joints))

    def apply_torques(self, torques: Array) -> None:
        self._command(self.joints, pybullet.TORQUE_CONTROL, forces=torques.tolist())

    def turn(self, speeds: Array, torque: float) -> None:
        torques = [torque] * len(self.joints)
        self._command(self.joints, pybullet.VELOCITY_CONTROL, targetVelocities=speeds.tolist(), forces=torques)

    def servo(self, angles: Array, torques: Array, gain: float = DEFAULT_GAIN) -> None:
        gains = [gain] * len(self.joints)
        self._command(
            self.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=angles.tolist(),
            forces=torques.tolist(),
            positionGains=gains,
        )

    def hold(self, angles: Mapping[int, float]) -> None:
        joints, torques = [self.joints[joint] for joint in angles], [HOLDING_TORQUE] * len(angles)
        self._command(joints, pybullet.POSITION_CONTROL, targetPositions=list(angles.values()), forces=torques)

    def _command(self, joints: list[int], mode: int, **targets: list[float]) -> None:
        pybullet.setJointMotorControlArray(self.robot, joints, mode, physicsClientId=self.client, **targets)

    def set_floor(self, friction: float, stiffness: float = 0.0, damping: float = 0.0) -> None:
        self._change(self._floor, _BASE, lateralFriction=friction)
        if stiffness:
            self._change(self._floor, _BASE, contactStiffness=stiffness, contactDamping=damping)

    def scale_masses(self, base: float, links: float) -> None:
        for link, built in self._as_built.items():
            factor = base if link == _BASE else links
            self._change(self.robot, link, mass=factor * built[0])
            self._change(self.robot, link, localInertiaDiagonal=[factor * value for value in built[2]])

    def add_damping(self, damping: float) -> None:
        for joint, built in zip(self.joints, self._damping_as_built, strict=True):
            self._change(self.robot, joint, jointDamping=built + damping)

    def _change(self, body: int, link: int, **dynamics: Any) -> None:
        pybullet.changeDynamics(body, link, physicsClientId=self.client, **dynamics)

    def paint(self, joints: frozenset[int]) -> None:
        faulty = {self.joints[joint] for joint in joints}
        for (link, shape), colour in self._colours.items():
            rgba = FAULTY_COLOUR if link in faulty else colour
            pybullet.changeVisualShape(self.robot, link, shape, rgbaColor=rgba, physicsClientId=self.client)

    def picture(self, camera: Camera) -> npt.NDArray[np.uint8]:
        view = pybullet.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=camera.target,
            distance=camera.distance,
            yaw=camera.yaw,
            pitch=camera.pitch,
            roll=0,
            upAxisIndex=2,
        )
        projection = pybullet.computeProjectionMatrixFOV(fov=FIELD_OF_VIEW, aspect=1.0, nearVal=0.1, farVal=100.0)
        _, _, pixels, _, _ = pybullet.getCameraImage(
            PICTURE_SIZE,
            PICTURE_SIZE,
            view,
            projection,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        return np.asarray(pixels, dtype=np.uint8).reshape(PICTURE_SIZE, PICTURE_SIZE, 4)[:, :, :3].copy()


def _frame_in_mass(dynamics: Sequence[Any]) -> tuple[Point, Quaternion] | None:
    """A link's frame as seen from its centre of mass and principal axes, of which PyBullet tells; None where all agree.

    Args:
        dynamics: What ``getDynamicsInfo`` says of the link.
    """
    centre, axes = dynamics[3:5]
    if (*centre, *axes) == (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0):
        return None
    position, quaternion = pybullet.invertTransform(centre, axes)
    return position, quaternion
