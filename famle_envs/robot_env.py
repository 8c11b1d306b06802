"""A robot in a world of its own: resetting, stepping, rendering, and where a situation is applied."""

from __future__ import annotations

import math
import sys
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from famle_envs.engines import make_world, resolve_engine
from famle_envs.engines.world import Array, Body, Camera, Marker, Steps, World
from famle_envs.situation import Situation, resolve_situation

__all__ = ["RobotEnv"]


class RobotEnv(gym.Env[Array, Array]):
    """Base of the robots: one robot, one private physics world, one situation at a time.

    A situation acts on the physics and on the sensors, never on the task. It stays until it is changed,
    over any number of resets. The same seed, situation and actions give the same bits.

    Args:
        situation: What is wrong with the robot: a :class:`Situation`, a mapping of its fields, a
            preset's name or a description such as ``"joint 3 dead"``. None is the intact robot.
        engine: ``"pybullet"``, ``"mujoco"``, or None for PyBullet where it is installed and MuJoCo elsewhere. Masses,
            motors, frictions and rates are the same in both; what they make of a contact is not quite.
        render_mode: None or ``"rgb_array"``.

    Raises:
        gymnasium.error.DependencyNotInstalled: The engine is not installed.
        TypeError: The situation is of no such type.
        ValueError: The situation is unknown or this robot cannot have it, or the engine or the render mode is unknown.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own type)

    body: ClassVar[Body]
    """The robot's description."""
    joints: ClassVar[tuple[str, ...]]
    """Names of the motorised joints; a :class:`Situation` counts joints in this order."""
    supported_faults: ClassVar[frozenset[str]]
    """The fields of a :class:`Situation` that this robot can have."""
    time_step: ClassVar[float]
    """Simulated time of one call of the simulator, in s."""
    physics_steps: ClassVar[int]
    """Calls of the simulator per control step."""
    substeps: ClassVar[int] = 1
    """Physics steps into which the simulator divides a call; torques act on all of them."""
    solver_iterations: ClassVar[int] = 200
    """Of PyBullet's constraint solver; with its own 50, motors of a chain of links disturb each other."""
    angle_dims: ClassVar[tuple[int, ...]] = ()
    """Observation dimensions that are angles in [-pi, pi], where pi and -pi are the same place."""
    quaternion_dims: ClassVar[tuple[int, ...]] = ()
    """The four observation dimensions of a unit quaternion, where q and -q are the same orientation."""
    pose_dims: ClassVar[tuple[int, ...]] = ()
    """x, y and heading of a robot on a floor; the heading as an angle, or as its sine and its cosine."""
    task_arguments: ClassVar[frozenset[str]] = frozenset({"situation", "engine", "render_mode"})
    """Arguments of the constructor that say what the robot should do, where and in what situation, not what it is."""
    training_situations: ClassVar[tuple[Situation, ...]]
    """The situations of the paper's meta-training."""
    presets: ClassVar[Mapping[str, Situation]]
    """Situations by name."""

    action_space: spaces.Box  # type: ignore[assignment]
    observation_space: spaces.Box  # type: ignore[assignment]

    def __init__(
        self,
        *,
        situation: Situation | Mapping[str, Any] | str | None = None,
        engine: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}. "
                "For a window, wrap an 'rgb_array' environment in gymnasium.wrappers.HumanRendering."
            )
        self.render_mode = render_mode
        self._situation = self._resolve(situation)
        self.engine = resolve_engine(engine)
        """The name of the engine that it runs in."""
        self._world: World | None = None  # None once closed
        self._locked_at: dict[int, float] = {}
        self._obs: Array | None = None
        self._low, self._high = (end.astype(np.float64) for end in (self.action_space.low, self.action_space.high))
        self._load()

    @property
    def situation(self) -> Situation:
        """What is wrong with the robot now."""
        return self._situation

    def set_situation(self, situation: Situation | Mapping[str, Any] | str | None) -> None:
        """Breaks or repairs the robot, from this moment on and in the middle of an episode too.

        Raises:
            TypeError: The situation is of no such type.
            ValueError: The situation is unknown, or this robot cannot have it.
        """
        self._situation = self._resolve(situation)
        self._apply_situation()

    @classmethod
    def _resolve(cls, situation: Situation | Mapping[str, Any] | str | None) -> Situation:
        resolved = resolve_situation(situation, cls.presets)
        return resolved.for_robot(cls.__name__, len(cls.joints), cls.supported_faults)

    def _simulate(self, action: Array) -> None:
        """One control step with an action that lies in the action space."""
        self.actuate(action)
        if self._locked_at:
            self.world.hold(self._locked_at)
        self.world.simulate(self.physics_steps)

    @abstractmethod
    def actuate(self, action: Array) -> None:
        """Sets the motors for one control step."""

    @abstractmethod
    def observe(self) -> Array:
        """Returns the observation as the sensors give it, faults included, as float32."""

    @abstractmethod
    def _camera(self) -> Camera:
        """From where a picture is taken."""

    def _marker(self) -> Marker | None:
        """What a picture shows beside the robot; by default nothing."""
        return None

    def _settle(self) -> None:
        """Lets the robot get to the state from which it starts; by default it is there."""

    def _perturb_start(self) -> None:
        """Makes a start differ from the others, drawing on ``np_random``; by default all are alike."""

    def _has_ended(self, obs: Array) -> bool:
        """Whether the episode ends in the state behind this observation; by default none does."""
        return False

    @abstractmethod
    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        """The reward of a batch of transitions; see the robot."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Puts the robot at its start.

        Args:
            seed: Seed of the environment's generator.
            options: ``{"situation": ...}`` changes the situation from now on.

        Raises:
            TypeError: The situation is of no known type.
            ValueError: An option is unknown, or the robot cannot have the situation.
        """
        super().reset(seed=seed)
        options = options or {}
        for key in options:
            if key != "situation":
                raise ValueError(f"reset knows no option {key!r}; the only one is 'situation'.")
        if "situation" in options:
            self._situation = self._resolve(options["situation"])
        self.world.restart()
        self._perturb_start()
        self._apply_situation()
        self._obs = self.observe()
        return self._obs.copy(), self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Applies an action for one control period.

        Raises:
            ResetNeeded: There was no reset yet.
            ValueError: The action has the wrong shape or is not finite. It is clipped to the action space.
        """
        if self._obs is None:
            raise gym.error.ResetNeeded("Call reset() before step().")
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self._low.shape or not math.isfinite(np.abs(action).max()):
            raise ValueError(f"The action must be {self.action_space.shape} finite numbers, got {action}.")
        self._simulate(np.minimum(np.maximum(action, self._low), self._high))
        previous, self._obs = self._obs, self.observe()
        reward = float(self.reward_fn(previous, action, self._obs))
        return self._obs.copy(), reward, self._has_ended(self._obs), False, self._info()

    def render(self) -> npt.NDArray[np.uint8] | None:
        """A picture of the robot, (480, 480, 3); None without a render mode."""
        if self.render_mode is None:
            gym.logger.warn("render() needs gym.make(..., render_mode='rgb_array').")
            return None
        return self.world.picture(self._camera())

    def close(self) -> None:
        """Ends the physics world; a second call does nothing."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_obs": None, "_world": self._world is not None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copy has a world of its own, in which it has not been reset.
        vars(self).update(state | {"_world": None})
        if state["_world"]:
            self._load()

    def __del__(self) -> None:
        # A world that nobody closes would keep its memory until the process ends, when what it lives in may be gone.
        if getattr(self, "_world", None) is not None and not sys.is_finalizing():
            self.close()

    @property
    def control_period(self) -> float:
        """Duration of one control step, in s."""
        return self.time_step * self.physics_steps

    @property
    def world(self) -> World:
        """The robot in its engine.

        Raises:
            RuntimeError: The environment is closed.
        """
        if self._world is None:
            raise RuntimeError("The environment is closed; make a new one.")
        return self._world

    def _load(self) -> None:
        steps = Steps(self.time_step, self.substeps, self.solver_iterations)
        marker = None if self.render_mode is None else self._marker()
        self._world = make_world(self.engine, self.body, steps, marker)
        self.joint_limits = self._world.joint_limits
        """Lower and upper end of each joint in rad, (2, n_joints); infinite for a joint that turns without end."""
        self._settle()
        self._world.set_start()

    def _apply_situation(self) -> None:
        angles, _ = self.world.joint_states()
        self._locked_at = {joint: float(angles[joint]) for joint in self._situation.locked_joints}
        self._label = self._situation.label
        if self.render_mode is not None:
            motors = zip(self._situation.motor_gain, self._situation.motor_strength, strict=True)
            weak = {joint for joint, factors in enumerate(motors) if factors != (1.0, 1.0)}
            self.world.paint(frozenset(weak | set(self._locked_at)))

    def _info(self) -> dict[str, Any]:
        # A string: Gymnasium wants nothing in `info` to be shared between two steps.
        return {"situation": self._label}
