"""The Stable-Baselines3 face that all model-based agents share, and where the parts meet."""

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
from stable_baselines3.common.utils import configure_logger, safe_mean
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor
from tqdm.auto import tqdm
from typing_extensions import Self

from famle_agent.adaptation import Belief, Memory
from famle_agent.checkpoint import File, load_agent, save_agent
from famle_agent.dashboard import log_posterior
from famle_agent.dynamics import Dynamics
from famle_agent.envs import EnvLike, check_spaces, env_attribute, env_spec, make_env, situation_envs
from famle_agent.errors import NotLearnedError
from famle_agent.hyperparameters import Hyperparameters, robot_of
from famle_agent.online import OnlineLoop, OnlineState
from famle_agent.planning import RewardFn
from famle_agent.reward import LearnedReward
from famle_agent.transitions import HeldUniformPolicy, Transitions, collect
from famle_agent.units import ActionScale, check_action, check_observation

__all__ = ["ModelBasedAgent"]

Array = npt.NDArray[Any]


class ModelBasedAgent(BaseAlgorithm):
    """An agent that learns a model in simulation, adapts it on the robot, and plans with it.

    Subclasses say how the model is learnt (:meth:`_learn_model`) and how it is adapted (:meth:`_prior`,
    :meth:`_adapt`). The rest is the face of a Stable-Baselines3 algorithm.

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
        self.planner = self.hyperparameters.make_planner()
        self._reward_fn = reward_fn
        self._learned_reward: LearnedReward | None = None
        if angle_dims is None:
            angle_dims = () if self.env is None else env_attribute(self.env, "angle_dims", ())
        self._angle_dims = tuple(angle_dims)
        if self.env is not None and any(not 0 <= dim < self.observation_space.shape[0] for dim in self._angle_dims):
            raise ValueError(f"angle_dims {self._angle_dims} name dimensions that {self.observation_space} has not.")
        self._live: OnlineState | None = None
        self._served: object = None
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
            ValueError: The spaces differ.
        """
        wrapped = self._wrap_env(env, self.verbose)
        self.n_envs = wrapped.num_envs
        super().set_env(wrapped, force_reset)
        self._describe_env(wrapped)

    def _describe_env(self, env: VecEnv) -> None:
        if self._vec_normalize_env is not None:
            raise ValueError("The model normalises by itself; give the environment without VecNormalize.")
        self._env_spec = env_spec(env)
        self._env_reward_fn = env_attribute(env, "reward_fn", None)

    # --- what a subclass adds ---------------------------------------------------------------------------

    @abstractmethod
    def _learn_model(self, transitions: Transitions, on_iteration: Callable[[dict[str, float]], bool]) -> None:
        """Learns :attr:`dynamics` from simulated transitions (actions in [-1, 1]).

        ``on_iteration`` takes scalars to log and says whether to go on.
        """

    @abstractmethod
    def _prior(self, robots: int) -> Belief:
        """What B robots believe before they have seen anything."""

    @abstractmethod
    def _adapt(self, memory: Memory, belief: Belief) -> Belief:
        """What B robots believe after the transitions in their memory."""

    # --- learning in simulation -------------------------------------------------------------------------

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
        self.situations, self._live, self.num_timesteps = transitions.situations, None, 0
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

    # --- living on the robot ----------------------------------------------------------------------------

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Lives on the robot (the agent's environment), adapting all the time: Algorithm 2 for some steps.

        Meta-learns first where that has not been done. What was learnt stays: :meth:`predict` without a state
        goes on from there, until :meth:`forget`.

        Args:
            total_timesteps: Steps of the robot, all robots of a ``VecEnv`` counted.
            callback: Stable-Baselines3 callbacks, or a function.
            log_interval: Episodes between two logs.
            tb_log_name: Name of the run in TensorBoard; by default the class.
            reset_num_timesteps: Whether to count from 0 and to reset the environment.
            progress_bar: Whether to show a progress bar.
        """
        env = self._require_env()
        if self.dynamics is None:
            self.meta_learn(progress_bar=progress_bar)
        total_timesteps, hooks = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        hooks.on_training_start(locals(), globals())
        loop, state = self._loop(), self._state_of(env.num_envs)
        starts = torch.ones(env.num_envs, dtype=torch.bool, device=self.device)
        while self.num_timesteps < total_timesteps:
            action, state = loop.act(state, self._tensor(self._last_obs), starts, self._generator)
            self._last_obs, _, dones, infos = env.step(self._to_env(action))  # type: ignore[assignment]
            self.num_timesteps += env.num_envs
            starts = torch.as_tensor(dones, device=self.device)
            state = self._live = loop.remember(state, self._tensor(self._last_obs), starts)
            self._update_info_buffer(infos, dones)
            hooks.update_locals(locals())
            if not hooks.on_step():
                break
            self._log_episodes(state, int(dones.sum()), log_interval)
        hooks.on_training_end()
        return self

    def _log_episodes(self, state: OnlineState, ended: int, log_interval: int) -> None:
        logged = self._episode_num // log_interval
        self._episode_num += ended
        if self._episode_num // log_interval == logged:
            return
        if self.ep_info_buffer:
            self.logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in self.ep_info_buffer]))
            self.logger.record("rollout/ep_rew_last", self.ep_info_buffer[-1]["r"])
        posterior = self.posterior(state)
        self.logger.record("adapt/situation", max(posterior, key=lambda name: posterior[name]), exclude="tensorboard")
        log_posterior(self.logger, posterior)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def predict(  # type: ignore[override]
        self,
        observation: Array | dict[str, Array],
        state: OnlineState | None = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[Array, OnlineState]:
        """Plans an action; with a ``state``, adapts as well.

        The state carries the memory and the adapted model, as a recurrent policy's carries its hidden state. Pass
        back what the last call returned, and every K steps the model is adapted to the last M transitions. Without
        a state, the agent acts on what it believes now: what :class:`FAMLEWrapper` or :meth:`learn` have taught it
        about this robot, or what it meta-learned.

        Args:
            observation: (obs_dim,) for one robot or (B, obs_dim) for B.
            state: What the last call returned, or None.
            episode_start: Whether each robot has just been reset, (B,). The transition across it is dropped.
            deterministic: Whether the planner draws the same candidates at each call, so that equal observations and
                states give equal actions. Without a state, an agent that has lived on a robot goes on from the plan of
                its last call.

        Returns:
            The actions, (action_dim,) or (B, action_dim), and the new state.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: The observation has the wrong shape or is not finite.
        """
        numbers = check_observation(observation, self.observation_space)
        obs, loop = self._tensor(np.atleast_2d(numbers)), self._loop()
        starts = torch.zeros(len(obs), dtype=torch.bool, device=self.device)
        if episode_start is not None:
            starts = torch.tensor(np.atleast_1d(episode_start), dtype=torch.bool, device=self.device)
        if len(starts) != len(obs) or (state is not None and state.robots != len(obs)):
            raise ValueError(
                f"Got {len(obs)} observations, but {len(starts)} values of episode_start and a state of "
                f"{len(obs) if state is None else state.robots} robots; they must be of the same robots."
            )
        generator = self._generator
        if deterministic:
            generator = torch.Generator(self.device).manual_seed(self.seed or 0)
        if state is None:
            action, state = loop.act(self._state_of(len(obs)), obs, starts, generator)
            if self._live is not None and self._live.robots == len(obs):
                self._live = replace(self._live, plan=state.plan)  # a loop that drops the state keeps its plan
        else:
            action, state = loop.act(loop.remember(state, obs, starts), obs, starts, generator)
        actions = self._to_env(action)
        return (actions[0] if numbers.ndim == 1 else actions), state

    def observe(self, obs: Array, action: Array, next_obs: Array) -> None:
        """Tells the agent of a transition of its robot; every K transitions it adapts.

        Args:
            obs: (obs_dim,) or (B, obs_dim).
            action: (action_dim,) or (B, action_dim), in the action space.
            next_obs: As ``obs``.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: A shape is wrong, or a value is not finite.
        """
        space = self.observation_space
        s, s_next = (self._tensor(np.atleast_2d(check_observation(o, space))) for o in (obs, next_obs))
        a = self._tensor(np.atleast_2d(check_action(action, self.action_space)))
        if not len(s) == len(a) == len(s_next):
            raise ValueError(f"Got {len(s)} observations, {len(a)} actions and {len(s_next)} next observations.")
        state = replace(self._state_of(len(s)), last=(s, self._action_scale().to_unit(a)))
        self._live = self._loop().remember(state, s_next, torch.zeros(len(s), dtype=torch.bool, device=self.device))

    def begin_episode(self) -> None:
        """Tells the agent that its robot was reset: its plan is void, its memory stays."""
        if self._live is not None:
            starts = torch.ones(self._live.robots, dtype=torch.bool, device=self.device)
            self._live = self._loop().reset(self._live, starts)

    def forget(self) -> None:
        """Returns to what was meta-learned, as for a robot that was just repaired."""
        self._live = None

    def serve(self, wrapper: object, takes_over: bool = True) -> None:
        """Notes whose robot the agent is on.

        Raises:
            RuntimeError: The agent serves another wrapper, and this one does not take over.
        """
        if takes_over:
            self._served = wrapper
        elif self._served is not wrapper:
            raise RuntimeError(
                "The agent has been taken over by another FAMLEWrapper. Call reset() to take it back, or give each "
                "robot an agent of its own: FAMLE.load(path)."
            )

    @property
    def belief(self) -> Belief:
        """What the agent believes of its robots now; of one robot where it has seen none."""
        return (self._live or self._state_of(1)).belief

    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """P(situation | memory) by name, of the first robot; of what the agent believes now, or of a state."""
        belief = self.belief if state is None else state.belief
        return dict(zip(self.situations, belief.posterior[0].tolist(), strict=True))

    def _loop(self) -> OnlineLoop:
        model = self._require_dynamics()
        return OnlineLoop(
            prior=self._prior,
            adapt=self._adapt,
            simulator=lambda belief: model.simulator(belief.theta, belief.h),
            reward_fn=self._unit_reward_fn(),
            planner=self.planner,
            adapt_every=self.hyperparameters.adapt_every,
            forget_at_reset=self.hyperparameters.forget_at_reset,
        )

    def _state_of(self, robots: int) -> OnlineState:
        """What the agent believes now where that fits the number of robots, else what it meta-learned."""
        if self._live is not None and self._live.robots == robots:
            return replace(self._live, last=None)
        model, M = self._require_dynamics(), self.hyperparameters.memory_size
        return self._loop().begin(Memory.empty(robots, M, model.obs_dim, model.action_dim, self.device))

    # --- saving and loading -----------------------------------------------------------------------------

    def save(self, path: File) -> None:  # type: ignore[override]
        """Writes the agent, what it believes now included, as JSON and safetensors in a zip; no pickle.

        The environment is named, not stored. A ``reward_fn`` given to the constructor is not stored either and has
        to be given to :meth:`load` again.

        Args:
            path: A path, ``.zip`` is appended where it has no suffix; or a binary file.
        """
        save_agent(self, path)

    @classmethod
    def load(  # type: ignore[override]
        cls,
        path: File,
        env: GymEnv | str | None = None,
        device: torch.device | str = "auto",
        reward_fn: RewardFn | None = None,
        **overrides: Any,
    ) -> Self:
        """Reads an agent that :meth:`save` wrote; it acts as the saved one would have. Runs no code from the file.

        Args:
            path: A path or a binary file.
            env: The environment; None makes the one that the file names, if that is registered.
            device: As in the constructor.
            reward_fn: As in the constructor; needed where the agent was made with one.
            **overrides: Settings to change, and ``verbose`` or ``tensorboard_log``.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, foreign or another kind of agent; the environment does not fit; a
                ``reward_fn`` is needed.
        """
        return load_agent(cls, path, env, device=device, reward_fn=reward_fn, **overrides)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ([] if self.dynamics is None else ["dynamics"]), []

    # --- small parts ------------------------------------------------------------------------------------

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

    def _unit_reward_fn(self) -> RewardFn:
        """The reward of actions in [-1, 1]."""
        known, scale = self._known_reward_fn(), self._action_scale()
        if known is not None:
            return lambda obs, action, next_obs: known(obs, scale.from_unit(action), next_obs)
        if self._learned_reward is None:
            raise ValueError("The agent has no reward; give load() the environment (env=...) or a reward_fn.")
        return self._learned_reward

    def _action_scale(self) -> ActionScale:
        return ActionScale(*self._tensors(self.action_space.low, self.action_space.high))

    def _to_env(self, action: Tensor) -> Array:
        """From [-1, 1] to the action space."""
        actions = self._action_scale().from_unit(action).cpu().numpy().astype(self.action_space.dtype)
        return np.clip(actions, self.action_space.low, self.action_space.high)

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
