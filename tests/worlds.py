"""What tests read of a robot's world and do to it, in each engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from famle_envs.robot_env import RobotEnv

Array = npt.NDArray[Any]

LEVEL = (0.0, 0.0, 0.0, 1.0)


def place_of(env: RobotEnv) -> Array:
    """Where the base is, in m."""
    return np.array(env.world.base_pose()[0])


def joint_angles(env: RobotEnv) -> list[float]:
    return env.world.joint_states()[0].tolist()  # type: ignore[no-any-return]


def joint_speeds(env: RobotEnv) -> list[float]:
    return env.world.joint_states()[1].tolist()  # type: ignore[no-any-return]


def masses(env: RobotEnv) -> Array:
    """Of the base and of each link, in kg."""
    return np.array([mass for mass, _ in _dynamics(env)])


def inertias(env: RobotEnv) -> Array:
    """Of the base and of each link about its axes, (n, 3), in kg m^2."""
    return np.array([inertia for _, inertia in _dynamics(env)])


def momenta(env: RobotEnv) -> Array:
    """Of the base and of each link, (n, 3), in kg m/s."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        velocities = [pybullet.getBaseVelocity(world.robot, physicsClientId=world.client)[0]]
        for link in range(pybullet.getNumJoints(world.robot, physicsClientId=world.client)):
            state = pybullet.getLinkState(world.robot, link, computeLinkVelocity=True, physicsClientId=world.client)
            velocities.append(state[6])
    else:
        import mujoco

        mujoco.mj_forward(world.model, world.data)
        velocities, kind = [], mujoco.mjtObj.mjOBJ_BODY
        for link in range(1, world.model.nbody):
            turning_and_moving = np.empty(6)
            mujoco.mj_objectVelocity(world.model, world.data, kind, link, turning_and_moving, False)
            velocities.append(turning_and_moving[3:])
    return masses(env)[:, None] * np.array(velocities)


def point_of(env: RobotEnv, link: str, point: tuple[float, float, float]) -> Array:
    """Where a point in the frame of a link is in the world, in m."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        index = world._links[link]  # noqa: SLF001 (no name outside the world has a number)
        state = pybullet.getLinkState(world.robot, index, computeForwardKinematics=True, physicsClientId=world.client)
        return np.array(pybullet.multiplyTransforms(*state[4:6], point, LEVEL)[0])
    origin, frame = np.array(world.link_position(link)), world.data.body(link).xmat.reshape(3, 3)
    return np.array(origin + frame @ point)


def put(env: RobotEnv, place: tuple[float, float, float], quaternion: Any = LEVEL) -> None:
    """Moves the robot as a whole, at rest; x, y, z, w of the quaternion."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        pybullet.resetBasePositionAndOrientation(world.robot, place, quaternion, physicsClientId=world.client)
    else:
        x, y, z, w = quaternion
        world.data.qpos[:7] = (*place, w, x, y, z)
        world.data.qvel[:6] = 0.0


def push(env: RobotEnv, speed: float) -> None:
    """Gives the base a speed along x in m/s."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        pybullet.resetBaseVelocity(world.robot, (speed, 0, 0), (0, 0, 0), physicsClientId=world.client)
    else:
        world.data.qvel[:6] = (speed, 0, 0, 0, 0, 0)


def turn_joint(env: RobotEnv, joint: int, speed: float) -> None:
    """Puts a joint to its zero at a speed in rad/s."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        pybullet.resetJointState(world.robot, world.joints[joint], 0.0, speed, physicsClientId=world.client)
    else:
        state = world.data.joint(env.joints[joint])
        state.qpos[:], state.qvel[:] = 0.0, speed


def without_gravity(env: RobotEnv) -> None:
    """Makes the robot weightless."""
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        pybullet.setGravity(0.0, 0.0, 0.0, physicsClientId=world.client)
    else:
        world.model.opt.gravity[:] = 0.0


def _dynamics(env: RobotEnv) -> list[tuple[float, Any]]:
    world: Any = env.world
    if env.engine == "pybullet":
        import pybullet

        links = range(-1, pybullet.getNumJoints(world.robot, physicsClientId=world.client))
        rows = [pybullet.getDynamicsInfo(world.robot, link, physicsClientId=world.client) for link in links]
        return [(row[0], row[2]) for row in rows]
    return list(zip(world.model.body_mass[1:].copy(), world.model.body_inertia[1:].copy(), strict=True))
