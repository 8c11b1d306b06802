"""A look at what was learnt: planned returns in simulation, against doing nothing and acting at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from famle_agent.data import gate
from famle_agent.data.envs import SituationEnvs

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
        situations: How many situations at most, evenly chosen.
    """
    chosen = np.unique(np.linspace(0, len(envs.sources) - 1, min(situations, len(envs.sources))).round().astype(int))
    sources = [envs.sources[i] for i in chosen]
    made = [source if isinstance(source, gym.Env) else source() for source in sources]
    space: Any = made[0].action_space
    rng, shape, state = np.random.default_rng(seed), (len(made), *space.shape), None
    errors = np.ones(len(made))

    def plan(obs: Array) -> Array:
        nonlocal errors, state
        action, state = agent.predict(obs, state, deterministic=True)
        errors = state.belief.errors.cpu().numpy()
        return np.asarray(action)

    try:
        actors: list[Callable[[Array], Array]] = [
            plan,
            lambda obs: np.broadcast_to(np.clip(0.0, space.low, space.high), shape),
            lambda obs: rng.uniform(space.low, space.high, shape),
        ]
        (planned, nothing, random), lasted = zip(*(_returns(made, act, seed, steps) for act in actors), strict=True)
    finally:
        for env, source in zip(made, sources, strict=True):
            if env is not source:
                env.close()
    return Check(tuple(envs.situations[i] for i in chosen), planned, nothing, random, errors, max(lasted))


def _returns(
    envs: Sequence[gym.Env[Any, Any]], act: Callable[[Array], Array], seed: int, steps: int
) -> tuple[Array, int]:
    """Returns what one episode in each environment yields, (n,), and the steps of the longest; the others wait."""
    obs = np.stack([gate.reset(env, seed=seed)[0] for env in envs]).astype(np.float32)
    total, lives, lasted = np.zeros(len(envs)), np.ones(len(envs), dtype=bool), 0
    while lasted < steps and lives.any():
        lasted += 1
        actions = act(obs).astype(envs[0].action_space.dtype)
        for i, env in enumerate(envs):
            if not lives[i]:
                continue
            step = gate.step(env, actions[i])
            obs[i] = step.obs
            total[i] += step.reward
            lives[i] = not (step.terminated or step.truncated)
    return total, lasted
