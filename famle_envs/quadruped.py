"""A four-legged robot of twelve joints that has to reach a goal (the paper's section V-C)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from famle_envs.arguments import finite_point, number_within
from famle_envs.engines.world import Array, Body, Marker
from famle_envs.gait_env import GaitEnv
from famle_envs.profile import SIMULATOR, Profile
from famle_envs.situation import Situation

__all__ = ["HELD_OUT", "LEGS", "QuadrupedEnv"]

LEGS = ("back left", "front left", "front right", "back right")
_JOINTS = tuple(f"{leg.replace(' ', '_')}_{joint}" for leg, joint in product(LEGS, ("hip", "thigh", "shank")))
_JOINTS_OF_A_LEG = 3
_N_JOINTS = _JOINTS_OF_A_LEG * len(LEGS)
_FULL_SWING = math.pi / 4  # of a joint, where the gait says 1 (rad)
_BACKWARDS = np.array([1.0, 1.0, -1.0, -1.0])  # sense in which a hip turns its leg backwards
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


def blocked_leg(leg: int) -> Situation:
    """The situation of a leg that is blocked, counted as in :data:`LEGS`."""
    joints = range(_JOINTS_OF_A_LEG * leg, _JOINTS_OF_A_LEG * (leg + 1))
    return Situation(locked_joints=tuple(joints), name=f"{LEGS[leg]} leg blocked")


_TRAINING = (
    Situation(name="intact"),
    *(Situation(locked_joints=(joint,), name=f"joint {joint} locked") for joint in range(_N_JOINTS)),
    *(
        Situation(orientation_error=math.radians(degrees), name=f"yaw sensor off by {degrees} deg")
        for degrees in range(45, 360, 45)
    ),
)


class QuadrupedEnv(GaitEnv):
    """``FamleQuadruped-v0``: a trunk of 0.24 m on four legs of three servos each, one gait a second.

    A leg has a hip that turns about the vertical and two joints that lift the foot; joints are counted leg by leg, in
    the order of :data:`LEGS`.

    ## Action
    (4,) in [-1, 1]: steer (right where positive), step (forwards where positive), extension and offset of the lift;
    see :func:`famle_envs.gaits.trot`. At full step the robot walks about 0.25 m in a second.

    ## Observation
    (4,): x and y in m, sine and cosine of the measured yaw.

    ## Reward
    Metres by which the measured distance to the goal has become less.

    ## Episode
    It ends within ``success_radius`` of the goal, ``info["is_success"]``, or after 80 actions.

    ## Situations
    ``locked_joints`` (held at their angle at rest), ``orientation_error``, ``friction`` and ``base_mass``.
    :attr:`training_situations` holds 20: intact, each joint blocked, and seven errors of the yaw. The presets name the
    four blocked legs too, and ``"paper"`` is a blocked leg and a yaw error of 30 degrees.

    Args:
        goal: x and y in m; the robot starts at the origin and looks along +x.
        success_radius: Distance from the goal that counts as reaching it, in m.
        profile: See :class:`GaitEnv`.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Raises:
        ValueError: The goal or the radius is no length in m; and as :class:`GaitEnv`.

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
    rest_angles = np.zeros(_N_JOINTS)
    profiles: ClassVar[Mapping[str, Profile]] = {HELD_OUT.name: HELD_OUT}
    pose_dims = (0, 1, 2, 3)
    task_arguments = GaitEnv.task_arguments | {"goal", "success_radius"}
    training_situations = _TRAINING
    presets: ClassVar[Mapping[str, Situation]] = {
        situation.name: situation for situation in (*_TRAINING, *(blocked_leg(leg) for leg in range(len(LEGS))))
    } | {"paper": Situation(locked_joints=(9, 10, 11), orientation_error=math.radians(30), name="paper")}

    def __init__(
        self,
        *,
        goal: tuple[float, float] = (2.5, 0.0),
        success_radius: float = 0.25,
        profile: Profile | Mapping[str, Any] | str = SIMULATOR,
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.goal = finite_point("goal", goal)
        self.success_radius = number_within("success_radius", success_radius, 0.01, 100.0, "m")
        high = np.array([np.inf, np.inf, 1.0, 1.0], dtype=np.float32)
        self.observation_space = spaces.Box(-high, high)
        super().__init__(profile=profile, situation=situation, engine=engine, render_mode=render_mode)

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """|p - goal| - |p' - goal| of each transition.

        Args:
            obs: Observations, (..., 4); a NumPy array or a torch tensor.
            action: Actions, (..., 4). Not used.
            next_obs: Observations one gait later, (..., 4).

        Returns:
            Rewards in m, (...), in the type of ``next_obs``.
        """
        return self._distance(obs) - self._distance(next_obs)

    def planning_reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """What a planner should look for: -|p' - goal|, in m.

        A sum of progress is the same for each way to the goal within the horizon; a sum of distances is best for the
        shortest.

        Args:
            obs: Observations, (..., 4). Not used.
            action: Actions, (..., 4). Not used.
            next_obs: Observations one gait later, (..., 4); a NumPy array or a torch tensor.
        """
        return -self._distance(next_obs)

    def _distance(self, obs: Any) -> Any:
        dx, dy = obs[..., 0] - self.goal[0], obs[..., 1] - self.goal[1]
        return (dx * dx + dy * dy) ** 0.5

    def _joint_targets(self, swing: Array, lift: Array) -> Array:
        legs = np.stack([_BACKWARDS * swing, lift, lift], axis=2)
        return _FULL_SWING * legs.reshape(len(swing), _N_JOINTS)

    def observe(self) -> Array:
        """Returns the observation as the sensors give it."""
        (x, y, _), (_, _, yaw) = self._measured_pose()
        return np.array((x, y, math.sin(yaw), math.cos(yaw)), dtype=np.float32)

    def _is_success(self) -> bool:
        x, y, _ = self.position
        return math.hypot(x - self.goal[0], y - self.goal[1]) < self.success_radius

    def _has_ended(self, obs: Array) -> bool:
        return self._is_success()

    def _info(self) -> dict[str, Any]:
        return {**super()._info(), "is_success": self._is_success()}

    def _marker(self) -> Marker:
        return Marker((*self.goal, 0.0), radius=self.success_radius, height=0.002)
