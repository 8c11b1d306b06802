"""Stable-Baselines3's own agents, trained in simulation without a model: what one would use instead."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from famle_agent.data.action_scaling import to_action_space
from famle_agent.models.actor_critic import ActorCritic
from famle_agent.training.policy_search import PolicySearch, Search

__all__ = ["MODEL_FREE", "ModelFree", "Policy", "as_policy"]

Make = Callable[[], gym.Env[Any, Any]]
Policy = Callable[[Any], Any]
"""Returns an action for an observation."""


@dataclass(frozen=True)
class ModelFree:
    """An agent that is told nothing of the situation, neither in training nor afterwards.

    Attributes:
        algorithm: ``"sac"`` with the settings of FAMLE's own policy search, or ``"ppo"`` with its own defaults.
        budget: Simulated steps, as a multiple of FAMLE's.
        intact: Whether it is trained on the intact robot alone, instead of on all training situations.
    """

    algorithm: str
    budget: int = 1
    intact: bool = False

    def learn(self, train: Mapping[str, Make], settings: PolicySearch, seed: int) -> Policy:
        """Trains it.

        Args:
            train: The training situations, the intact robot first.
            settings: FAMLE's policy search.
            seed: Of all the chance.
        """
        makes = list(train.values())[: 1 if self.intact else None]
        settings = replace(settings, steps=self.budget * settings.steps, untold=1.0)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return _sac(makes, settings, seed) if self.algorithm == "sac" else _ppo(makes, settings.steps, seed)


MODEL_FREE: Mapping[str, ModelFree] = {
    "sac": ModelFree("sac"),
    "sac-10x": ModelFree("sac", budget=10),
    "sac-intact": ModelFree("sac", intact=True),
    "ppo": ModelFree("ppo"),
    "ppo-10x": ModelFree("ppo", budget=10),
    "ppo-intact": ModelFree("ppo", intact=True),
}
"""The agents by name."""


def as_policy(actor_critic: ActorCritic, space: spaces.Box) -> Policy:
    """Lets an actor act that is told nothing of the situation."""

    @torch.no_grad()
    def act(obs: Any) -> Any:
        numbers = torch.as_tensor(np.asarray(obs), dtype=torch.float32)
        return to_action_space(actor_critic.act(numbers, actor_critic.untold), space)

    return act


def _sac(makes: Sequence[Make], settings: PolicySearch, seed: int) -> Policy:
    search = Search(settings, makes, [str(i) for i in range(len(makes))], seed)
    for _ in search.run():
        pass
    search.close()
    return as_policy(search.actor_critic(), search.action_space)


def _ppo(makes: Sequence[Make], steps: int, seed: int) -> Policy:
    def monitored(make: Make) -> Make:
        return lambda: Monitor(make())

    envs = VecNormalize(DummyVecEnv([monitored(make) for make in makes]))
    agent = PPO("MlpPolicy", envs, n_steps=max(64, 2048 // len(makes)), seed=seed, device="cpu")
    agent.learn(steps)
    envs.close()

    def act(obs: Any) -> Any:
        return agent.predict(envs.normalize_obs(np.asarray(obs)), deterministic=True)[0]

    return act
