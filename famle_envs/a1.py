"""The Unitree A1, a robot that can be bought, on its way to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import ClassVar

import numpy as np

from famle_envs import quadruped
from famle_envs.engines.world import Body
from famle_envs.goal_walker import LEGS, GoalWalkerEnv
from famle_envs.profile import Profile
from famle_envs.situation import Situation

__all__ = ["HELD_OUT", "A1Env"]

_JOINTS = tuple(f"{leg}_{joint}_joint" for leg, joint in product(("RL", "FL", "FR", "RR"), ("hip", "upper", "lower")))
_SPREAD = np.array([0.15, 0.15, -0.15, -0.15])  # of each hip at rest, outwards (rad)
_BEND = 0.9  # of a thigh at rest; the shank bends back twice as far, so that the foot stays below the hip (rad)
_REST = np.kron(_SPREAD, [1.0, 0.0, 0.0]) + np.tile([0.0, _BEND, -2.0 * _BEND], len(LEGS))
_FULL_SWING = 0.4  # of a thigh, where the gait says 1 (rad)
_FULL_LIFT = 0.3  # the same (rad)
_FULL_TURN = 0.25  # of a hip, where the swings of the two legs of a diagonal differ by 1, as in a turn (rad)
_ROUND = np.array([[-1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])
"""Sense in which the swing of each leg turns each hip, (4, 4), so that in a turn the feet go round the trunk."""
_START_HEIGHT = 0.27

HELD_OUT = replace(quadruped.HELD_OUT, motor_strength=0.5)
"""The A1 outside the simulator: as the quadruped, with motors that can carry it."""


class A1Env(GoalWalkerEnv):
    """``FamleA1-v0``: the A1 of PyBullet's models, 12.5 kg on four legs of three motors each, one gait a second.

    Masses, lengths and meshes are read from the package ``pybullet_data``, for each engine. A leg has a hip that moves
    it sideways, a thigh and a shank. At full step the robot walks about 0.35 m in a second; hips move where it turns.
    Action, observation, reward, episode and arguments are those of :class:`GoalWalkerEnv`, and so are the situations.

    The presets name three more: ``"weak motors"``, with 0.3 of their torque; ``"payload"``, 4.7 kg and so as much again
    as the trunk; and ``"slippery floor"``, with 0.2 of the friction.

    Raises:
        gymnasium.error.DependencyNotInstalled: ``pybullet_data`` is not installed; and as :class:`RobotEnv`.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> env = gym.make("FamleA1-v0", situation="front left leg blocked + payload", profile="held-out")
        >>> obs, info = env.reset(seed=0)
        >>> info["is_success"]
        False
        >>> env.close()
    """

    body = Body(
        "a1/a1.urdf",
        joints=_JOINTS,
        height=_START_HEIGHT,
        start_angles=dict(zip(_JOINTS, _REST.tolist(), strict=True)),
        package="pybullet_data",
    )
    joints = body.joints
    floor_friction = 1.6
    motor_torque = 33.5 / GoalWalkerEnv.substeps  # see World: each physics step may give what a whole call has
    motor_speed = 21.0
    rest_angles = _REST
    swing_angles = _FULL_SWING * np.kron(np.eye(len(LEGS)), [0.0, 1.0, 0.0]) + np.kron(
        _FULL_TURN * _ROUND, [1.0, 0.0, 0.0]
    )
    lift_angles = _FULL_LIFT * np.kron(np.eye(len(LEGS)), [0.0, 1.0, -2.0])
    profiles: ClassVar[Mapping[str, Profile]] = {HELD_OUT.name: HELD_OUT}
    presets: ClassVar[Mapping[str, Situation]] = {
        **GoalWalkerEnv.presets,
        "weak motors": Situation(motor_strength=(0.3,) * len(_JOINTS), name="weak motors"),
        "payload": Situation(base_mass=2.0, name="payload"),
        "slippery floor": Situation(friction=0.2, name="slippery floor"),
    }
