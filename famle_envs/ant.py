"""A four-legged robot of eight torque-controlled joints that has to run forwards (the paper's section V-B)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from typing import Any, ClassVar, Literal

import numpy as np
from gymnasium import spaces

from famle_envs.arguments import number_within
from famle_envs.engines.world import Array, Body, Camera
from famle_envs.robot_env import RobotEnv
from famle_envs.situation import Situation

__all__ = ["AntEnv"]

N_JOINTS = 8
MAX_TORQUE = 1000.0  # of a motor at action 1 (N m)
FLOOR_FRICTION = 0.8
FALLEN_HEIGHT = 0.26  # of the torso's centre; its radius is 0.25 (m)
CONTROL_RATE = 60.6  # of the authors' code (Hz); the paper says 100
_SUBSTEPS = 4  # physics steps a control step
_LEGS = ("front_left", "back_left", "back_right", "front_right")
_START_HEIGHT = 0.5  # feet just above the floor (m)
_START_ANGLES = (0.0, math.pi / 4) * (N_JOINTS // 2)
_START_NOISE = 0.1  # of the joint angles (rad)
_QUATERNION_X, _QUATERNION_Y, _X_VELOCITY = 1, 2, 13
_OBS_DIM = 27


def _all_but(joint: int) -> tuple[float, ...]:
    """Gains of an ant with one dead joint."""
    return tuple(float(i != joint) for i in range(N_JOINTS))


_TRAINING = (
    Situation(name="intact"),
    *(Situation(motor_gain=_all_but(joint), name=f"joint {joint} dead") for joint in range(N_JOINTS)),
    *(
        Situation(orientation_error=math.radians(degrees), name=f"yaw sensor off by {degrees} deg")
        for degrees in range(30, 360, 30)
    ),
)


class AntEnv(RobotEnv):
    """``FamleAnt-v0``: four legs of a hip (even joints) and an ankle (odd joints) each, at 60.6 Hz.

    The legs are front left, back left, back right and front right; forwards is +x, left is +y.

    ## Action
    (8,) in [-1, 1]: joint torques in units of 1,000 N m.

    ## Observation
    (27,): height of the torso in m; its orientation as a unit quaternion (x, y, z, w) with w >= 0; 8 joint angles in
    rad (hips -0.524 to 0.524, ankles 0.524 to 1.047, downwards where positive); the torso's velocity in m/s and
    angular velocity in rad/s, in world axes; 8 joint velocities in rad/s.

    ## Reward
    The torso's velocity along the world's x axis in m/s. Solved: a return above 800 in 1,000 steps.

    ## Episode
    1,000 steps. A fallen ant (torso below 0.26 m) goes on, but with ``terminate_when_fallen``. The joint angles at the
    start are random, +-0.1 rad around the middle of their ranges.

    ## Situations
    ``motor_gain`` (weak, dead or reversed), ``locked_joints``, ``orientation_error`` (of the measured yaw; velocities
    are measured as they are) and ``friction`` (of the floor). :attr:`training_situations` holds the paper's 20.
    The paper speaks of an error in the measured orientation, which is added to the yaw here. The authors' public code
    gives the error instead of the yaw, so that the robot never sees where it is heading; see ``yaw_sensor``.

    Args:
        control_rate: Control steps per second, of four physics steps each: 60.6 as in the authors' code, or 100 as
            in the paper.
        terminate_when_fallen: Whether a fall ends the episode.
        yaw_sensor: ``"offset"`` measures the yaw plus the ``orientation_error``, ``"stuck"`` that error alone whatever
            the yaw is, which is 0 for the intact robot: the authors' public code.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Raises:
        ValueError: The control rate is outside 50 to 500 Hz, or the yaw sensor is unknown; and as :class:`RobotEnv`.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> env = gym.make("FamleAnt-v0", situation="joint 3 dead, yaw sensor off by 40 deg")
        >>> obs, info = env.reset(seed=0)
        >>> obs.shape
        (27,)
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 60}  # noqa: RUF012 (Gymnasium's own type)

    body = Body(
        "ant.urdf",
        joints=tuple(f"{leg}_{joint}" for leg, joint in product(_LEGS, ("hip", "ankle"))),
        height=_START_HEIGHT,
    )
    joints = body.joints
    supported_faults = frozenset({"motor_gain", "locked_joints", "orientation_error", "friction"})
    time_step = 1.0 / CONTROL_RATE
    physics_steps = 1
    substeps = _SUBSTEPS
    solver_iterations = 50
    quaternion_dims = (1, 2, 3, 4)
    task_arguments = RobotEnv.task_arguments | {"terminate_when_fallen"}
    training_situations = _TRAINING
    presets: ClassVar[Mapping[str, Situation]] = {situation.name: situation for situation in _TRAINING} | {
        "paper": Situation(motor_gain=_all_but(2), orientation_error=math.radians(45), name="paper")
    }

    def __init__(
        self,
        *,
        control_rate: float = CONTROL_RATE,
        terminate_when_fallen: bool = False,
        yaw_sensor: Literal["offset", "stuck"] = "offset",
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        if yaw_sensor not in ("offset", "stuck"):
            raise ValueError(f'yaw_sensor must be "offset" or "stuck", got {yaw_sensor!r}.')
        self.yaw_sensor = yaw_sensor
        control_rate = number_within("control_rate", control_rate, 50.0, 500.0, "Hz")
        self.time_step = 1.0 / control_rate  # type: ignore[misc]  # each ant has a rate of its own
        self.metadata = {**self.metadata, "render_fps": round(control_rate)}
        self.terminate_when_fallen = terminate_when_fallen
        self.observation_space = spaces.Box(-np.inf, np.inf, (_OBS_DIM,))
        self.action_space = spaces.Box(-1.0, 1.0, (N_JOINTS,))
        super().__init__(situation=situation, engine=engine, render_mode=render_mode)

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The velocity along x after each transition.

        Args:
            obs: Observations, (..., 27); a NumPy array or a torch tensor. Not used.
            action: Actions, (..., 8). Not used.
            next_obs: Observations one step later, (..., 27).

        Returns:
            Rewards in m/s, (...), in the type of ``next_obs``.
        """
        return next_obs[..., _X_VELOCITY]

    def planning_reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """What a planner should look for: the reward, less 4 (0.8 - u) m/s where the ant tips over.

        u is the cosine of the torso's tilt, which no error of the yaw sensor changes. An ant on its back does not get
        up again, and a planner that looks a third of a second ahead learns that too late.

        Args:
            obs: Observations, (..., 27). Not used.
            action: Actions, (..., 8). Not used.
            next_obs: Observations one step later, (..., 27); a NumPy array or a torch tensor.
        """
        x, y = next_obs[..., _QUATERNION_X], next_obs[..., _QUATERNION_Y]
        upright = 1.0 - 2.0 * (x * x + y * y)
        return self.reward_fn(obs, action, next_obs) - 4.0 * (0.8 - upright).clip(min=0.0)

    def survival_reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The reward, less 2 m/s where the torso is below 0.26 m; the planner of the authors' public code maximises it.

        Args:
            obs: Observations, (..., 27). Not used.
            action: Actions, (..., 8). Not used.
            next_obs: Observations one step later, (..., 27); a NumPy array or a torch tensor.
        """
        return self.reward_fn(obs, action, next_obs) - 2.0 * (next_obs[..., 0] < FALLEN_HEIGHT)

    @classmethod
    def sample_situation(cls, rng: np.random.Generator) -> Situation:
        """Draws an unseen situation of the paper's kind: a dead joint and an error of the measured yaw together.

        Args:
            rng: The generator to draw from. The error is uniform in all directions, but at least 15 degrees.
        """
        joint = int(rng.integers(N_JOINTS))
        yaw = rng.uniform(math.radians(15), math.radians(345))
        return Situation(motor_gain=_all_but(joint), orientation_error=yaw)

    def _perturb_start(self) -> None:
        noise = self.np_random.uniform(-_START_NOISE, _START_NOISE, N_JOINTS)
        self.world.place_joints(noise + _START_ANGLES)

    def _apply_situation(self) -> None:
        super()._apply_situation()
        # A joint has a motor of its own, which brakes it from the start, or holds it where it was locked before.
        self.world.release()
        self._torque = MAX_TORQUE * np.array(self._situation.motor_gain)
        self.world.set_floor(FLOOR_FRICTION * self._situation.friction)

    def actuate(self, action: Array) -> None:
        """Sets the motors for one control step."""
        self.world.apply_torques(self._torque * action)

    def observe(self) -> Array:
        """Returns the observation as the sensors give it."""
        position, quaternion = self.world.base_pose()
        velocity, angular_velocity = self.world.base_velocity()
        angles, speeds = self.world.joint_states()
        return np.array(
            (position[2], *self._measured(*quaternion), *angles, *velocity, *angular_velocity, *speeds),
            dtype=np.float32,
        )

    def _measured(self, x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
        """The quaternion turned about the vertical by what is wrong with the yaw sensor, with w >= 0."""
        turn = self._situation.orientation_error
        if self.yaw_sensor == "stuck":
            turn -= math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        c, s = math.cos(0.5 * turn), math.sin(0.5 * turn)
        turned = (c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z)
        return turned if turned[3] >= 0.0 else (-turned[0], -turned[1], -turned[2], -turned[3])

    def _has_ended(self, obs: Array) -> bool:
        return self.terminate_when_fallen and bool(obs[0] < FALLEN_HEIGHT)

    def _camera(self) -> Camera:
        position, _ = self.world.base_pose()
        return Camera(position, distance=3.0, yaw=15.0, pitch=-25.0)
