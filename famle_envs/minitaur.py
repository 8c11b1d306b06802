"""A four-legged robot of eight direct-drive motors that has to learn to walk (the paper's section V-D)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from famle_envs.engines.world import Array, Body, Point
from famle_envs.gait_env import GaitEnv, wrapped
from famle_envs.profile import SIMULATOR, Profile
from famle_envs.situation import Situation

__all__ = ["HELD_OUT", "MinitaurEnv"]

_SIDES = tuple(f"{leg}{side}" for leg, side in product(("back_left", "front_left", "front_right", "back_right"), "RL"))
_LEG_SIDE = np.array([-1.0, -1.0, 1.0, 1.0])  # sense in which both motors of a leg lengthen it
_REST = math.pi / 2  # of a motor: the leg is half extended (rad)
_KNEE_AT_REST = 2.18
_FULL_SWING = 1.2  # of a leg, where the gait says 1 (rad)
_FULL_LIFT = 1.0  # of both motors of a leg, where the gait says 1 (rad)
_CLOSURE: tuple[Point, Point] = ((0.0, 0.005, 0.2), (0.0, 0.01, 0.2))  # where the shanks of a leg meet, in each (m)
_START_HEIGHT = 0.19
_FALLEN_TILT = math.cos(math.radians(50))


def _body() -> Body:
    motors = tuple(f"motor_{side}_joint" for side in _SIDES)
    angles: dict[str, float] = {}
    for side, motor, sense in zip(_SIDES, motors, np.repeat(_LEG_SIDE, 2).tolist(), strict=True):
        angles |= {motor: sense * _REST, f"knee_{side}_link": -sense * _KNEE_AT_REST}
    ends = [(f"lower_leg_{side}_link", _CLOSURE[i % 2]) for i, side in enumerate(_SIDES)]
    loops = tuple(zip(ends[::2], ends[1::2], strict=True))
    return Body("minitaur.urdf", motors, height=_START_HEIGHT, start_angles=angles, loops=loops)


HELD_OUT = Profile(
    name="held-out",
    motor_strength=0.6,
    motor_speed=0.8,
    joint_damping=0.02,
    zero_errors=(0.08, -0.05, -0.1, 0.03, 0.06, 0.1, -0.04, 0.07),
    backlash=0.02,
    latency=0.03,
    base_mass=1.3,
    leg_mass=1.15,
    floor_friction=0.4,
    contact_stiffness=10_000.0,
    contact_damping=100.0,
    position_noise=0.01,
    orientation_noise=0.02,
)
"""The Minitaur outside the simulator."""

_TRAINING = (
    Situation(name="intact"),
    *(
        Situation(friction=friction, base_mass=mass)
        for friction, mass in product((1.0, 0.5, 2.0), (1.0, 1.5, 2.0))
        if (friction, mass) != (1.0, 1.0)
    ),
)


class MinitaurEnv(GaitEnv):
    """``FamleMinitaur-v0``: the Minitaur of PyBullet's models, one gait a second.

    Each leg is a closed loop of four bars driven by two motors; motors are counted leg by leg: back left, front left,
    front right, back right.

    ## Action
    (4,) in [-1, 1]: steer (right where positive), step (forwards where positive), extension and offset of the lift;
    see :func:`famle_envs.gaits.trot`. At full step a leg swings by 0.6 rad to either side.

    ## Observation
    (6,): position of the body in m; its roll, pitch and yaw in rad, in [-pi, pi].

    ## Reward
    Metres walked along the world's x axis.

    ## Episode
    60 actions. It ends where the robot has fallen (tilted by 50 degrees).

    ## Situations
    ``friction`` and ``base_mass``, ``locked_joints`` (held at their angle at rest), ``motor_strength`` and
    ``orientation_error``.
    :attr:`training_situations` holds the paper's nine: friction x {0.5, 1, 2} and base mass x {1, 1.5, 2}.

    Args:
        profile: See :class:`GaitEnv`.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> env = gym.make("FamleMinitaur-v0", situation="friction x 0.5, base mass x 1.5")
        >>> obs, info = env.reset(seed=0)
        >>> obs.shape
        (6,)
        >>> env.close()
    """

    body = _body()
    joints = body.joints
    floor_friction = 1.0
    motor_torque = 5.0
    motor_speed = 6.0
    position_gain = 0.05
    rest_angles = _REST * np.repeat(_LEG_SIDE, 2)
    swing_angles = _FULL_SWING * np.kron(np.eye(len(_LEG_SIDE)), [-1.0, 1.0])
    lift_angles = -_FULL_LIFT * np.kron(np.diag(_LEG_SIDE), [1.0, 1.0])
    profiles: ClassVar[Mapping[str, Profile]] = {HELD_OUT.name: HELD_OUT}
    angle_dims = (3, 4)
    pose_dims = (0, 1, 5)
    training_situations = _TRAINING
    presets: ClassVar[Mapping[str, Situation]] = {situation.label: situation for situation in _TRAINING}

    def __init__(
        self,
        *,
        profile: Profile | Mapping[str, Any] | str = SIMULATOR,
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        high = np.array([np.inf, np.inf, np.inf, np.pi, np.pi, np.pi], dtype=np.float32)
        self.observation_space = spaces.Box(-high, high)
        super().__init__(profile=profile, situation=situation, engine=engine, render_mode=render_mode)

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The way along x of each transition, x' - x.

        Args:
            obs: Observations, (..., 6); a NumPy array or a torch tensor.
            action: Actions, (..., 4). Not used.
            next_obs: Observations one gait later, (..., 6).

        Returns:
            Rewards in m, (...), in the type of ``next_obs``.
        """
        return next_obs[..., 0] - obs[..., 0]

    def planning_reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """What a planner should look for: the reward, less a metre for each rad of roll or pitch beyond 0.15.

        Args:
            obs: Observations, (..., 6); a NumPy array or a torch tensor.
            action: Actions, (..., 4). Not used.
            next_obs: Observations one gait later, (..., 6).
        """
        tilt = (abs(next_obs[..., 3:5]) - 0.15).clip(min=0.0).sum(-1)
        return self.reward_fn(obs, action, next_obs) - tilt

    def observe(self) -> Array:
        """Returns the observation as the sensors give it."""
        position, angles = self._measured_pose()
        return np.array((*position, *(wrapped(angle) for angle in angles)), dtype=np.float32)

    def _has_ended(self, obs: Array) -> bool:
        _, (qx, qy, _, _) = self.world.base_pose()
        return 1.0 - 2.0 * (qx * qx + qy * qy) < _FALLEN_TILT
