"""A four-legged robot of twelve joints that has to reach a goal (the paper's section V-C)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import ClassVar

import numpy as np

from famle_envs.engines.world import Body
from famle_envs.goal_walker import LEGS, GoalWalkerEnv, blocked_leg
from famle_envs.profile import Profile

__all__ = ["HELD_OUT", "LEGS", "QuadrupedEnv", "blocked_leg"]

_JOINTS = tuple(f"{leg.replace(' ', '_')}_{joint}" for leg, joint in product(LEGS, ("hip", "thigh", "shank")))
_FULL_SWING = math.pi / 4  # of a joint, where the gait says 1 (rad)
_BACKWARDS = np.diag([1.0, 1.0, -1.0, -1.0])  # sense in which a hip turns its leg backwards
_START_HEIGHT = 0.142

HELD_OUT = Profile(
    name="held-out",
    motor_strength=0.03,
    motor_speed=0.4,
    joint_damping=0.02,
    zero_errors=(0.15, -0.08, 0.12, -0.12, 0.09, -0.15, 0.08, 0.15, -0.09, 0.18, -0.12, 0.08),
    backlash=0.03,
    latency=0.05,
    base_mass=1.4,
    leg_mass=1.15,
    floor_friction=0.4,
    contact_stiffness=5000.0,
    contact_damping=50.0,
    position_noise=0.01,
    orientation_noise=0.03,
)
"""The quadruped outside the simulator."""


class QuadrupedEnv(GoalWalkerEnv):
    """``FamleQuadruped-v0``: a trunk of 0.24 m on four legs of three servos each, one gait a second.

    A leg has a hip that turns about the vertical and two joints that lift the foot. At full step the robot walks about
    0.25 m in a second. Action, observation, reward, episode, situations and arguments are those of
    :class:`GoalWalkerEnv`.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> env = gym.make("FamleQuadruped-v0", situation="front left leg blocked", profile="held-out")
        >>> obs, info = env.reset(seed=0)
        >>> info["is_success"]
        False
        >>> env.close()
    """

    body = Body("quadruped.urdf", joints=_JOINTS, height=_START_HEIGHT)
    joints = body.joints
    floor_friction = 1.0
    motor_torque = 30.0
    motor_speed = 7.0
    rest_angles = np.zeros(len(_JOINTS))
    swing_angles = _FULL_SWING * np.kron(_BACKWARDS, [1.0, 0.0, 0.0])
    lift_angles = _FULL_SWING * np.kron(np.eye(len(LEGS)), [0.0, 1.0, 1.0])
    profiles: ClassVar[Mapping[str, Profile]] = {HELD_OUT.name: HELD_OUT}
