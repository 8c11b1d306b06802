"""Learning in simulation: transitions of every situation, and a model from them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces, configure_logger
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor
from tqdm.auto import tqdm
from typing_extensions import Self

from famle_agent.dynamics import Dynamics
from famle_agent.envs import EnvLike, check_spaces, env_attribute, env_spec, make_env, situation_envs
from famle_agent.errors import NotLearnedError
from famle_agent.hyperparameters import Hyperparameters, robot_of
from famle_agent.planning import RewardFn
from famle_agent.reward import LearnedReward
from famle_agent.transitions import HeldUniformPolicy, Transitions, collect
from famle_agent.units import ActionScale

__all__ = ["SimulationLearner"]

Array = npt.NDArray[Any]


class SimulationLearner(BaseAlgorithm):
    """The part of an agent that learns a model in simulation, with the face of a Stable-Baselines3 algorithm.

    Subclasses say how the model is learnt (:meth:`_learn_model`).

    Args:
        env: A robot's name (``"reacher"``), a Gymnasium id, an environment or a ``VecEnv`` with one robot each.
        mode: ``"ours"`` for the settings that we found to be best, ``"paper"`` for the paper's.
        reward_fn: r(s, a, s') for torch tensors (..., dim) -> (...). None takes the environment's
            ``reward_fn``, and where it has none the reward is learnt with the dynamics.
        angle_dims: Observation dimensions that are angles in rad. None takes the environment's ``angle_dims``.
        tensorboard_log: Folder for TensorBoard; None logs nothing there.
        verbose: 0 for silence, 1 for information, 2 for debugging.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        seed: Seed of everything; the same seed gives the same agent.
        **overrides: Settings to change, see :class:`~famle_agent.hyperparameters.Hyperparameters`.

    Attributes:
        dynamics: The meta-learned model; None before :meth:`meta_learn`.
        situations: What the training situations are called, in the order of the model's embeddings.

    Raises:
        TypeError: An override is no setting.
        ValueError: The environment is unknown or its spaces are not supported, or a setting is out of range.
    """

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
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: torch.device | str = "auto",
        seed: int | None = None,
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
        robot = robot_of(self._env_spec["id"] if self._env_spec else None)
        self.hyperparameters = robot.hyperparameters(mode, **overrides)
        self._reward_fn = reward_fn
        self._learned_reward: LearnedReward | None = None
        if angle_dims is None:
            angle_dims = () if self.env is None else env_attribute(self.env, "angle_dims", ())
        self._angle_dims = tuple(angle_dims)
        if self.env is not None and any(not 0 <= dim < self.observation_space.shape[0] for dim in self._angle_dims):
            raise ValueError(f"angle_dims {self._angle_dims} name dimensions that {self.observation_space} has not.")
        self._generator = torch.Generator(self.device)
        self._setup_model()

    def _setup_model(self) -> None:
        self.dynamics = None
        self._generator.seed()
        self.set_random_seed(self.seed)

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seeds the environment, the meta-learning and the planner; None changes nothing."""
        if seed is None:
            return
        super().set_random_seed(seed)
        self.seed = seed
        self._generator.manual_seed(seed)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Gives the agent another environment with the same spaces and any number of robots.

        Raises:
            ValueError: The spaces differ, or the environment normalises observations.
        """
        wrapped = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(wrapped, self.observation_space, self.action_space)
        self._describe_env(wrapped)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)

    def _describe_env(self, env: VecEnv) -> None:
        if unwrap_vec_normalize(env) is not None:
            raise ValueError("The model normalises by itself; give the environment without VecNormalize.")
        self._env_spec = env_spec(env)
        self._env_reward_fn = env_attribute(env, "reward_fn", None)

    @abstractmethod
    def _learn_model(self, transitions: Transitions, on_iteration: Callable[[dict[str, float]], bool]) -> None:
        """Learns :attr:`dynamics` from simulated transitions (actions in [-1, 1]).

        ``on_iteration`` takes scalars to log and says whether to go on.
        """

    @abstractmethod
    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired."""

    def meta_learn(
        self,
        envs: Sequence[EnvLike] | Transitions | None = None,
        callback: MaybeCallback = None,
        tb_log_name: str | None = None,
        progress_bar: bool = False,
    ) -> Self:
        """Learns in simulation: collects transitions in every situation, then learns the model from them.

        While it runs, ``num_timesteps`` counts the iterations of the meta-learning, and callbacks are called once
        an iteration.

        Args:
            envs: One environment, factory or :class:`~famle_envs.Situation` per situation; None takes the training
                situations that the agent's environment names. Or :class:`Transitions` that were collected before.
                List the situation first that the robot is in until it shows otherwise.
            callback: Stable-Baselines3 callbacks, or a function.
            tb_log_name: Name of the run in TensorBoard; by default the class and ``_meta``.
            progress_bar: Whether to show progress bars.

        Returns:
            The agent.

        Raises:
            ValueError: There are no situations, or an environment's spaces differ from the agent's.
        """
        transitions = self.collect(envs, progress_bar) if not isinstance(envs, Transitions) else envs
        transitions = self._in_model_units(transitions)
        if not self._custom_logger:
            name = tb_log_name or f"{type(self).__name__}_meta"
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name)
        hooks = self._init_callback(callback)
        total_timesteps = self.hyperparameters.meta_iterations  # the name that callbacks look for
        self.situations, self.num_timesteps = transitions.situations, 0
        self.forget()
        with tqdm(total=total_timesteps, desc="Meta-learning", mininterval=1.0, disable=not progress_bar) as bar:

            def on_iteration(scalars: dict[str, float]) -> bool:
                bar.set_postfix({key.split("/")[-1]: f"{value:.3g}" for key, value in scalars.items()}, refresh=False)
                bar.update()
                return self._log_iteration(scalars, hooks)

            hooks.on_training_start(locals(), globals())
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self._draw_seed())  # initial weights come from torch's global generator
                self._learn_model(transitions, on_iteration)
                self._learn_reward(transitions)
        hooks.on_training_end()
        self.num_timesteps = 0
        return self

    def collect(self, envs: Sequence[EnvLike] | None = None, progress_bar: bool = False) -> Transitions:
        """Collects the random transitions that :meth:`meta_learn` learns from; arguments as there."""
        made, labels, ours = situation_envs(self._require_env(), envs)
        n, hold = self.hyperparameters.transitions_per_situation, self.hyperparameters.action_hold
        try:
            for env in made:
                if env.observation_space != self.observation_space or env.action_space != self.action_space:
                    raise ValueError(
                        f"Each situation must have the agent's spaces, {self.observation_space} and "
                        f"{self.action_space}; got {env.observation_space} and {env.action_space}."
                    )
            with tqdm(total=n * len(made), desc="Simulating", unit="step", disable=not progress_bar) as bar:
                return collect(
                    made,
                    labels,
                    n,
                    lambda space, rng: HeldUniformPolicy(space, hold, rng),
                    self._draw_seed(),
                    bar.update,
                )
        finally:
            for env, close in zip(made, ours, strict=True):
                if close:
                    env.close()

    def _in_model_units(self, transitions: Transitions) -> Transitions:
        """The same with actions in [-1, 1]."""
        if (
            transitions.obs.shape[-1:] != self.observation_space.shape
            or transitions.action.shape[-1:] != self.action_space.shape
        ):
            raise ValueError(
                f"The transitions have observations {transitions.obs.shape} and actions {transitions.action.shape}; "
                f"the agent's spaces are {self.observation_space.shape} and {self.action_space.shape}."
            )
        action = self._action_scale().to_unit(self._tensor(transitions.action))
        return replace(transitions, action=action.cpu().numpy())

    def _learn_reward(self, transitions: Transitions) -> None:
        if self._known_reward_fn() is None and self.dynamics is not None:
            self._learned_reward = self._new_reward()
            obs, action, next_obs = self._tensors(transitions.obs, transitions.action, transitions.next_obs)
            self._learned_reward.fit(obs, action, next_obs, self._tensor(transitions.reward), self._generator)

    def _log_iteration(self, scalars: dict[str, float], hooks: BaseCallback) -> bool:
        self.num_timesteps += 1
        for key, value in scalars.items():
            self.logger.record(key, value)
        if self.num_timesteps % max(1, self.hyperparameters.meta_iterations // 100) == 0:
            self.logger.dump(self.num_timesteps)
        hooks.update_locals(locals())
        return hooks.on_step()

    def _new_dynamics(self, n_situations: int) -> Dynamics:
        settings = self.hyperparameters
        return Dynamics(
            self.observation_space.shape[0],
            self.action_space.shape[0],
            n_situations,
            settings.embedding_dim,
            settings.hidden,
            self._angle_dims,
            settings.gate_actions,
        ).to(self.device)

    def _new_reward(self) -> LearnedReward:
        model = self._require_dynamics()
        return LearnedReward(model.features, model.n_features, model.action_dim).to(self.device)

    def _known_reward_fn(self) -> RewardFn | None:
        """The user's reward function, or the environment's."""
        return self._reward_fn or self._env_reward_fn

    def _action_scale(self) -> ActionScale:
        return ActionScale(*self._tensors(self.action_space.low, self.action_space.high))

    def _require_env(self) -> VecEnv:
        if self.env is None:
            raise ValueError(
                f"The agent has no environment; call set_env(env) or {type(self).__name__}.load(path, env)."
            )
        return self.env

    def _require_dynamics(self) -> Dynamics:
        if self.dynamics is None:
            raise NotLearnedError(
                f"This agent has no model yet. Call meta_learn() first, or {type(self).__name__}.load(path)."
            )
        return self.dynamics

    def _draw_seed(self) -> int:
        return int(torch.randint(2**31, (), generator=self._generator, device=self.device))

    def _tensor(self, values: Any) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=self.device)

    def _tensors(self, *arrays: Array) -> list[Tensor]:
        return [self._tensor(array) for array in arrays]
