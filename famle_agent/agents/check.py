"""A look at what was learnt: planned returns in simulation, against doing nothing and acting at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from famle_agent.data import gate
from famle_agent.data.envs import SituationEnvs, opened
from famle_agent.utils.errors import in_situation

__all__ = ["Check", "check_plans"]

Array = npt.NDArray[Any]


class Plans(Protocol):
    """An agent, as far as the check knows it."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Plans for all robots at once."""


@dataclass(frozen=True)
class Check:
    """Returns of one episode in some of the training situations.

    Attributes:
        situations: What they are called.
        planned: Of the agent, which is told nothing, (n,).
        nothing: Of actions that are 0, or the nearest to it, (n,).
        random: Of actions at random, (n,).
        errors: Of the agent's predictions in the end, see :attr:`~famle_agent.adaptation.belief.Belief.errors`, (n,).
        steps: How long the longest episode lasted.
    """

    situations: tuple[str, ...]
    planned: Array
    nothing: Array
    random: Array
    errors: Array
    steps: int

    @property
    def worth(self) -> bool:
        """Whether planning is better than both in most situations."""
        return bool(np.mean(self.planned > np.maximum(self.nothing, self.random)) > 0.5)

    def __str__(self) -> str:
        width = max(len(name) for name in self.situations)
        rows = zip(self.situations, self.planned, self.nothing, self.random, strict=True)
        head = f"{f'return of {self.steps} steps':{width}}  {'planned':>9} {'nothing':>9} {'random':>9}"
        return "\n".join([head, *(f"{name:{width}}  {p:9.1f} {n:9.1f} {r:9.1f}" for name, p, n, r in rows)])


def check_plans(agent: Plans, envs: SituationEnvs, seed: int, steps: int = 200, situations: int = 8) -> Check:
    """Lets an agent live one episode in its training situations, side by side, and two others that know nothing.

    Args:
        agent: Adapts and plans; it is told nothing.
        envs: The training situations.
        seed: Of the episodes and the random actions.
        steps: Steps of an episode at most.
        situations: How many situations at most, evenly chosen; all of them are planned in one batch.

    Raises:
        Exception: What an environment raises, with a note that names the situation.
    """
    chosen = np.unique(np.linspace(0, len(envs.sources) - 1, min(situations, len(envs.sources))).round().astype(int))
    names, errors = tuple(envs.situations[i] for i in chosen), np.ones(len(chosen))
    rng, state = np.random.default_rng(seed), None

    def plan(obs: Array) -> Array:
        nonlocal errors, state
        action, state = agent.predict(obs, state, deterministic=True)
        errors = state.belief.errors.cpu().numpy()
        return np.asarray(action)

    with ExitStack() as stack:
        made = [stack.enter_context(opened(envs.sources[i], envs.situations[i])) for i in chosen]
        space: Any = made[0].action_space
        shape = len(made), *space.shape
        actors: list[Callable[[Array], Array]] = [
            plan,
            lambda obs: np.broadcast_to(np.clip(0.0, space.low, space.high), shape),
            lambda obs: rng.uniform(space.low, space.high, shape),
        ]
        returns = [_returns(made, names, act, seed, steps) for act in actors]
    (planned, nothing, random), lasted = zip(*returns, strict=True)
    return Check(names, planned, nothing, random, errors, max(lasted))


def _returns(
    envs: Sequence[gym.Env[Any, Any]], names: Sequence[str], act: Callable[[Array], Array], seed: int, steps: int
) -> tuple[Array, int]:
    """Returns what one episode in each environment yields, (n,), and the steps of the longest; the others wait."""
    total, lives, lasted = np.zeros(len(envs)), np.ones(len(envs), dtype=bool), 0
    obs = np.empty((len(envs), *(envs[0].observation_space.shape or ())), dtype=np.float32)
    for i, env in enumerate(envs):
        with in_situation(names[i]):
            obs[i] = gate.reset(env, seed=seed)[0]
    while lasted < steps and lives.any():
        lasted += 1
        actions = act(obs).astype(envs[0].action_space.dtype)
        for i, env in enumerate(envs):
            if not lives[i]:
                continue
            with in_situation(names[i]):
                step = gate.step(env, actions[i])
            obs[i] = step.obs
            total[i] += step.reward
            lives[i] = not (step.terminated or step.truncated)
    return total, lasted
