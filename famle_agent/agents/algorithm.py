"""The face that all our agents share with Stable-Baselines3's algorithms: environments, settings and seeds."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor

from famle_agent.agents.config import Hyperparameters
from famle_agent.agents.presets import make_env, robot_of
from famle_agent.data.action_scaling import ActionScale
from famle_agent.data.envs import (
    NEW_OBSERVATIONS,
    changing_wrappers,
    check_spaces,
    env_attribute,
    env_id,
    env_spec,
    planning_reward,
)
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.observation import DIMS, ObservationLayout
from famle_agent.models.reward import LearnedReward, RewardFn
from famle_agent.utils.errors import NotLearnedError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["ModelBasedAlgorithm"]

Array = npt.NDArray[Any]


class ModelBasedAlgorithm(BaseAlgorithm):
    """An algorithm with a dynamics model of its environment; what is done with it, subclasses say.

    Args:
        env: A robot's name (``"reacher"``), a Gymnasium id, an environment or a ``VecEnv`` with one robot each.
        mode: ``"ours"`` for the settings that we found to be best, ``"paper"`` for the paper's, ``"original"`` for
            those of the authors' public code, where there is some for the robot.
        reward_fn: r(s, a, s') for torch tensors (..., dim) -> (...), what the planner maximises. None takes the
            environment's ``planning_reward_fn`` or ``reward_fn``, and where it has neither the reward is learnt with
            the dynamics.
        angle_dims: Observation dimensions that are angles in rad. None takes the environment's ``angle_dims`` unless
            the settings say ``raw_angles``.
        quaternion_dims: The four observation dimensions of a unit quaternion, or none of them. None takes the
            environment's ``quaternion_dims``.
        pose_dims: x, y and heading of a robot on a floor, the heading as an angle or as its sine and its cosine: with
            them, the model knows that a robot moves alike wherever it stands and looks. None takes the environment's
            ``pose_dims`` where the settings are ``egocentric``.
        tensorboard_log: Folder for TensorBoard; None logs nothing there.
        verbose: 0 for silence, 1 for information, 2 for debugging.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        seed: Seed of everything; the same seed gives the same agent.
        pretrained: Whether to begin with the meta-learned model that the package ships, where it ships one for this
            environment and these settings (``"ant"``). :meth:`meta_learn` learns anew all the same.
        **overrides: Settings to change, see :class:`~famle_agent.agents.config.Hyperparameters`.

    Attributes:
        dynamics: The meta-learned model; None before :meth:`meta_learn`, where none is shipped.
        situations: What the training situations are called, in the order of the model's embeddings.
        dims: The special dimensions of an observation: ``angle_dims``, ``quaternion_dims`` and ``pose_dims``.

    Raises:
        TypeError: An override is no setting.
        ValueError: The environment is unknown or its spaces are not supported, or a setting is out of range.
    """

    implied: ClassVar[Mapping[str, Any]] = {}
    """Settings that the kind of agent implies, in every mode."""

    dynamics: Dynamics | None
    hyperparameters: Hyperparameters
    observation_space: spaces.Box
    action_space: spaces.Box

    def __init__(
        self,
        env: GymEnv | str | None,
        mode: str = "ours",
        *,
        reward_fn: RewardFn | None = None,
        angle_dims: Sequence[int] | None = None,
        quaternion_dims: Sequence[int] | None = None,
        pose_dims: Sequence[int] | None = None,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: torch.device | str = "auto",
        seed: int | None = None,
        pretrained: bool = True,
        **overrides: Any,
    ) -> None:
        if env is not None:
            env = make_env(env)
            check_spaces(env.observation_space, env.action_space)
        super().__init__(
            policy=BasePolicy,
            env=env,
            learning_rate=0.0,  # the settings have rates of their own
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.mode = mode
        self.situations: tuple[str, ...] = ()
        self._env_spec: dict[str, Any] | None = None
        self._env_reward_fn: RewardFn | None = None
        if self.env is not None:
            self._describe_env(self.env)
        robot = robot_of(None if self.env is None else env_id(self.env))
        self.hyperparameters = robot.hyperparameters(mode, self._method(overrides), **{**self.implied, **overrides})
        self._reward_fn = reward_fn
        if self.env is not None:
            self._take_reward(self.env)
        self.learned_reward: LearnedReward | None = None
        self.dims = self._dims_of(angle_dims, quaternion_dims, pose_dims)
        self.generator = torch.Generator(self.device)
        self._not_taken: list[str] = []
        self._setup_model()
        if pretrained and robot.pretrained is not None:
            self._load_pretrained(robot.pretrained)

    def _method(self, overrides: Mapping[str, Any]) -> str:
        """Under which name ``hyperparams/`` has settings that were tuned for this kind of agent; empty for FAMLE."""
        return ""

    def _setup_model(self) -> None:
        self.dynamics = None
        self.generator.seed()
        self.set_random_seed(self.seed)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds the environment, the meta-learning and the planner; None changes nothing."""
        if seed is None:
            return
        super().set_random_seed(seed)
        self.seed = seed
        self.generator.manual_seed(seed)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Gives the agent another environment with the same spaces and any number of robots.

        Raises:
            ValueError: The spaces differ, or the environment normalises observations.
        """
        wrapped = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(wrapped, self.observation_space, self.action_space)
        self._describe_env(wrapped)
        self._take_reward(wrapped)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)

    def _describe_env(self, env: VecEnv) -> None:
        if unwrap_vec_normalize(env) is not None:
            raise ValueError("The model normalises by itself; give the environment without VecNormalize.")
        self._env_spec = env_spec(env)

    def _take_reward(self, env: VecEnv) -> None:
        """Looks for what to maximise in an environment, unless the user has said it."""
        if self._reward_fn is None:
            self._env_reward_fn = planning_reward(env, self.hyperparameters.planning_reward)

    def _dims_of(self, *given: Sequence[int] | None) -> dict[str, tuple[int, ...]]:
        """The special dimensions of an observation by name: those that were given, else the environment's."""
        names = dict(zip(DIMS, given, strict=True))
        known = {name: () if self.env is None else tuple(env_attribute(self.env, name, ())) for name in DIMS}
        if not self.hyperparameters.egocentric:
            heading = known["pose_dims"][2:]
            known |= {"pose_dims": (), "angle_dims": known["angle_dims"] + (heading if len(heading) == 1 else ())}
        if self.hyperparameters.raw_angles:
            known |= {"angle_dims": ()}
        inherited = [name for name, chosen in names.items() if chosen is None and known[name]]
        if inherited and self.env is not None and (changed := changing_wrappers(self.env, NEW_OBSERVATIONS)):
            raise ValueError(
                f"The environment's {', '.join(inherited)} are of what {', '.join(changed)} changes; give those of the "
                f"wrapped observations ({inherited[0]}=..., or () for none), or the environment without that wrapper."
            )
        dims = {name: known[name] if chosen is None else tuple(chosen) for name, chosen in names.items()}
        if self.env is not None:
            ObservationLayout(self.observation_space.shape[0], **dims)  # refuses what cannot be
        return dims

    @abstractmethod
    def _load_pretrained(self, file: Traversable) -> None:
        """Takes over the model of a shipped agent, if it was learnt for this environment with these settings."""

    @property
    @abstractmethod
    def _n_embeddings(self) -> int:
        """How many situations the model tells apart."""

    def new_dynamics(self, robots: int = 1) -> Dynamics:
        """Makes an untrained model of the agent's settings, for one robot or for several with a network each."""
        settings = self.hyperparameters
        return Dynamics(
            self.observation_space.shape[0],
            self.action_space.shape[0],
            self._n_embeddings,
            settings.embedding_dim,
            settings.hidden,
            **self.dims,
            gate_actions=settings.gate_actions,
            interaction_rank=settings.interaction_rank,
            members=settings.members,
            degrees_of_freedom=settings.degrees_of_freedom,
            activation=settings.activation,
            output_limit=settings.output_limit,
            normalise_actions=settings.normalise_actions,
            initial_weights=settings.initial_weights,
            robots=robots,
        ).to(self.device)

    def _new_reward(self) -> LearnedReward:
        layout = ObservationLayout(self.observation_space.shape[0], **self.dims)
        return LearnedReward(layout, self.action_space.shape[0]).to(self.device)

    def _known_reward_fn(self) -> RewardFn | None:
        """The user's reward function, or the environment's."""
        return self._reward_fn or self._env_reward_fn

    def _action_scale(self) -> ActionScale:
        return ActionScale.of(self.action_space, self.device)

    def _require_env(self) -> VecEnv:
        if self.env is None:
            raise ValueError(
                f"The agent has no environment; call set_env(env) or {type(self).__name__}.load(path, env)."
            )
        return self.env

    @property
    def model(self) -> Dynamics:
        """The meta-learned model.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        if self.dynamics is None:
            shipped = ""
            if self._not_taken and "kind of agent" not in self._not_taken:
                shipped = f" The model that is shipped has another {', '.join(self._not_taken)}."
            raise NotLearnedError(
                f"This agent has no model yet.{shipped} Call meta_learn() first, or {type(self).__name__}.load(path)."
            )
        return self.dynamics

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31, (), generator=self.generator, device=self.device))

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def _tensors(self, *arrays: Array) -> list[Tensor]:
        return [self._tensor(array) for array in arrays]
