"""An ant that is told its damage: a model that knows the very test robot as one situation more.

It is no upper line: FAMLE, which is told nothing, does better on most damages. Nor is a model of that robot alone,
however much it has seen of it, since what legs and floor do is the same in all situations. The shipped model learns
one round on, from the transitions of its own situations and as many of the test robot's; then it is told which of them
it is in.
"""

from __future__ import annotations

import copy
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.methods import from_cache, shipped, simulated_data
from benchmarks.task import Task
from famle_agent import FAMLE, Transitions
from famle_agent.agents.world_model import WorldModel
from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.models.dynamics import Dynamics

_IDENTIFIES = 300  # steps, after which FAMLE is sure of its embedding


def informed(task: Task) -> FAMLE:
    """FAMLE with one situation, the test robot's."""
    agent = FAMLE(task.simulated(), seed=task.seed, device="cpu", pretrained=False, compose=False)
    broken = str(task.situation).replace(" ", "_")
    return from_cache(agent, task.cache / f"{task.robot}-knows-{broken}.zip", partial(_learn_on, task=task))


def _learn_on(agent: FAMLE, task: Task) -> None:
    others, (model, h) = simulated_data(task), _as_famle_begins(task)
    alone, policy = (task.situation.label,), agent.policy
    policy.world = WorldModel(_with_embeddings(model, h), alone)
    all_of_them = _beside(others, _of_the_test_robot(agent, task, others.obs.shape[1]))

    known = _with_embeddings(model, torch.cat([model.embeddings.detach(), h], dim=1))
    data = known.encode(*policy.builder.tensors(policy.builder.in_model_units(all_of_them)))
    for _ in policy.config.trainer(1, last=False).fit(known, data, agent.generator):
        pass
    policy.world = WorldModel(_with_embeddings(known, known.embeddings.detach()[:, -1:]), alone)


def _as_famle_begins(task: Task) -> tuple[Dynamics, Tensor]:
    """The shipped model, and the embedding that FAMLE takes for the test robot's, (P, 1, embedding_dim)."""
    agent = shipped(task)
    agent.set_env(task.make())
    agent.learn(_IDENTIFIES)
    return agent.model, agent.belief.h[0][:, None]


def _of_the_test_robot(agent: FAMLE, task: Task, n: int) -> Transitions:
    """As many transitions, of which the agent plans as large a part as of its training situations."""
    simulation, robot, name = agent.config.simulation, [task.make], agent.situations
    planned = n * simulation.planned // (simulation.transitions_per_situation + simulation.planned)
    random = collect(robot, name, n - planned, make_held_uniform(simulation.action_hold), seed=0)
    return random.followed_by(collect(robot, name, planned, agent.planning_policy(), seed=1))


def _beside(some: Transitions, others: Transitions) -> Transitions:
    """Transitions of more situations."""
    names = ("obs", "action", "reward", "next_obs")
    arrays = {name: np.concatenate([getattr(some, name), getattr(others, name)]) for name in names}
    return Transitions(**arrays, situations=(*some.situations, *others.situations))


def _with_embeddings(model: Dynamics, embeddings: Tensor) -> Dynamics:
    model = copy.deepcopy(model)
    model.embeddings = torch.nn.Parameter(embeddings.clone())
    return model
