"""Models of some members of an ensemble."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from famle_agent.models.dynamics import Dynamics

__all__ = ["for_robots", "with_members"]


def with_members(model: Dynamics, count: int, first: int = 0) -> Dynamics:
    """Makes a model of ``count`` of the members, from the one of index ``first`` on.

    Raises:
        ValueError: There are not as many.
    """
    if model.robots > 1:
        raise ValueError("A model of robots with networks of their own has no members to give.")
    if not (1 <= count <= model.members and 0 <= first <= model.members - count):
        raise ValueError(f"The ensemble has 1 to {model.members} members to give, not {count} from {first} on.")
    return _with_networks(model, torch.arange(first, first + count))


def for_robots(model: Dynamics, networks: Sequence[int]) -> Dynamics:
    """Makes a model of as many robots, each of which has one of the members for its own network.

    Args:
        model: An ensemble that robots share.
        networks: The member of each robot.

    Raises:
        ValueError: There is no such member.
    """
    if model.robots > 1 or not all(0 <= network < model.members for network in networks):
        raise ValueError(f"There are members 0 to {model.members - 1} to give to robots, not {list(networks)}.")
    part = _with_networks(model, torch.tensor(networks))
    part.robots = len(networks)
    return part


def _with_networks(model: Dynamics, chosen: Tensor) -> Dynamics:
    part = copy.deepcopy(model)
    for name, value in model.theta.items():
        part.theta[name] = nn.Parameter(value.detach()[chosen].clone())
    part.embeddings = nn.Parameter(model.embeddings.detach()[chosen].clone())
    part.noise_std = model.noise_std[chosen].clone()
    return part
