"""What an agent has learnt, and how it acts on it: the parts of Algorithm 2 for one kind of agent."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from famle_agent.adaptation.adapters import EmbeddingAdapter, GradientAdapter
from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.controller import Adapter, Controller
from famle_agent.adaptation.guide import Guide
from famle_agent.adaptation.library import Library
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.perception import Perception
from famle_agent.adaptation.senses import Sensors
from famle_agent.adaptation.state import OnlineState
from famle_agent.agents.config import Config
from famle_agent.agents.world_model import Interface, ModelBuilder, WorldModel
from famle_agent.data.objective import other_reward, planning_reward, planning_termination
from famle_agent.data.policies import reward_names
from famle_agent.data.probe import check_reward_fn, check_termination_fn
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.reward import Objective, RewardFn, TerminationFn
from famle_agent.utils.errors import NotLearnedError

__all__ = ["AdaptivePolicy"]


class AdaptivePolicy:
    """Plans with a model that is adapted all the time.

    Args:
        config: All settings.
        adapter_class: What adapts the model; a gradient adapter has no use for more than one embedding.
        device: Where models compute.
        reward_fn: The reward that the user has given; None takes the environment's or the learnt one.
        termination_fn: Where episodes end, as the user says; None takes the environment's or what was learnt.

    Attributes:
        robot: What the robot's observations and actions are; None where no robot is known yet.
        world: What was meta-learned; None before that.
        env_reward_fn: The environment's reward, if it names one.
        doubts_reward_fn: Whether a wrapper may change what the environment's reward is of, so that it only counts
            where none was learnt.
        env_termination_fn: The environment's ends of episodes, if it names them.
        not_taken: By what a shipped model differs from what was asked for.
        seed: Seed of the minibatches of an adaptation.
    """

    def __init__(
        self,
        config: Config,
        adapter_class: type[EmbeddingAdapter | GradientAdapter],
        device: torch.device,
        reward_fn: RewardFn | None,
        termination_fn: TerminationFn | None = None,
    ) -> None:
        self.config, self.adapter_class, self.device = config, adapter_class, device
        self.user_reward_fn, self.user_termination_fn = reward_fn, termination_fn
        self.robot: Interface | None = None
        self.world: WorldModel | None = None
        self.env_reward_fn: RewardFn | None = None
        self.doubts_reward_fn = False
        self.env_termination_fn: TerminationFn | None = None
        self.not_taken: list[str] = []
        self.seed = 0
        self._known_adapter: tuple[tuple[Any, ...], Adapter] | None = None

    @property
    def builder(self) -> ModelBuilder:
        """Makes models for the robot.

        Raises:
            ValueError: No robot is known.
        """
        if self.robot is None:
            raise ValueError("The agent has no environment, so that it knows no robot; make it with one.")
        shared = issubclass(self.adapter_class, GradientAdapter)
        return ModelBuilder(self.config.model, self.robot, self.device, shared)

    @property
    def model(self) -> Dynamics:
        """The meta-learned model.

        Raises:
            NotLearnedError: There is none yet.
        """
        if self.world is None:
            shipped = ""
            if self.not_taken and "kind of agent" not in self.not_taken:
                shipped = f" The model that is shipped has another {', '.join(self.not_taken)}."
            raise NotLearnedError(f"This agent has no model yet.{shipped} Call meta_learn() first, or load(path).")
        return self.world.dynamics

    @property
    @torch.inference_mode(mode=False)
    def adapter(self) -> Adapter:
        """What adapts the model.

        Raises:
            NotLearnedError: There is no model yet.
        """
        model = self.model
        # A tensor counts how often it was written to: learning, loading and set_parameters change a model in place.
        version = model.embeddings._version  # noqa: SLF001 - the tensor's own count has no public name
        known = model, version, self.config, self.seed
        if self._known_adapter is None or self._known_adapter[0] != known:
            self._known_adapter = known, self.adapter_class(model, self.config.adaptation, self.seed)
        return self._known_adapter[1]

    @property
    def controller(self) -> Controller:
        """Algorithm 2 with the agent's adapter, planner and reward.

        Raises:
            NotLearnedError: There is no model yet.
            ValueError: There is no reward.
        """
        adapter, how, world = self.adapter, self.config.adaptation, self.world
        objective, guide = Objective(self.unit_reward_fn(), self.known_termination_fn), None
        if world is not None and objective.termination_fn is None:
            objective = replace(objective, termination_fn=world.termination)
        if world is not None and world.actor_critic is not None:
            guide = Guide(world.actor_critic, self.idle_action)
        when = how.every, how.at_reset, how.forget_at_reset
        return Controller(adapter, self.config.planner, objective, *when, guide)

    @property
    def perception(self) -> Perception:
        """The controller on robots whose sensors may fail.

        Raises:
            NotLearnedError: There is no model yet.
            ValueError: There is no reward, or the safe action is none of the robot's.
        """
        safety, sensors = self.config.safety, Sensors.of(self.model, self.builder.robot.observation_space)
        blind_steps = self.config.planner.horizon if safety.blind_steps is None else safety.blind_steps
        return Perception(self.controller, sensors, blind_steps, self.idle_action, patient=bool(safety.safe_action))

    @property
    def idle_action(self) -> Tensor:
        """What is told to a robot without sensors, in [-1, 1], (action_dim,): the safe action, or what is nearest to 0.

        Raises:
            ValueError: The safe action does not lie in the action space.
        """
        space, safe = self.builder.robot.action_space, self.config.safety.safe_action
        action = np.array(safe) if safe else np.clip(np.zeros(space.shape), space.low, space.high)
        if action.shape != space.shape or not ((action >= space.low) & (action <= space.high)).all():
            raise ValueError(f"safe_action must be an action of {space}, got {list(safe)}.")
        return self.builder.action_scale.to_unit(self.builder.tensor(action)).clamp(-1.0, 1.0)

    def initial(self, robots: int) -> OnlineState:
        """Returns the state of B robots that have seen nothing.

        Raises:
            NotLearnedError: There is no model yet.
        """
        belief = self.adapter.initial(robots)
        return self.controller.init(belief, self._no_memory(belief))

    def _no_memory(self, belief: Belief) -> Memory:
        """The memory of robots that have seen nothing."""
        model, how, (robots, candidates) = self.model, self.config.adaptation, belief.log_posterior.shape
        sizes = how.memory_size, model.obs_dim, model.action_dim, candidates
        return Memory.empty(robots, *sizes, belief.log_posterior.device, how.window)

    def stored_state(self, tensors: dict[str, Tensor], counts: dict[str, int]) -> OnlineState | None:
        """Returns the state that a file holds, for the settings of now; None where they cannot go on from it.

        Raises:
            LookupError: Something is missing.
            RuntimeError: It is of another shape.
        """
        how = self.config.adaptation
        state = OnlineState.from_tensors({name: value.to(self.device) for name, value in tensors.items()}, **counts)
        state = state.resized(how.memory_size, how.window, self.config.planner.horizon, how.library_size)
        # With other candidates than the stored agent's, what it has seen cannot be judged by what it knew of them.
        belief = self.adapter.initial(state.robots)
        if state.belief.log_posterior.shape == belief.log_posterior.shape:
            memory, plan = self._no_memory(belief), belief.h.new_zeros(*state.plan.shape[:2], self.model.action_dim)
            if (library := state.belief.library) is not None:
                one = Library.of(belief.theta, belief.h, belief.candidate, memory, belief.candidate == 0)
                belief = replace(belief, library=one.repeated(library.full.shape[1]))
            _check_shapes(state, OnlineState(memory, belief, plan))
            return state
        warnings.warn(
            "What the stored agent believed of its robot is left behind: it told other situations apart than these "
            "settings do (compose). The agent begins with what it meta-learned.",
            stacklevel=5,
        )
        return None

    def take_task(self, env: VecEnv) -> None:
        """Looks in an environment for what to maximise and for where episodes end, unless the user has said it.

        Raises:
            ValueError: A function is none of batches, or what it would be given is changed by a wrapper.
        """
        if self.user_reward_fn is None:
            self.env_reward_fn, self.doubts_reward_fn = planning_reward(env, self.config.planning_reward)
        if self.user_termination_fn is None:
            self.env_termination_fn = planning_termination(env)
        robot = self.builder.robot
        if (reward_fn := self.user_reward_fn or self.env_reward_fn) is not None:
            check_reward_fn(reward_fn, robot.observation_space, robot.action_space, self.device)
        if (termination_fn := self.known_termination_fn) is not None:
            check_termination_fn(termination_fn, robot.observation_space, self.device)

    def check_task(self, env: gym.Env[Any, Any]) -> None:
        """Refuses a robot with another task than the policy plans for.

        Raises:
            ValueError: The robot's reward differs from that of the agent's environment.
        """
        known, robot = self.known_reward_fn, self.builder.robot
        if known is None or known is self.user_reward_fn:
            return
        names = reward_names(self.config.planning_reward)
        own = other_reward(env, known, names, robot.observation_space, robot.action_space)
        if own is not None:
            raise ValueError(
                f"The agent plans for the {own} of its own environment, which gives other rewards than that of the "
                "environment to be wrapped, because of its goal or of a wrapper: call agent.set_env(env) first, or "
                "give the agent a reward_fn."
            )

    @property
    def known_reward_fn(self) -> RewardFn | None:
        """The user's reward function, or the environment's; None where the learnt one counts."""
        if self.doubts_reward_fn and self.world is not None and self.world.reward is not None:
            return None
        return self.user_reward_fn or self.env_reward_fn

    @property
    def learns_reward(self) -> bool:
        """Whether meta-learning has to learn the reward, since nobody says it of what the agent sees."""
        return self.user_reward_fn is None and (self.env_reward_fn is None or self.doubts_reward_fn)

    @property
    def known_termination_fn(self) -> TerminationFn | None:
        """The user's ends of episodes, or the environment's; None where they have to be learnt."""
        return self.user_termination_fn or self.env_termination_fn

    def unit_reward_fn(self) -> RewardFn:
        """Returns the reward r(s, a, s') of actions in [-1, 1], the user's, the environment's or the learnt one.

        Raises:
            ValueError: There is no reward.
        """
        if (known := self.known_reward_fn) is not None:
            scale = self.builder.action_scale

            def in_model_units(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
                return known(obs, scale.from_unit(action), next_obs)

            return in_model_units
        if self.world is None or self.world.reward is None:
            raise ValueError("The agent has no reward; give load() the environment (env=...) or a reward_fn.")
        return self.world.reward


def _check_shapes(state: OnlineState, expected: OnlineState) -> None:
    """Refuses a state that is of other robots, or of another model.

    Raises:
        RuntimeError: It is.
    """
    shapes, fitting = ({name: value.shape for name, value in s.to_tensors().items()} for s in (state, expected))
    if differing := sorted(name for name in shapes.keys() | fitting.keys() if shapes.get(name) != fitting.get(name)):
        raise RuntimeError(f"What was believed has other shapes: {', '.join(differing)}.")
