"""What chooses the actions while transitions are simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from famle_agent.data.action_scaling import ActionScale, to_action_space
from famle_agent.data.wrappers import robot_layers
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.reward import Objective, RewardFn, TerminationFn
from famle_agent.models.simulator import Simulator
from famle_agent.planning import Planner, shift

__all__ = [
    "REWARDS",
    "BatchPolicy",
    "HeldUniformPolicy",
    "MakeBatchPolicy",
    "MakePolicy",
    "PlanningPolicy",
    "Policy",
    "make_held_uniform",
    "make_planning",
    "reward_names",
]

Array = npt.NDArray[Any]

_CANDIDATES_AT_ONCE = 640
"""Of all networks together: with more, what they compute leaves the processor's cache, and is no faster."""


class Policy(Protocol):
    """Chooses actions."""

    def __call__(self, obs: Array, episode_start: bool) -> Array:
        """Chooses the action for an observation, in the environment's action space."""


class BatchPolicy(Protocol):
    """Chooses the actions of B robots at once."""

    def __call__(self, obs: Array, episode_start: Array) -> Array:
        """Chooses actions (B, action_dim) in the environments' action space, for observations (B, obs_dim)."""


REWARDS = ("planning_reward_fn", "reward_fn")
"""What an environment may call the function that a planner should maximise; the first that it has counts."""


def reward_names(named: str) -> tuple[str, ...]:
    """What to ask an environment for: the function that was named, else the first of :data:`REWARDS` that it has."""
    return (named,) if named else REWARDS


def _reward_of(env: gym.Env[Any, Any], names: Sequence[str]) -> RewardFn:
    """The first function of these names that an environment has.

    Raises:
        ValueError: It has none, or a wrapper changes what it is of.
    """
    name = next((name for name in names if env.has_wrapper_attr(name)), None)
    changed = [] if name is None else [layer.name for layer in robot_layers(env, name)]
    if name is None or changed:
        why = f"is of what {', '.join(changed)} changes" if changed else "is missing"
        raise ValueError(
            f"The {name or ' or '.join(names)} of the simulated environment {env} {why}, and planning there needs it: "
            "give the agent a reward_fn."
        )
    reward_fn: RewardFn = env.get_wrapper_attr(name)
    return reward_fn


MakePolicy = Callable[[gym.Env[Any, Any], int, np.random.Generator], Policy]
"""A policy for an environment and the index of its situation; picklable where data are collected in processes."""


@runtime_checkable
class MakeBatchPolicy(Protocol):
    """Makes a policy for several situations, which are simulated side by side."""

    @property
    def batch_size(self) -> int:
        """How many situations at most."""

    def __call__(
        self, envs: Sequence[gym.Env[Any, Any]], situations: Sequence[int], rng: np.random.Generator
    ) -> BatchPolicy:
        """Makes the policy of environments with the same spaces, given the index of each one's situation."""


class HeldUniformPolicy:
    """Uniformly random actions, each held for some steps.

    ``hold=1`` are the paper's independent actions. Held ones carry a robot further from its start for the
    same number of steps.
    """

    def __init__(self, action_space: gym.spaces.Box, hold: int, rng: np.random.Generator) -> None:
        self._space, self._hold, self._rng = action_space, hold, rng
        self._age = 0
        self._action: Array | None = None

    def __call__(self, obs: Array, episode_start: bool) -> Array:
        """The held action, or a new one when its time is over or an episode begins."""
        if episode_start or self._action is None or self._age >= self._hold:
            self._action, self._age = self._rng.uniform(self._space.low, self._space.high), 0
        self._age += 1
        return self._action.astype(self._space.dtype)


class PlanningPolicy:
    """The agent's own planning for B robots, with a model that does not change."""

    def __init__(
        self,
        model: Simulator,
        objective: Objective,
        planner: Planner,
        action_space: gym.spaces.Box,
        generator: torch.Generator,
    ) -> None:
        self._model, self._objective = model, objective
        self._planner, self._space, self._generator = planner, action_space, generator
        self._plan: Tensor | None = None

    @torch.no_grad()
    def __call__(self, obs: Array, episode_start: Array) -> Array:
        """Plans from where the last plans left off, and anew where an episode begins; see :class:`BatchPolicy`."""
        state = torch.as_tensor(obs, dtype=torch.float32)  # (B, obs_dim)
        if self._plan is None:
            self._plan = state.new_zeros(len(state), self._planner.horizon, *self._space.shape)
        start = torch.where(torch.as_tensor(episode_start)[:, None, None], 0.0, self._plan)

        def judge(tau: Tensor) -> Tensor:
            return self._model.returns(self._objective, state, tau)

        action, plan = self._planner.plan(judge, start, self._generator)
        self._plan = shift(plan)
        return to_action_space(action, self._space)


@dataclass(frozen=True)
class make_held_uniform:  # noqa: N801 (a function with arguments bound, which can be pickled)
    """Makes a :class:`HeldUniformPolicy`.

    Attributes:
        hold: Steps that an action is held.
    """

    hold: int

    def __call__(self, env: gym.Env[Any, Any], situation: int, rng: np.random.Generator) -> Policy:
        """See :data:`MakePolicy`."""
        return HeldUniformPolicy(env.action_space, self.hold, rng)  # type: ignore[arg-type]


@dataclass(frozen=True)
class make_planning:  # noqa: N801
    """Makes a :class:`PlanningPolicy` of robots that are simulated side by side, which knows their situations.

    Attributes:
        model: On the CPU.
        planner: Looks for the actions.
        reward_fn: r(s, a, s') for actions of the environment; None takes the environment's own.
        rewards: What the environment may call its own; the first that it has counts.
        termination_fn: Where episodes end; None knows of no ends.
    """

    model: Dynamics
    planner: Planner
    reward_fn: RewardFn | None
    rewards: tuple[str, ...] = REWARDS
    termination_fn: TerminationFn | None = None

    @property
    def batch_size(self) -> int:
        """As many situations as keep a processor busy; no more, so that others are left for other processes."""
        return max(1, _CANDIDATES_AT_ONCE // (self.model.members * self.planner.candidates))

    @torch.no_grad()
    def __call__(
        self, envs: Sequence[gym.Env[Any, Any]], situations: Sequence[int], rng: np.random.Generator
    ) -> PlanningPolicy:
        """See :class:`MakeBatchPolicy`."""
        space: Any = envs[0].action_space
        scale = ActionScale.of(space, torch.device("cpu"))
        model = Simulator(self.model, self.model.embeddings_of(torch.tensor(situations)))
        in_env_units = self.reward_fn or _joint_reward([_reward_of(env, self.rewards) for env in envs], model)

        def reward_fn(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
            return in_env_units(obs, scale.from_unit(action), next_obs)

        generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
        return PlanningPolicy(model, Objective(reward_fn, self.termination_fn), self.planner, space, generator)


def _joint_reward(rewards: Sequence[RewardFn], model: Simulator) -> RewardFn:
    """Asks each robot's own reward function, which may know of a goal that others do not have."""
    if all(reward is rewards[0] for reward in rewards):
        return rewards[0]

    def reward_fn(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        of_robots = (model.of_robots(values).unbind() for values in (obs, action, next_obs))  # B times (P, n, dim)
        own = [
            torch.as_tensor(reward(*transition), dtype=obs.dtype).expand(transition[0].shape[:2])
            for reward, *transition in zip(rewards, *of_robots, strict=True)
        ]
        return model.rows(torch.stack(own))

    return reward_fn
