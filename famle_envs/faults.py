"""Faults for any robot: what can be wrong with the robots of this package, in any continuous environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs

from famle_envs.fault_signals import MOTOR_FAULTS, SENSOR_FAULTS, MotorFaults, SensorFaults
from famle_envs.mujoco_faults import MUJOCO_FAULTS, MujocoFaults, model_of
from famle_envs.situation import Situation, resolve_situation

__all__ = ["FaultWrapper", "actuator_faults", "make_faulty"]

Array = npt.NDArray[Any]


class FaultWrapper(gym.Wrapper[Array, Array, Array, Array], RecordConstructorArgs):
    """Lets any robot break, as the robots of famle_envs do.

    A situation stays until it is changed, over any number of resets, and an intact robot is the wrapped environment
    to the last bit. The environment's own reward is that of what really happens: of the commands that the motors
    carry out, and of states that no broken sensor has touched.

    ## Situations
    Motors are counted as the dimensions of the action, sensors as those of the observation. Any robot can have
    ``motor_gain``, ``motor_delay``, ``motor_stuck`` and the faults of sensors. One with a MuJoCo model
    (``env.unwrapped.model``) can have ``friction`` (of all surfaces), ``mass``, ``base_mass`` (of the first body),
    ``body_mass`` and ``damping`` too; ``motor_strength`` and ``locked_joints`` (joint i is the one that motor i
    drives) where its actions are its actuators.

    Args:
        env: With one-dimensional Box observations and actions.
        situation: What is wrong: a :class:`~famle_envs.Situation`, a mapping of its fields or a description such as
            ``"motor 3 dead"``. None is the intact robot.

    Raises:
        TypeError: The situation is of no such type.
        ValueError: A space is no one-dimensional Box of floats, the environment takes situations by itself, or this
            robot cannot have the situation.

    Example:
        >>> import gymnasium as gym
        >>> from famle_envs.faults import FaultWrapper
        >>> env = FaultWrapper(gym.make("Pendulum-v1"), situation="motor 0 at gain 0.5, sensor 2 frozen")
        >>> obs, info = env.reset(seed=0)
        >>> info["situation"]
        'joint 0 at gain 0.5, sensor 2 frozen'
        >>> env.set_situation("intact")
        >>> env.close()
    """

    def __init__(
        self, env: gym.Env[Array, Array], situation: Situation | Mapping[str, Any] | str | None = None
    ) -> None:
        resolved = resolve_situation(situation, {})
        RecordConstructorArgs.__init__(self, situation=resolved.to_dict())  # JSON types, for env.spec
        gym.Wrapper.__init__(self, env)
        if env.has_wrapper_attr("set_situation"):
            raise ValueError(f"{self._robot} takes situations by itself; call set_situation() or give gym.make() one.")
        actions, observations = _box("action", env.action_space), _box("observation", env.observation_space)
        angle_dims = env.get_wrapper_attr("angle_dims") if env.has_wrapper_attr("angle_dims") else ()
        self._n_motors, self._n_sensors = actions.shape[0], observations.shape[0]
        self._motors, self._sensors = MotorFaults(actions), SensorFaults(observations, angle_dims)
        self._body = self._take_body()
        self.set_situation(resolved)

    @property
    def situation(self) -> Situation:
        """What is wrong with the robot now."""
        return self._situation

    @property
    def supported_faults(self) -> frozenset[str]:
        """The fields of a :class:`~famle_envs.Situation` that this robot can have."""
        return MOTOR_FAULTS | SENSOR_FAULTS | (frozenset() if self._body is None else self._body.supported)

    @property
    def training_situations(self) -> tuple[Situation, ...]:
        """Situations to meta-learn on: :func:`actuator_faults`."""
        return actuator_faults(self)

    def set_situation(self, situation: Situation | Mapping[str, Any] | str | None) -> None:
        """Breaks or repairs the robot, from this moment on and in the middle of an episode too.

        A joint is locked where it is, a sensor freezes at its last reading, and a motor that comes late does nothing
        until the first late command arrives.

        Raises:
            TypeError: The situation is of no such type.
            ValueError: The situation is unknown, or this robot cannot have it.
        """
        self._situation = self._resolve(situation)
        self._label = self._situation.label  # which takes time to put into words
        self._motors.set(self._situation)
        self._sensors.set(self._situation)
        self._change_body()
        self._lock_joints()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Resets the environment; the situation stays.

        Args:
            seed: Seed of the environment, and of the noise and losses of the sensors.
            options: ``{"situation": ...}`` changes the situation from now on; the rest is the environment's.

        Raises:
            TypeError: The situation is of no known type.
            ValueError: The robot cannot have the situation.
        """
        if options is not None and "situation" in options:
            self.set_situation(options["situation"])
            options = {key: value for key, value in options.items() if key != "situation"} or None
        self._change_body()  # whose joints must move to get to the start
        model = model_of(self.env)
        obs, info = self.env.reset(seed=seed, options=options)
        if model_of(self.env) is not model:  # the environment has built another one
            self._body = self._take_body()
            self._change_body()
        self._lock_joints()
        self._motors.begin()
        return self._sensors.begin(obs, seed), info | {"situation": self._label}

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Steps the environment with what the motors make of an action; returns what the sensors read.

        Raises:
            ValueError: A motor is broken and the action has the wrong shape. It is clipped to the action space then.
        """
        obs, reward, terminated, truncated, info = self.env.step(self._motors(action))
        return self._sensors(obs), reward, terminated, truncated, info | {"situation": self._label}

    @property
    def _robot(self) -> str:
        return type(self.unwrapped).__name__ if self.env.spec is None else self.env.spec.id

    def _take_body(self) -> MujocoFaults | None:
        model = model_of(self.env)
        return None if model is None else MujocoFaults(model, self._n_motors)

    def _change_body(self) -> None:
        if self._body is not None:
            self._body.apply(model_of(self.env), self._situation)

    def _lock_joints(self) -> None:
        if self._body is not None:
            self._body.lock(model_of(self.env), self.unwrapped.data, self._situation)  # type: ignore[attr-defined]

    def _resolve(self, situation: Situation | Mapping[str, Any] | str | None) -> Situation:
        resolved = resolve_situation(situation, {})
        if self._body is None and (faults := sorted(resolved.faults & MUJOCO_FAULTS)):
            raise ValueError(
                f"The fault {faults[0]!r} needs a MuJoCo model (env.unwrapped.model), which {self._robot} has not; "
                "make an environment that is built in that way."
            )
        complete = resolved.for_robot(
            self._robot,
            self._n_motors,
            self.supported_faults,
            n_sensors=self._n_sensors,
            n_bodies=0 if self._body is None else self._body.n_bodies,
        )
        MujocoFaults.check(complete)
        space = _box("action", self.env.action_space)
        for motor, at in enumerate(complete.motor_stuck):
            if at is not None and not space.low[motor] <= space.dtype.type(at) <= space.high[motor]:
                raise ValueError(
                    f"motor_stuck must lie in the action space; motor {motor} of {self._robot} goes from "
                    f"{space.low[motor]:g} to {space.high[motor]:g}, got {at:g}."
                )
        return complete


def make_faulty(
    env_id: str | EnvSpec, situation: Situation | Mapping[str, Any] | str | None = None, **kwargs: Any
) -> gym.Env[Array, Array]:
    """Makes a robot in a situation, be it one of famle_envs or any other.

    Args:
        env_id: What :func:`gymnasium.make` takes.
        situation: See :class:`FaultWrapper`.
        **kwargs: Arguments of :func:`gymnasium.make`.

    Raises:
        gymnasium.error.DependencyNotInstalled: The robot needs MuJoCo, which is not installed.
        TypeError: The situation is of no such type.
        ValueError: The robot cannot have the situation.

    Example:
        >>> from famle_envs.faults import make_faulty
        >>> env = make_faulty("Pendulum-v1", "motor 0 reversed")
        >>> print(env.situation)
        joint 0 reversed
        >>> env.close()
    """
    try:
        env = gym.make(env_id, **kwargs)
    except gym.error.DependencyNotInstalled as error:
        if "mujoco" not in str(error).lower():
            raise
        robot = env_id if isinstance(env_id, str) else env_id.id
        raise gym.error.DependencyNotInstalled(
            f"{robot} needs MuJoCo, which is not installed; run `pip install 'famle[mujoco]'`."
        ) from error
    if env.has_wrapper_attr("set_situation"):
        env.close()
        return gym.make(env_id, situation=situation, **kwargs)
    try:
        return FaultWrapper(env, situation)
    except BaseException:
        env.close()
        raise


def actuator_faults(env: gym.Env[Any, Any], gains: Sequence[float] = (0.0, 0.5, -1.0)) -> tuple[Situation, ...]:
    """Lists situations to meta-learn on: the intact robot, and each of its motors dead, weak and reversed.

    Args:
        env: With a one-dimensional Box of actions.
        gains: Factors on the command of a motor, each for every motor in turn. A motor that only pushes, as its part
            of the action space is nowhere below 0, cannot be reversed.

    Returns:
        The situations, the intact one first.

    Raises:
        ValueError: The actions are no one-dimensional Box of floats, or a gain lies outside [-1, 1].
    """
    low = _box("action", env.action_space).low
    motors = range(len(low))
    return (
        Situation(),
        *(
            Situation(motor_gain=tuple(gain if i == motor else 1.0 for i in motors))
            for gain in gains
            for motor in np.flatnonzero((low < 0.0) | (gain >= 0.0)).tolist()
        ),
    )


def _box(name: str, space: spaces.Space[Any]) -> spaces.Box:
    if not isinstance(space, spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise ValueError(
            f"The {name} space must be a one-dimensional Box of floats, got {space}; use "
            "gymnasium.wrappers.FlattenObservation for observations of another form."
        )
    return space
