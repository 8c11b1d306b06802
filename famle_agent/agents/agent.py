"""Living on a robot: adapting and planning all the time, with the face of Stable-Baselines3."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import as_file
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from torch import Tensor
from typing_extensions import Self

from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.controller import Adapter, Controller, OnlineState
from famle_agent.adaptation.memory import Memory
from famle_agent.agents.checkpoint import Checkpoint, File
from famle_agent.agents.presets import make_env
from famle_agent.agents.simulation import SimulationLearner
from famle_agent.agents.tensorboard import log_adaptations, log_posterior
from famle_agent.data.action_scaling import check_action, check_observation, to_action_space
from famle_agent.data.envs import env_attribute
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import prepare_torch
from famle_agent.models.reward import RewardFn
from famle_agent.planning import Planner

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["ModelBasedAgent"]

Array = npt.NDArray[Any]


class ModelBasedAgent(SimulationLearner):
    """An agent that learns a model in simulation, adapts it on the robot, and plans with it.

    Subclasses say how the model is learnt (:meth:`_learn_model`) and what adapts it (:meth:`_new_adapter`). Arguments
    as for :class:`~famle_agent.agents.algorithm.ModelBasedAlgorithm`.
    """

    planner: Planner
    _live: OnlineState | None
    _served: object

    def _setup_model(self) -> None:
        super()._setup_model()
        self.planner = self.hyperparameters.make_planner()
        self._live = self._served = None
        self._known_adapter: tuple[tuple[Any, ...], Adapter] | None = None
        self._warned_of_divergence = False
        if self.hyperparameters.adaptation(seen=1).steps:
            prepare_torch()

    @abstractmethod
    def _new_adapter(self, model: Dynamics) -> Adapter:
        """Makes what adapts a meta-learned model."""

    @property
    def adapter(self) -> Adapter:
        """What adapts the agent's model.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        model = self.model
        # A tensor counts how often it was written to: learning, loading and set_parameters change a model in place.
        version = model.embeddings._version  # noqa: SLF001 - the tensor's own count has no public name
        known = model, version, self.hyperparameters, self.seed
        if self._known_adapter is None or self._known_adapter[0] != known:
            self._known_adapter = known, self._new_adapter(model)
        return self._known_adapter[1]

    @property
    def controller(self) -> Controller:
        """Algorithm 2 with the agent's adapter, planner and reward.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: The agent has no reward.
        """
        settings = self.hyperparameters
        how = settings.adapt_every, settings.adapt_at_reset, settings.forget_at_reset
        return Controller(self.adapter, self.planner, self.unit_reward_fn(), *how)

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
        goes on from there, until :meth:`forget`. To callbacks each step is a rollout, as with an off-policy algorithm
        that learns at every step.

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
        controller, state = self.controller, self.state_of(env.num_envs)
        starts = torch.as_tensor(self._last_episode_starts, dtype=torch.bool, device=self.device)
        nobody = torch.zeros_like(starts)
        while self.num_timesteps < total_timesteps:
            hooks.on_rollout_start()
            action, state = controller.act(state, self._tensor(self._last_obs), starts, self.generator)
            new_obs, rewards, dones, infos = env.step(self._to_env(action))
            self.num_timesteps += env.num_envs
            reached = self._tensor(_before_reset(new_obs, dones, infos))
            state = self._live = self._observed(controller.observe(state, reached, nobody))
            self._last_obs, self._last_episode_starts = new_obs, dones  # type: ignore[assignment]
            starts = torch.as_tensor(dones, device=self.device)
            self._update_info_buffer(infos, dones)
            hooks.update_locals(locals())
            if not hooks.on_step():
                break
            hooks.on_rollout_end()
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
        log_posterior(self.logger, self.marginals(state))
        log_adaptations(self.logger, state.belief)
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
        controller = self.controller
        numbers = check_observation(observation, self.observation_space)
        obs = self._tensor(np.atleast_2d(numbers))
        starts = torch.zeros(len(obs), dtype=torch.bool, device=self.device)
        if episode_start is not None:
            starts = torch.tensor(np.atleast_1d(episode_start), dtype=torch.bool, device=self.device)
        if len(starts) != len(obs) or (state is not None and state.robots != len(obs)):
            raise ValueError(
                f"Got {len(obs)} observations, but {len(starts)} values of episode_start and a state of "
                f"{len(obs) if state is None else state.robots} robots; they must be of the same robots."
            )
        generator = self.generator
        if deterministic:
            generator = torch.Generator(self.device).manual_seed(self.seed or 0)
        if state is None:
            action, state = controller.act(self.state_of(len(obs)), obs, starts, generator)
            if self._live is not None and self._live.robots == len(obs):
                self._live = replace(self._live, plan=state.plan)  # a loop that drops the state keeps its plan
        else:
            action, state = controller.act(controller.observe(state, obs, starts), obs, starts, generator)
        self._observed(state)
        actions = self._to_env(action)
        return (actions[0] if numbers.ndim == 1 else actions), state

    def observe(self, obs: Array, action: Array, next_obs: Array) -> None:
        """Tells the agent of a transition of its robot; every K transitions it adapts.

        Args:
            obs: (obs_dim,) or (B, obs_dim).
            action: (action_dim,) or (B, action_dim); clipped to the action space, as a robot clips it.
            next_obs: As ``obs``.

        Raises:
            NotLearnedError: The agent has no model yet.
            ValueError: A shape is wrong, or a value is not finite.
        """
        controller, space = self.controller, self.observation_space
        s, s_next = (self._tensor(np.atleast_2d(check_observation(o, space))) for o in (obs, next_obs))
        a = self._tensor(np.atleast_2d(check_action(action, self.action_space)))
        if not len(s) == len(a) == len(s_next):
            raise ValueError(f"Got {len(s)} observations, {len(a)} actions and {len(s_next)} next observations.")
        state = replace(self.state_of(len(s)), last=(s, self._action_scale().to_unit(a).clamp(-1.0, 1.0)))
        moved = torch.zeros(len(s), dtype=torch.bool, device=self.device)
        self._live = self._observed(controller.observe(state, s_next, moved))

    def begin_episode(self) -> None:
        """Tells the agent that its robot was reset: its plan is void, its memory stays."""
        if self._live is not None:
            starts = torch.ones(self._live.robots, dtype=torch.bool, device=self.device)
            self._live = self._observed(self.controller.reset(self._live, starts))

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
        return (self._live or self.state_of(self.model.robots)).belief

    @abstractmethod
    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """P(situation | memory) by name, of the first robot; of what the agent believes now, or of a state."""

    @abstractmethod
    def marginals(self, state: OnlineState | None = None) -> dict[str, float]:
        """How likely each training situation is, alone or as a part of what is wrong; arguments as there."""

    def _observed(self, state: OnlineState) -> OnlineState:
        """Passes a state on, and warns of the first adaptation that diverged."""
        if not self._warned_of_divergence and state.belief.diverged.any():
            self._warned_of_divergence = True
            warnings.warn(
                f"Adaptation {state.belief.adaptations} diverged: its gradient steps left the finite numbers and were "
                "taken back. Take smaller rates (adapt_lr, adapt_embedding_lr), or meta-learn on data that reach where "
                'the robot is (action_hold, episode_length, rounds). info["famle"]["diverged"] and adapt/diverged '
                "count them from here on.",
                stacklevel=3,
            )
        return state

    def state_of(self, robots: int) -> OnlineState:
        """Returns what the agent believes now where that fits the number of robots, else what it meta-learned.

        Args:
            robots: B.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        if self._live is not None and self._live.robots == robots:
            return replace(self._live, last=None)
        model = self.model
        M, W = self.hyperparameters.memory_size, self.hyperparameters.selection_window
        belief = self.adapter.initial(robots)
        C = belief.log_posterior.shape[1]
        memory = Memory.empty(robots, M, model.obs_dim, model.action_dim, C, self.device, W)
        return self.controller.init(belief, memory)

    # --- saving and loading -----------------------------------------------------------------------------

    def save(self, path: File) -> None:  # type: ignore[override]
        """Writes the agent, what it believes now included, as JSON and safetensors in a zip; no pickle.

        The environment is named, not stored. A ``reward_fn`` given to the constructor is not stored either and has
        to be given to :meth:`load` again.

        Args:
            path: A path, ``.zip`` is appended where it has no suffix; or a binary file.
        """
        if not hasattr(self, "observation_space"):
            raise ValueError("This agent has no environment, so that there is nothing to save; make it with one.")
        live = self._live
        parts: dict[str, dict[str, Tensor]] = {
            "dynamics": {} if self.dynamics is None else self.dynamics.state_dict(),
            "reward": {} if self.learned_reward is None else self.learned_reward.state_dict(),
            "live": {} if live is None else live.to_tensors(),
            # The state of another device's generator means nothing elsewhere.
            "generator": {"state": self.generator.get_state()} if self.device.type == "cpu" else {},
        }
        Checkpoint(
            kind=type(self).__name__,
            mode=self.mode,
            hyperparameters=self.hyperparameters,
            observation_space=self.observation_space,
            action_space=self.action_space,
            dims=self.dims,
            situations=self.situations,
            env=self._env_spec,
            needs_reward_fn=self._reward_fn is not None,
            seed=self.seed,
            num_timesteps=self.num_timesteps,
            episodes=self._episode_num,
            live=None if live is None else live.counts,
            tensors={f"{part}/{name}": value for part, values in parts.items() for name, value in values.items()},
        ).write(path)

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
            env: The environment; None makes the one that the file names, if it is one of ``famle_envs``.
            device: As in the constructor.
            reward_fn: As in the constructor; needed where the agent was made with one.
            **overrides: Settings to change, and ``verbose`` or ``tensorboard_log``.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, foreign or another kind of agent; the environment does not fit; a
                ``reward_fn`` is needed.
        """
        if "mode" in overrides:
            raise ValueError(
                "A stored agent has all its settings, and no other mode; give load() the settings to change."
            )
        stored = Checkpoint.read(path)
        if stored.kind != cls.__name__:
            raise ValueError(
                f"The file is no FAMLE checkpoint of {cls.__name__} but of {stored.kind}; load it with "
                f"{stored.kind}.load()."
            )
        if stored.needs_reward_fn and reward_fn is None:
            raise ValueError(
                "The agent was made with a reward_fn, which no file can hold: give load(..., reward_fn=...)."
            )
        if (made := stored.make_env() if env is None else make_env(env)) is not None:
            stored.check_spaces(made)
        # All settings are in the file, so that its mode need not be known for this environment.
        settings = {**stored.hyperparameters.to_dict(), **stored.dims, **overrides}
        agent = cls(made, reward_fn=reward_fn, device=device, pretrained=False, **settings)
        agent.mode, agent.num_timesteps, agent._episode_num = stored.mode, stored.num_timesteps, stored.episodes
        if made is None:
            agent.observation_space, agent.action_space = stored.observation_space, stored.action_space
            agent.n_envs = 1
        agent.set_random_seed(stored.seed)
        agent._take_over(stored)
        agent.set_random_seed(overrides.get("seed"))
        return agent

    def restore(self, file: File) -> None:
        """Takes weights, belief and random numbers from the file of an agent with the same settings.

        Args:
            file: A path or a binary file.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is damaged, or its weights are of other settings.
        """
        self._take_over(Checkpoint.read(file))

    def take_model(self, file: File) -> list[str]:
        """Takes the model from a file, if that is of the same kind, environment and settings of learning.

        Args:
            file: A path or a binary file.

        Returns:
            In what the two differ; nothing where the model was taken.
        """
        stored = Checkpoint.read(file)
        differing = [] if stored.kind == type(self).__name__ else ["kind of agent"]
        if self._world(stored.env) != self._world(self._env_spec):
            differing.append("environment")
        differing += [name for name, dims in self.dims.items() if stored.dims[name] != dims]
        differing += stored.hyperparameters.learnt_otherwise(self.hyperparameters)
        if not differing:
            self._take_over(stored.model_alone())
        return differing

    def _take_over(self, stored: Checkpoint) -> None:
        known = self.situations, self.dynamics, self.learned_reward, self._live
        try:
            self.situations = stored.situations
            self._take_weights(stored)
            if stored.live is not None:
                self._live = self._online_state(stored, stored.live)
            if self.device.type == "cpu" and (generator := stored.part("generator")):
                self.generator.set_state(generator["state"])
        except (KeyError, RuntimeError, TypeError) as error:
            self.situations, self.dynamics, self.learned_reward, self._live = known  # nothing is half-taken
            raise ValueError(
                "The file's weights do not fit its settings; it is damaged, or an override changed the network: "
                f"{error}"
            ) from error

    def _take_weights(self, stored: Checkpoint) -> None:
        if weights := stored.part("dynamics"):
            robots = max(1, len(weights["embeddings"]) // self.hyperparameters.members)
            self.dynamics = self.new_dynamics(robots)
            self.dynamics.load_state_dict(weights)
        if weights := stored.part("reward"):
            self.learned_reward = self._new_reward()
            self.learned_reward.load_state_dict(weights)

    def _online_state(self, stored: Checkpoint, counts: dict[str, int]) -> OnlineState | None:
        settings = self.hyperparameters
        tensors = {name: value.to(self.device) for name, value in stored.part("live").items()}
        state = OnlineState.from_tensors(tensors, **counts)
        state = state.resized(settings.memory_size, settings.selection_window, settings.horizon)
        # With other candidates than the stored agent's, what it has seen cannot be judged by what it knew of them.
        begins = self.adapter.initial(state.robots)
        if state.belief.log_posterior.shape == begins.log_posterior.shape:
            return state
        warnings.warn(
            "What the stored agent believed of its robot is left behind: it told other situations apart than these "
            "settings do (compose). The agent begins with what it meta-learned.",
            stacklevel=4,
        )
        return None

    def _world(self, env: dict[str, Any] | None) -> dict[str, Any] | None:
        """What of an environment's description matters to a model of all its situations."""
        if env is None or self.env is None:
            return None
        other = env_attribute(self.env, "task_arguments", ())
        return {"id": env["id"], "kwargs": {key: value for key, value in env["kwargs"].items() if key not in other}}

    def _load_pretrained(self, file: Traversable) -> None:
        with as_file(file) as path:
            self._not_taken = self.take_model(path)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ([] if self.dynamics is None else ["dynamics"]), []

    def unit_reward_fn(self) -> RewardFn:
        """Returns the reward r(s, a, s') of actions in [-1, 1], the user's, the environment's or the learnt one.

        Raises:
            ValueError: The agent has no reward.
        """
        known, scale = self._known_reward_fn(), self._action_scale()
        if known is not None:
            return lambda obs, action, next_obs: known(obs, scale.from_unit(action), next_obs)
        if self.learned_reward is None:
            raise ValueError("The agent has no reward; give load() the environment (env=...) or a reward_fn.")
        return self.learned_reward

    def _to_env(self, action: Tensor) -> Array:
        """From [-1, 1] to the action space."""
        return to_action_space(action, self.action_space)


def _before_reset(obs: Any, dones: Array, infos: Sequence[Mapping[str, Any]]) -> Array:
    """Where robots have got to; of one whose episode has ended, ``obs`` is already the next one's start."""
    ended = [info["terminal_observation"] if done else own for own, done, info in zip(obs, dones, infos, strict=True)]
    return np.stack(ended)
