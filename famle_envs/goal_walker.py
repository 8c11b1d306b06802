"""Robots of four legs of three joints each that walk to a goal (the task of the paper's section V-C)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from famle_envs.arguments import finite_point, number_within
from famle_envs.engines.world import Array, Marker
from famle_envs.gait_env import GaitEnv
from famle_envs.profile import SIMULATOR, Profile
from famle_envs.situation import Situation

__all__ = ["LEGS", "GoalWalkerEnv", "blocked_leg"]

LEGS = ("back left", "front left", "front right", "back right")
_JOINTS_OF_A_LEG = 3


def blocked_leg(leg: int) -> Situation:
    """The situation of a leg that is blocked, counted as in :data:`LEGS`."""
    joints = range(_JOINTS_OF_A_LEG * leg, _JOINTS_OF_A_LEG * (leg + 1))
    return Situation(locked_joints=tuple(joints), name=f"{LEGS[leg]} leg blocked")


_TRAINING = (
    Situation(name="intact"),
    *(Situation(locked_joints=(joint,), name=f"joint {joint} locked") for joint in range(_JOINTS_OF_A_LEG * len(LEGS))),
    *(
        Situation(orientation_error=math.radians(degrees), name=f"yaw sensor off by {degrees} deg")
        for degrees in range(45, 360, 45)
    ),
)


class GoalWalkerEnv(GaitEnv):
    """Base of the robots that walk to a goal, one gait a second.

    Joints are counted leg by leg, in the order of :data:`LEGS`.

    ## Action
    (4,) in [-1, 1]: steer (right where positive), step (forwards where positive), extension and offset of the lift;
    see :func:`famle_envs.gaits.trot`.

    ## Observation
    (4,): x and y in m, sine and cosine of the measured yaw.

    ## Reward
    Metres by which the measured distance to the goal has become less.

    ## Episode
    It ends within ``success_radius`` of the goal, ``info["is_success"]``, or after 80 actions.

    ## Situations
    ``locked_joints`` (held at their angle at rest), ``motor_strength``, ``orientation_error``, ``friction`` and
    ``base_mass``. :attr:`training_situations` holds 20: intact, each joint blocked, and seven errors of the yaw. The
    presets name the four blocked legs too, and ``"paper"`` is a blocked leg and a yaw error of 30 degrees.

    Args:
        goal: x and y in m; the robot starts at the origin and looks along +x.
        success_radius: Distance from the goal that counts as reaching it, in m.
        profile: See :class:`GaitEnv`.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Raises:
        ValueError: The goal or the radius is no length in m; and as :class:`GaitEnv`.
    """

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

    @classmethod
    def sample_situation(cls, rng: np.random.Generator) -> Situation:
        """Draws an unseen situation of the paper's kind: a blocked leg and an error of the measured yaw together.

        Args:
            rng: The generator to draw from. The error is uniform in all directions, but at least 15 degrees.
        """
        leg, yaw = int(rng.integers(len(LEGS))), rng.uniform(math.radians(15), math.radians(345))
        return Situation(locked_joints=blocked_leg(leg).locked_joints, orientation_error=yaw)

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
