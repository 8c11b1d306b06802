"""A 5-joint planar arm that has to bring its tip to a goal (the paper's section V-A)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from famle_envs.arguments import finite_point
from famle_envs.engines.world import Array, Body, Camera, Marker
from famle_envs.robot_env import RobotEnv
from famle_envs.situation import Situation

__all__ = ["ReacherEnv"]

N_JOINTS = 5
LINK_LENGTH = 0.3
MAX_SPEED = 0.7  # of a joint at action 1 (rad/s)
MAX_FORCE = 200.0  # of a motor (N m)
SENSED_SPEED = 10.0  # where the velocity sensors saturate (rad/s)
_TIP_X, _TIP_Y = 2 * N_JOINTS, 2 * N_JOINTS + 1


def _gain(joint: int, value: float) -> Situation:
    situation = Situation(motor_gain=tuple(value if i == joint else 1.0 for i in range(N_JOINTS)))
    return Situation.from_dict({**situation.to_dict(), "name": str(situation)})


_TRAINING = (
    Situation(name="intact"),
    *(_gain(joint, 0.0) for joint in range(N_JOINTS)),
    *(_gain(joint, -1.0) for joint in range(N_JOINTS)),
)


class ReacherEnv(RobotEnv):
    """``FamleReacher-v0``: a planar arm of five 0.3 m links with velocity-controlled joints, at 10 Hz.

    ## Action
    (5,) in [-1, 1]: joint velocity in units of 0.7 rad/s.

    ## Observation
    (12,): the 5 measured joint angles in [-pi, pi], the 5 joint velocities in rad/s, and the tip's x and y in m.
    The base joint turns without end, so that its angle jumps from pi to -pi; the others stop at +-1.0472 rad.

    ## Reward
    exp(-|tip - goal|), with the distance in m. Solved: a return above 30 in 50 steps.

    ## Situations
    ``motor_gain`` (weak, dead or reversed), ``locked_joints`` and ``joint_offset`` (the tip is still measured
    where it is). :attr:`training_situations` holds the paper's 11, the preset ``"paper"`` its test damage.

    Args:
        goal: Where the tip should go: x, y in m from the base; the arm reaches 1.5 m.
        situation: See :class:`RobotEnv`.
        engine: See :class:`RobotEnv`.
        render_mode: See :class:`RobotEnv`.

    Raises:
        ValueError: The goal is not two finite numbers; and as :class:`RobotEnv`.

    Example:
        >>> import gymnasium as gym, famle_envs
        >>> env = gym.make("FamleReacher-v0", situation="joint 3 dead")
        >>> obs, info = env.reset(seed=0)
        >>> info["situation"]
        'joint 3 dead'
        >>> env.close()
    """

    body = Body("reacher.urdf", joints=tuple(f"joint_{i}" for i in range(5)), fixed=True)
    joints = body.joints
    supported_faults = frozenset({"motor_gain", "locked_joints", "joint_offset"})
    time_step = 0.004
    physics_steps = 25
    angle_dims = tuple(range(N_JOINTS))
    task_arguments = RobotEnv.task_arguments | {"goal"}
    training_situations = _TRAINING
    presets: ClassVar[Mapping[str, Situation]] = {situation.name: situation for situation in _TRAINING} | {
        "paper": Situation(motor_gain=(-1, 1, 1, 0, 1), name="paper")
    }

    def __init__(
        self,
        *,
        goal: tuple[float, float] = (-1.0, 1.0),
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.goal = finite_point("goal", goal)
        reach = N_JOINTS * LINK_LENGTH
        high = np.array([math.pi] * N_JOINTS + [SENSED_SPEED] * N_JOINTS + [1.1 * reach] * 2, dtype=np.float32)
        self.observation_space = spaces.Box(-high, high)
        self.action_space = spaces.Box(-1.0, 1.0, (N_JOINTS,))
        super().__init__(situation=situation, engine=engine, render_mode=render_mode)

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """exp(-|tip' - goal|) of each transition.

        Args:
            obs: Observations, (..., 12); a NumPy array or a torch tensor. Not used.
            action: Actions, (..., 5). Not used.
            next_obs: Observations one step later, (..., 12).

        Returns:
            Rewards in (0, 1], (...), in the type of ``next_obs``.
        """
        return math.e ** -(self._squared_distance(next_obs) ** 0.5)

    def squared_reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """exp(-|tip' - goal|^2), what the planner of the authors' public code maximises; arguments as there."""
        return math.e ** -self._squared_distance(next_obs)

    def _squared_distance(self, obs: Any) -> Any:
        dx, dy = obs[..., _TIP_X] - self.goal[0], obs[..., _TIP_Y] - self.goal[1]
        return dx * dx + dy * dy

    @classmethod
    def sample_situation(cls, rng: np.random.Generator, n_faults: int = 2) -> Situation:
        """Draws an unseen situation: faults of random kinds on different joints.

        Each fault is, with equal chance, a weak motor (gain 0.1 to 0.9), a dead one, a reversed one
        (gain -1 to -0.5), or an angle sensor that is 0.1 to 0.5 rad off in either direction.

        Args:
            rng: The generator to draw from.
            n_faults: How many joints have a fault, 1 to 5.

        Raises:
            ValueError: ``n_faults`` is out of range.
        """
        if not 1 <= n_faults <= N_JOINTS:
            raise ValueError(f"n_faults must lie between 1 and {N_JOINTS}, got {n_faults}.")
        while True:
            gain, offset = np.ones(N_JOINTS), np.zeros(N_JOINTS)
            for joint in rng.choice(N_JOINTS, size=n_faults, replace=False):
                kind = rng.choice(["weak", "dead", "reversed", "offset"])
                if kind == "offset":
                    offset[joint] = rng.choice([-1, 1]) * rng.uniform(0.1, 0.5)
                else:
                    low, high = {"weak": (0.1, 0.9), "dead": (0.0, 0.0), "reversed": (-1.0, -0.5)}[kind]
                    gain[joint] = rng.uniform(low, high)
            situation = Situation(motor_gain=tuple(gain), joint_offset=tuple(offset))
            if situation not in cls.training_situations:
                return situation

    def _marker(self) -> Marker:
        return Marker((*self.goal, 0.04), radius=0.06)

    def actuate(self, action: Array) -> None:
        """Sets the motors for one control step."""
        speed = MAX_SPEED * np.clip(np.multiply(self._situation.motor_gain, action), -1.0, 1.0)
        # A servo stops at its joint's end. One that pushed on against it would turn the whole arm in this simulator.
        angles, _ = self.world.joint_states()
        lower, upper = (self.joint_limits - angles) / self.control_period
        self.world.turn(np.clip(speed, lower, upper), MAX_FORCE)

    def observe(self) -> Array:
        """Returns the observation as the sensors give it."""
        angles, speeds = self.world.joint_states()
        wrapped = (angles + self._situation.joint_offset + math.pi) % (2 * math.pi) - math.pi
        velocities = np.clip(speeds, -SENSED_SPEED, SENSED_SPEED)
        tip = self.world.link_position("tip")
        return np.concatenate([wrapped, velocities, tip[:2]]).astype(np.float32)

    def _camera(self) -> Camera:
        return Camera((0.0, 0.0, 0.0), distance=3.0, yaw=0.0, pitch=-89.9)
