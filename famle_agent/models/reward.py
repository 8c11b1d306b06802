"""What a planner maximises, and what of it is learnt where an environment does not say it: rewards and ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from famle_agent.models.observation import ObservationLayout
from famle_agent.models.scale import deviations

__all__ = ["LearnedReward", "LearnedTermination", "Objective", "RewardFn", "TerminationFn"]

RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
"""r(s, a, s'): (..., obs_dim), (..., action_dim), (..., obs_dim) -> (...)."""

TerminationFn = Callable[[Tensor], Tensor]
"""Whether an episode ends in s', (..., obs_dim) -> (...)."""


@dataclass(frozen=True)
class Objective:
    """The return of a plan: sum of gamma^t r until an episode ends, and a value of where the plan does.

    Attributes:
        reward_fn: The reward of a transition.
        termination_fn: Whether an episode ends in an observation; None where none ends by itself.
        value_fn: What is still to come, (K, N, obs_dim) -> (K, N); None looks no further than the plan.
        discount: gamma.
    """

    reward_fn: RewardFn
    termination_fn: TerminationFn | None = None
    value_fn: Callable[[Tensor], Tensor] | None = None
    discount: float = 1.0


def _two_hidden_layers(inputs: int, width: int) -> nn.Sequential:
    sizes = ((inputs, width), (width, width), (width, 1))
    first, second, last = (nn.Linear(*size, dtype=torch.float32) for size in sizes)
    return nn.Sequential(first, nn.SiLU(), second, nn.SiLU(), last)


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
        self.layers = _two_hidden_layers(inputs, width)
        self.register_buffer("mean", torch.zeros(inputs, dtype=torch.float32))
        self.register_buffer("std", torch.ones(inputs, dtype=torch.float32))
        self.register_buffer("reward_mean", torch.zeros((), dtype=torch.float32))
        self.register_buffer("reward_std", torch.ones((), dtype=torch.float32))

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
        self.std.copy_(deviations(x))
        self.reward_mean.copy_(y.mean())
        self.reward_std.copy_(deviations(y[:, None])[0])
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


class LearnedTermination(nn.Module):
    """Whether an episode ends in s', as a network of its own.

    Args:
        layout: Of the observations.
        width: Width of the two hidden layers.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, layout: ObservationLayout, width: int = 128) -> None:
        super().__init__()
        self._layout = replace(layout, pose_dims=())
        inputs = self._layout.n_features
        self.layers = _two_hidden_layers(inputs, width)
        self.register_buffer("mean", torch.zeros(inputs, dtype=torch.float32))
        self.register_buffer("std", torch.ones(inputs, dtype=torch.float32))

    def forward(self, next_obs: Tensor) -> Tensor:
        """Returns whether an episode ends, (...), in observations (..., obs_dim)."""
        logit: Tensor = self.layers((self._layout.features(next_obs) - self.mean) / self.std)
        return logit[..., 0] > 0.0

    @torch.enable_grad()
    def fit(
        self, next_obs: Tensor, ended: Tensor, generator: torch.Generator, steps: int = 2000, batch_size: int = 256
    ) -> None:
        """Learns from observations with any leading axes; a quarter of each batch are ends, of which there are few."""
        x, y = self._layout.features(next_obs).flatten(0, -2), ended.flatten().float()
        self.mean.copy_(x.mean(dim=0))
        self.std.copy_(deviations(x))
        x, ends = (x - self.mean) / self.std, torch.where(y > 0.0)[0]
        optimizer = torch.optim.Adam(self.parameters(), lr=1e-3)
        for _ in range(steps):
            sizes = batch_size - batch_size // 4, batch_size // 4
            any_, some = (
                torch.randint(n, (size,), generator=generator, device=generator.device).to(y.device)
                for n, size in zip((len(y), len(ends)), sizes, strict=True)
            )
            i = torch.cat([any_, ends[some]])
            loss = nn.functional.binary_cross_entropy_with_logits(self.layers(x[i])[:, 0], y[i])
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        self.requires_grad_(False)
