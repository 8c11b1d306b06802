"""Rewards: what they are to a planner, and one that is learnt where an environment does not say how it rewards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from famle_agent.models.observation import ObservationLayout

__all__ = ["LearnedReward", "RewardFn"]

RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""r(s, a, s'): (..., obs_dim), (..., action_dim), (..., obs_dim) -> (...)."""


class LearnedReward(nn.Module):
    """r(s, a, s') as a network of its own, since a situation changes the dynamics and never the task.

    Args:
        layout: Of the observations. A pose counts here: a goal has a place.
        action_dim: Number of action dimensions.
        width: Width of the two hidden layers.
    """

    mean: Tensor
    std: Tensor
    reward_mean: Tensor
    reward_std: Tensor

    def __init__(self, layout: ObservationLayout, action_dim: int, width: int = 128) -> None:
        super().__init__()
        self._layout = replace(layout, pose_dims=())
        inputs = 2 * self._layout.n_features + action_dim
        self.layers = nn.Sequential(
            nn.Linear(inputs, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1)
        )
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("std", torch.ones(inputs))
        self.register_buffer("reward_mean", torch.zeros(()))
        self.register_buffer("reward_std", torch.ones(()))

    def forward(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        """The reward (...) of transitions (..., obs_dim), (..., action_dim), (..., obs_dim)."""
        x = (self._inputs(obs, action, next_obs) - self.mean) / self.std
        out: Tensor = self.layers(x)
        return out.squeeze(-1) * self.reward_std + self.reward_mean

    def fit(
        self,
        obs: Tensor,
        action: Tensor,
        next_obs: Tensor,
        reward: Tensor,
        generator: torch.Generator,
        steps: int = 2000,
        batch_size: int = 256,
    ) -> None:
        """Least squares by Adam on transitions with any leading axes."""
        x, y = self._inputs(obs, action, next_obs).flatten(0, -2), reward.flatten()
        self.mean.copy_(x.mean(dim=0))
        std = x.std(dim=0)
        self.std.copy_(torch.where(std > 1e-6, std, 1.0))  # what never changed must not be blown up
        self.reward_mean.copy_(y.mean())
        self.reward_std.copy_(y.std().clamp(min=1e-6))
        x, y = (x - self.mean) / self.std, (y - self.reward_mean) / self.reward_std
        optimizer = torch.optim.Adam(self.parameters(), lr=1e-3)
        with torch.enable_grad():
            for _ in range(steps):
                i = torch.randint(len(y), (batch_size,), generator=generator, device=generator.device).to(y.device)
                loss = (self.layers(x[i]).squeeze(-1) - y[i]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        self.requires_grad_(False)

    def _inputs(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return torch.cat([self._layout.features(obs), action, self._layout.features(next_obs)], dim=-1)
