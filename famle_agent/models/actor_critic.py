"""What to do in each situation and what it is worth, as learnt in simulation: a planner's candidates and far sight."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

__all__ = ["ActorCritic", "Features"]

_FAR = 10.0  # deviations beyond which an observation says no more


class Features(nn.Module):
    """Puts products of an observation s and a situation c behind both: (s, c) -> (s, c, (U s) * (V c)).

    What a situation does to an observation, as a sensor that is turned does, is linear in them, where a network that is
    given s and c alone has to learn it piecewise. Where c is 0, nothing is told, and the products are 0.

    Args:
        obs_dim: Size of s.
        n_situations: Size of c.
        rank: Number of products.
    """

    def __init__(self, obs_dim: int, n_situations: int, rank: int) -> None:
        super().__init__()
        self.obs_dim = obs_dim
        self.size = obs_dim + n_situations + rank
        self.of_obs = nn.Linear(obs_dim, rank, bias=False, dtype=torch.float32)
        self.of_situation = nn.Linear(n_situations, rank, bias=False, dtype=torch.float32)

    def forward(self, x: Tensor) -> Tensor:
        """(..., obs_dim + n_situations) -> (..., obs_dim + n_situations + rank)."""
        s, c = x[..., : self.obs_dim], x[..., self.obs_dim :]
        return torch.cat([x, self.of_obs(s) * self.of_situation(c)], dim=-1)


class ActorCritic(nn.Module):
    """An actor and critics that are told how much of each situation it is, and see :class:`Features` of both.

    In training that is a one-hot vector c = e_i. Two faults at once are c = e_i + e_j - e_0, as of embeddings.

    Args:
        obs_dim: Number of observation dimensions.
        action_dim: Number of action dimensions.
        n_situations: N.
        hidden: Width of each hidden layer.
        critics: Number of critics.
        interaction_rank: Products of observation and situation that the actor sees, and others that the critics see.

    Attributes:
        mean: Of what is put in, observation and c; inputs are normalised.
        std: Its deviation.
        value_scale: What the critics' values are to be multiplied by to be sums of rewards.
        discount: gamma of these sums.
    """

    mean: Tensor
    std: Tensor
    value_scale: Tensor
    discount: Tensor

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        n_situations: int,
        hidden: Sequence[int] = (192, 192),
        critics: int = 2,
        interaction_rank: int = 36,
    ) -> None:
        super().__init__()
        self.obs_dim, self.n_situations = obs_dim, n_situations
        inputs = obs_dim + n_situations
        self.actor_features = Features(obs_dim, n_situations, interaction_rank)
        self.critic_features = Features(obs_dim, n_situations, interaction_rank)
        seen = self.actor_features.size
        self.actor = mlp([seen, *hidden, action_dim])
        self.critics = nn.ModuleList(mlp([seen + action_dim, *hidden, 1]) for _ in range(critics))
        self.register_buffer("mean", torch.zeros(inputs, dtype=torch.float32))
        self.register_buffer("std", torch.ones(inputs, dtype=torch.float32))
        self.register_buffer("value_scale", torch.ones((), dtype=torch.float32))
        self.register_buffer("discount", torch.ones((), dtype=torch.float32))

    @property
    def untold(self) -> Tensor:
        """What is told of a robot whose situation is not known, (N,): the mean of all, so that 0 is put in."""
        return self.mean[self.obs_dim :]

    def act(self, obs: Tensor, told: Tensor) -> Tensor:
        """Returns the actor's mean action in [-1, 1], (..., action_dim), for (..., obs_dim) and c, (..., N)."""
        return self._act(self._inputs(obs, told))

    def value(self, obs: Tensor, told: Tensor) -> Tensor:
        """Returns the discounted sum of rewards that the actor expects from here on, (...): a mean of the critics."""
        x = self._inputs(obs, told)
        x = torch.cat([self.critic_features(x), self._act(x)], dim=-1)
        values = torch.stack([critic(x)[..., 0] for critic in self.critics])
        return values.mean(dim=0) * self.value_scale

    def _act(self, x: Tensor) -> Tensor:
        action: Tensor = self.actor(self.actor_features(x))
        return action.tanh()

    def _inputs(self, obs: Tensor, told: Tensor) -> Tensor:
        x = torch.cat([obs, told.expand(*obs.shape[:-1], -1)], dim=-1)
        return ((x - self.mean) / self.std).clamp(-_FAR, _FAR)


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Makes layers with rectifiers between them, as Stable-Baselines3 does."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out, dtype=torch.float32), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
