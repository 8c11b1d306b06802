"""Learning in simulation: transitions of every situation, and a model from them."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

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

from famle_agent.dynamics import Batch, Dynamics
from famle_agent.envs import (
    EnvLike,
    SituationEnvs,
    check_spaces,
    env_attribute,
    env_spec,
    make_env,
    planning_reward,
    situation_envs,
)
from famle_agent.errors import NotLearnedError
from famle_agent.hyperparameters import Hyperparameters, robot_of
from famle_agent.observation import DIMS, ObservationLayout
from famle_agent.planning import RewardFn
from famle_agent.policies import REWARDS, MakePolicy, make_held_uniform, make_planning
from famle_agent.reward import LearnedReward
from famle_agent.run_folder import RunFolder
from famle_agent.transitions import Transitions, collect
from famle_agent.units import ActionScale

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["SimulationLearner"]

Array = npt.NDArray[Any]


class SimulationLearner(BaseAlgorithm):
    """The part of an agent that learns a model in simulation, with the face of a Stable-Baselines3 algorithm.

    Subclasses say how the model is learnt (:meth:`_learn_model`).

    Args:
        env: A robot's name (``"reacher"``), a Gymnasium id, an environment or a ``VecEnv`` with one robot each.
        mode: ``"ours"`` for the settings that we found to be best, ``"paper"`` for the paper's, ``"original"`` for
            those of the authors' public code, where there is some for the robot.
        reward_fn: r(s, a, s') for torch tensors (..., dim) -> (...), what the planner maximises. None takes the
            environment's ``planning_reward_fn`` or ``reward_fn``, and where it has neither the reward is learnt with
            the dynamics.
        angle_dims: Observation dimensions that are angles in rad. None takes the environment's ``angle_dims``.
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
        **overrides: Settings to change, see :class:`~famle_agent.hyperparameters.Hyperparameters`.

    Attributes:
        dynamics: The meta-learned model; None before :meth:`meta_learn`, where none is shipped.
        situations: What the training situations are called, in the order of the model's embeddings.

    Raises:
        TypeError: An override is no setting.
        ValueError: The environment is unknown or its spaces are not supported, or a setting is out of range.
    """

    _implied: ClassVar[Mapping[str, Any]] = {}
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
        robot = robot_of(self._env_spec["id"] if self._env_spec else None)
        self.hyperparameters = robot.hyperparameters(mode, self._method(overrides), **{**self._implied, **overrides})
        self._reward_fn = reward_fn
        if self.env is not None:
            self._env_reward_fn = planning_reward(self.env, self._reward_names)
        self._learned_reward: LearnedReward | None = None
        self._dims = self._dims_of(angle_dims, quaternion_dims, pose_dims)
        self._generator = torch.Generator(self.device)
        self._setup_model()
        if pretrained and robot.pretrained is not None:
            self._load_pretrained(robot.pretrained)

    def _method(self, overrides: Mapping[str, Any]) -> str:
        """Under which name ``hyperparams/`` has settings that were tuned for this kind of agent; empty for FAMLE."""
        return ""

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
        self._env_reward_fn = planning_reward(wrapped, self._reward_names)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)

    def _describe_env(self, env: VecEnv) -> None:
        if unwrap_vec_normalize(env) is not None:
            raise ValueError("The model normalises by itself; give the environment without VecNormalize.")
        self._env_spec = env_spec(env)

    def _dims_of(self, *given: Sequence[int] | None) -> dict[str, tuple[int, ...]]:
        """The special dimensions of an observation by name: those that were given, else the environment's."""
        names = dict(zip(DIMS, given, strict=True))
        known = {name: () if self.env is None else tuple(env_attribute(self.env, name, ())) for name in DIMS}
        if not self.hyperparameters.egocentric:
            heading = known["pose_dims"][2:]
            known |= {"pose_dims": (), "angle_dims": known["angle_dims"] + (heading if len(heading) == 1 else ())}
        dims = {name: known[name] if chosen is None else tuple(chosen) for name, chosen in names.items()}
        if self.env is not None:
            ObservationLayout(self.observation_space.shape[0], **dims)  # refuses what cannot be
        return dims

    @abstractmethod
    def _learn_model(
        self, transitions: Transitions, round_: int, last: bool, on_iteration: Callable[[dict[str, float]], bool]
    ) -> None:
        """Learns :attr:`dynamics` from simulated transitions (actions in [-1, 1]).

        Round 0 begins with a new model, the others go on with :attr:`dynamics`. ``on_iteration`` takes scalars to log
        and says whether to go on.
        """

    @abstractmethod
    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired."""

    @abstractmethod
    def _load_pretrained(self, file: Traversable) -> None:
        """Takes over the model of a shipped agent, if it was learnt for this environment with these settings."""

    @abstractmethod
    def _restore(self, file: Path) -> None:
        """Takes over the model of a stored agent, and where its random numbers had got to."""

    def meta_learn(
        self,
        envs: Sequence[EnvLike] | Transitions | None = None,
        callback: MaybeCallback = None,
        tb_log_name: str | None = None,
        progress_bar: bool = False,
        n_jobs: int = 1,
        folder: str | os.PathLike[str] | None = None,
    ) -> Self:
        """Learns in simulation: collects transitions in every situation, then learns the model from them.

        With ``rounds`` in the settings it goes round: the agent plans with its model in every simulated situation, and
        learns on from all transitions. While the model learns, ``num_timesteps`` counts the iterations, and callbacks
        are called once an iteration.

        Args:
            envs: One environment, factory or :class:`~famle_envs.Situation` per situation; None takes the training
                situations that the agent's environment names. Or :class:`Transitions` that were collected before, which
                are then all that is learnt from.
                List the situation first that the robot is in until it shows otherwise.
            callback: Stable-Baselines3 callbacks, or a function.
            tb_log_name: Name of the run in TensorBoard; by default the class and ``_meta``.
            progress_bar: Whether to show progress bars.
            n_jobs: Processes that simulate, -1 for one a core. The result does not depend on it.
            folder: Where transitions are stored as they come, and the model after each round. The same call goes on
                where one that was stopped had got to.

        Returns:
            The agent.

        Raises:
            ValueError: There are no situations, an environment's spaces differ from the agent's, or the folder is of a
                run with other settings.
        """
        source = envs if isinstance(envs, Transitions) else situation_envs(self._require_env(), envs)
        rounds = 0 if isinstance(source, Transitions) else self.hyperparameters.rounds
        run = None if folder is None else RunFolder(folder, self._fingerprint(source))
        if not self._custom_logger:
            name = tb_log_name or f"{type(self).__name__}_meta"
            self._logger = configure_logger(self.verbose, self.tensorboard_log, name)
        hooks = self._init_callback(callback)
        total_timesteps = self.hyperparameters.iterations(rounds)  # the name that callbacks look for
        self.num_timesteps = 0
        self.forget()
        if run is not None and self.seed is not None:
            self._generator.manual_seed(self.seed)  # the same call draws the same numbers, be it the first or not
        hooks.on_training_start(locals(), globals())
        transitions, going_on = None, True
        for round_ in range(rounds + 1):
            store = None if run is None else run.transitions(round_)
            if isinstance(source, Transitions):
                new = self._in_model_units(source)
            else:
                new = self._in_model_units(self._collect(source, round_, progress_bar, n_jobs, store))
            transitions = new if transitions is None else transitions.followed_by(new)
            self.situations = transitions.situations
            if run is not None and run.has_model(round_):
                self._restore(run.model(round_))
                self.num_timesteps = self.hyperparameters.iterations(round_, last=round_ == rounds)
                continue
            going_on = self._learn_round(transitions, round_, rounds, hooks, progress_bar)
            if not going_on:
                break
            if run is not None:
                self.save(run.model(round_))
        hooks.on_training_end()
        self.num_timesteps = 0
        return self

    def _learn_round(
        self, transitions: Transitions, round_: int, rounds: int, hooks: BaseCallback, progress_bar: bool
    ) -> bool:
        """Learns the model, and the reward where it is not known; says whether no callback ended it."""
        settings, last, going_on = self.hyperparameters, round_ == rounds, True
        total, before = settings.iterations(round_, last), self.num_timesteps
        name = "Meta-learning" + (f" {round_ + 1}/{rounds + 1}" if rounds else "")
        with tqdm(total=total - before, desc=name, mininterval=1.0, disable=not progress_bar) as bar:

            def on_iteration(scalars: dict[str, float]) -> bool:
                nonlocal going_on
                bar.set_postfix({key.split("/")[-1]: f"{value:.3g}" for key, value in scalars.items()}, refresh=False)
                bar.update()
                going_on = self._log_iteration(scalars, max(1, settings.iterations(rounds) // 200), hooks)
                return going_on

            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self._draw_seed())  # initial weights come from torch's global generator
                self._learn_model(transitions, round_, last, on_iteration)
                self._learn_reward(transitions)
        return going_on

    def collect(
        self, envs: Sequence[EnvLike] | None = None, progress_bar: bool = False, n_jobs: int = 1
    ) -> Transitions:
        """Collects the random transitions that :meth:`meta_learn` learns from; arguments as there."""
        return self._collect(situation_envs(self._require_env(), envs), 0, progress_bar, n_jobs, None)

    def _collect(
        self, envs: SituationEnvs, round_: int, progress_bar: bool, n_jobs: int, folder: Path | None
    ) -> Transitions:
        """Random transitions in round 0, the agent's own planning after that."""
        settings = self.hyperparameters
        make_policy: MakePolicy
        if round_ == 0:
            n, make_policy = settings.transitions_per_situation, make_held_uniform(settings.action_hold)
        else:
            n, make_policy = settings.round_transitions, self._planning()
        name = f"Simulating {round_ + 1}/{settings.rounds + 1}" if settings.rounds else "Simulating"
        with tqdm(total=n * len(envs.sources), desc=name, unit="step", disable=not progress_bar) as bar:
            return collect(envs.sources, envs.situations, n, make_policy, self._draw_seed(), bar.update, n_jobs, folder)

    def _planning(self) -> MakePolicy:
        """What makes the agent plan with what it has learnt so far."""
        model, reward_fn = deepcopy(self._require_dynamics()).cpu(), self._reward_fn
        if reward_fn is None and self._learned_reward is not None:
            learned, scale = (
                deepcopy(self._learned_reward).cpu(),
                ActionScale.of(self.action_space, torch.device("cpu")),
            )

            def reward_fn(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
                return learned(obs, scale.to_unit(action), next_obs)  # type: ignore[no-any-return]

        return make_planning(model, self.hyperparameters.make_planner(), reward_fn, self._reward_names)

    def _fingerprint(self, source: SituationEnvs | Transitions) -> dict[str, Any]:
        """What two runs must have in common for one to go on where the other stopped."""
        return {
            "agent": type(self).__name__,
            "env": self._env_spec,
            "seed": self.seed,
            "situations": list(source.situations),
            "transitions": source.digest() if isinstance(source, Transitions) else None,
            "hyperparameters": self.hyperparameters.to_dict(),
        }

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

    def _log_iteration(self, scalars: dict[str, float], interval: int, hooks: BaseCallback) -> bool:
        self.num_timesteps += 1
        for key, value in scalars.items():
            self.logger.record(key, value)
        if self.num_timesteps % interval == 0:
            self.logger.dump(self.num_timesteps)
        hooks.update_locals(locals())
        return hooks.on_step()

    @property
    @abstractmethod
    def _n_embeddings(self) -> int:
        """How many situations the model tells apart."""

    def _begin_model(self, transitions: Transitions, round_: int) -> tuple[Dynamics, Batch]:
        """The model, a new one in round 0, and the transitions as it sees them."""
        obs, action, next_obs = self._tensors(transitions.obs, transitions.action, transitions.next_obs)
        if round_ == 0:
            self.dynamics = self._new_dynamics()
            self.dynamics.fit_normalisation(obs, next_obs)
        model = self._require_dynamics()
        return model, model.encode(obs, action, next_obs)

    def _new_dynamics(self) -> Dynamics:
        settings = self.hyperparameters
        return Dynamics(
            self.observation_space.shape[0],
            self.action_space.shape[0],
            self._n_embeddings,
            settings.embedding_dim,
            settings.hidden,
            **self._dims,
            gate_actions=settings.gate_actions,
            interaction_rank=settings.interaction_rank,
            members=settings.members,
            degrees_of_freedom=settings.degrees_of_freedom,
        ).to(self.device)

    def _new_reward(self) -> LearnedReward:
        model = self._require_dynamics()
        return LearnedReward(model.layout, model.action_dim).to(self.device)

    @property
    def _reward_names(self) -> tuple[str, ...]:
        """What the environment may call what the planner maximises."""
        name = self.hyperparameters.planning_reward
        return (name,) if name else REWARDS

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
