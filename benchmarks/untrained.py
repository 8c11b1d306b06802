"""Robots and agents to time: intact robots, agents whose models know nothing, and what such agents have lived."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from benchmarks.task import Task
from famle_agent import FAMLE
from famle_agent.adaptation.state import OnlineState
from famle_agent.agents.presets import known_robots
from famle_agent.agents.world_model import WorldModel
from famle_agent.data.policies import MakeBatchPolicy, MakePolicy, Policy

__all__ = ["SITUATIONS", "agent_of", "experienced", "one_by_one", "robot_of", "taking_in"]

SITUATIONS = 20
"""Embeddings of a model, where no other number is asked for."""


def robot_of(name: str, engine: str = Task.engine) -> gym.Env[Any, Any]:
    """Makes an intact robot that stands at its start."""
    env = gym.make(known_robots()[name].env_id, engine=engine)
    env.reset(seed=0)
    return env


def agent_of(robot: str, mode: str = "ours", situations: int = SITUATIONS, **settings: Any) -> FAMLE:
    """Makes an agent with an untrained model."""
    agent = FAMLE(robot_of(robot), mode, seed=0, device="cpu", pretrained=False, **settings)
    model = agent.policy.builder.dynamics(situations)
    agent.policy.world = WorldModel(model, tuple(f"situation {i}" for i in range(situations)))
    return agent


def one_by_one(plans: MakeBatchPolicy) -> MakePolicy:
    """Has a policy of several situations act for one at a time."""

    def make(env: gym.Env[Any, Any], situation: int, rng: np.random.Generator) -> Policy:
        policy = plans([env], [situation], rng)
        return lambda obs, episode_start: policy(obs[None], np.array([episode_start]))[0]

    return make


def experienced(agent: FAMLE, robots: int) -> OnlineState:
    """Makes the state of robots whose memory is full."""
    state, chance = agent.policy.initial(robots), torch.Generator().manual_seed(0)

    def some(like: Tensor) -> Tensor:
        return 0.1 * torch.randn(like.shape, generator=chance)

    old = state.memory
    memory = replace(
        old,
        obs=some(old.obs),
        action=some(old.action),
        next_obs=some(old.next_obs),
        weight=torch.ones_like(old.weight),
    )
    return replace(state, memory=memory, last=(memory.obs[:, -1], memory.action[:, -1]))


def taking_in(agent: FAMLE) -> Callable[[], object]:
    """Has a robot take in a transition: judged by each candidate, remembered, and the posterior updated."""
    state = experienced(agent, 1)
    obs, goes_on = state.memory.obs[:, -1], torch.zeros(1, dtype=torch.bool)
    return partial(torch.no_grad()(agent.controller.observe), state, obs, goes_on)
