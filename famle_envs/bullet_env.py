"""A robot in one PyBullet world: loading, resetting, stepping, rendering, and where a situation is applied."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from importlib.resources import as_file, files
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pybullet
from gymnasium import spaces

from famle_envs.situation import Situation, resolve_situation

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["HOLDING_FORCE", "Array", "BulletEnv"]

Array = npt.NDArray[np.floating[Any]]

HOLDING_FORCE = 1e4  # of a locked joint, far above what any motor here can exert (N m)
_FAULTY_COLOUR = (0.85, 0.25, 0.2, 1.0)


class BulletEnv(gym.Env[Array, Array]):
    """Base of the robots: one robot, one private physics world, one situation at a time.

    A situation acts on the physics and on the sensors, never on the task. It stays until it is changed,
    over any number of resets. The same seed, situation and actions give the same bits.

    Args:
        situation: What is wrong with the robot: a :class:`Situation`, a mapping of its fields, a
            preset's name or a description such as ``"joint 3 dead"``. None is the intact robot.
        render_mode: None or ``"rgb_array"``.

    Raises:
        TypeError: The situation is of no such type.
        ValueError: The situation is unknown or this robot cannot have it, or the render mode is unknown.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own type)

    asset: ClassVar[str]
    """File of the robot's description."""
    asset_folder: ClassVar[Traversable] = files("famle_envs") / "assets"
    """Where it lies."""
    joints: ClassVar[tuple[int, ...]]
    """PyBullet's indices of the motorised joints; a :class:`Situation` counts joints in this order."""
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
    task_arguments: ClassVar[frozenset[str]] = frozenset({"situation", "render_mode"})
    """Arguments of the constructor that say what the robot should do and in what situation, not what it is."""
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
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}. "
                "For a window, wrap an 'rgb_array' environment in gymnasium.wrappers.HumanRendering."
            )
        self.render_mode = render_mode
        self._situation = self._resolve(situation)
        self.client: int | None = None
        """Of the physics server; None once closed."""
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
        self._hold_locked_joints()
        for _ in range(self.physics_steps):
            pybullet.stepSimulation(physicsClientId=self.client)

    @abstractmethod
    def actuate(self, action: Array) -> None:
        """Sets the motors for one control step."""

    @abstractmethod
    def observe(self) -> Array:
        """Returns the observation as the sensors give it, faults included, as float32."""

    @abstractmethod
    def _camera(self) -> dict[str, Any]:
        """Arguments of PyBullet's ``computeViewMatrixFromYawPitchRoll`` but for the up axis."""

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
        pybullet.restoreState(self._start, physicsClientId=self._world)
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
        view = pybullet.computeViewMatrixFromYawPitchRoll(upAxisIndex=2, **self._camera())
        projection = pybullet.computeProjectionMatrixFOV(fov=60, aspect=1.0, nearVal=0.1, farVal=100.0)
        _, _, pixels, _, _ = pybullet.getCameraImage(
            480,
            480,
            view,
            projection,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._world,
        )
        return np.asarray(pixels, dtype=np.uint8).reshape(480, 480, 4)[:, :, :3].copy()

    def close(self) -> None:
        """Ends the physics world; a second call does nothing."""
        if self.client is not None:
            with suppress(pybullet.error):  # at the interpreter's end the world may be gone already
                pybullet.disconnect(physicsClientId=self.client)
            self.client = None

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_obs": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copy has a world of its own, in which it has not been reset: the number of this one may be anybody's there.
        vars(self).update(state | {"client": None})
        if state["client"] is not None:
            self._load()

    def __del__(self) -> None:
        # A world that nobody closes would keep its memory until the process ends.
        if getattr(self, "client", None) is not None:
            self.close()

    @property
    def control_period(self) -> float:
        """Duration of one control step, in s."""
        return self.time_step * self.physics_steps

    @property
    def _world(self) -> int:
        if self.client is None:
            raise RuntimeError("The environment is closed; make a new one.")
        return self.client

    def _load(self) -> None:
        client = pybullet.connect(pybullet.DIRECT)
        if client < 0:
            raise RuntimeError("PyBullet gives no more physics worlds; close() environments that are not needed.")
        self.client = client
        # Sleeping and unordered contact pairs would make a run depend on the runs before it.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.time_step,
            numSubSteps=self.substeps if self.substeps > 1 else 0,
            numSolverIterations=self.solver_iterations,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        with as_file(self.asset_folder / self.asset) as path:
            self.robot = self._load_robot(str(path), client)
        self.joint_limits = self._read_joint_limits()
        shapes = pybullet.getVisualShapeData(self.robot, physicsClientId=client)
        links = [shape[1] for shape in shapes]
        # (link, index among the link's shapes): colour
        self._colours = {(link, links[:i].count(link)): shapes[i][7] for i, link in enumerate(links)}
        self._start = pybullet.saveState(physicsClientId=client)

    @abstractmethod
    def _load_robot(self, path: str, client: int) -> int:
        """Loads the robot and all that stands around it, in the start pose; returns the robot's body."""

    def _read_joint_limits(self) -> Array:
        """Lower and upper end of each joint in rad, (2, n_joints); infinite for a joint that turns without end."""
        info = [pybullet.getJointInfo(self.robot, joint, physicsClientId=self._world) for joint in self.joints]
        # PyBullet says "no limit" by a lower end above the upper one.
        ends = [(lower, upper) if lower <= upper else (-np.inf, np.inf) for lower, upper in (row[8:10] for row in info)]
        return np.array(ends).T

    def _apply_situation(self) -> None:
        states = pybullet.getJointStates(self.robot, self.joints, physicsClientId=self._world)
        self._locked_at = {self.joints[joint]: states[joint][0] for joint in self._situation.locked_joints}
        self._label = self._situation.label
        if self.render_mode is not None:
            self._colour_faulty_joints()

    def _hold_locked_joints(self) -> None:
        if self._locked_at:
            pybullet.setJointMotorControlArray(
                self.robot,
                list(self._locked_at),
                pybullet.POSITION_CONTROL,
                targetPositions=list(self._locked_at.values()),
                forces=[HOLDING_FORCE] * len(self._locked_at),
                physicsClientId=self._world,
            )

    def _colour_faulty_joints(self) -> None:
        faulty = {self.joints[joint] for joint, gain in enumerate(self._situation.motor_gain) if gain != 1.0}
        faulty |= set(self._locked_at)
        for (link, shape), colour in self._colours.items():
            rgba = _FAULTY_COLOUR if link in faulty else colour
            pybullet.changeVisualShape(self.robot, link, shape, rgbaColor=rgba, physicsClientId=self._world)

    def _info(self) -> dict[str, Any]:
        # A string: Gymnasium wants nothing in `info` to be shared between two steps.
        return {"situation": self._label}
