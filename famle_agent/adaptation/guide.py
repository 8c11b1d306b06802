"""What a policy learnt in simulation tells the planner (line 4): plans to begin with, and values beyond their end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.models.actor_critic import ActorCritic
from famle_agent.models.reward import Objective
from famle_agent.models.simulator import Simulator
from famle_agent.planning import coloured_noise

__all__ = ["Guide"]


@dataclass(frozen=True)
class Guide:
    """Proposes what the actor would do in each likely situation, and values where a plan ends.

    What the actor would do in another situation than the most likely one is often better where nothing like the robot
    was trained; the planner judges all of it by the adapted model.

    Attributes:
        actor_critic: Learnt in simulation.
        situations: The most likely situations whose actor proposes, beside the one that is told nothing.
        noise: Deviation of a second proposal around each.
        noise_beta: Exponent of its spectrum.
    """

    actor_critic: ActorCritic
    situations: int = 10
    noise: float = 0.3
    noise_beta: float = 2.0

    def proposals(
        self, model: Simulator, obs: Tensor, likely: Tensor, horizon: int, generator: torch.Generator
    ) -> Tensor:
        """Rolls the actor through the adapted model, (B, 2 M, H, action_dim) for M situations.

        Args:
            model: The adapted dynamics of B robots.
            obs: Where the robots are, (B, obs_dim).
            likely: How likely each training situation is, (B, N).
            horizon: H.
            generator: Source of all the chance.
        """
        most = likely.topk(min(self.situations, likely.shape[1]), dim=1).indices
        told = torch.cat([torch.full_like(most[:, :1], -1), most], dim=1)  # (B, M)
        told = torch.cat([told, told], dim=1)  # (B, 2 M): as it is, and with noise
        B, rows = told.shape
        like = obs.new_zeros(B, horizon, model.action_dim)
        noise = self.noise * coloured_noise(like, rows // 2, self.noise_beta, generator)
        noise = torch.cat([torch.zeros_like(noise), noise], dim=1)  # (B, 2 M, H, action_dim)

        state, actions = obs[:, None].expand(-1, rows, -1), []
        for t in range(horizon):
            # Where the model has left the finite numbers, the actor says nothing.
            actions.append((self.actor_critic.act(state, told) + noise[:, :, t]).nan_to_num(0.0).clamp(-1.0, 1.0))
            if t + 1 < horizon:
                state = model(state, actions[-1]).mean(dim=1)  # of the ensemble
        return torch.stack(actions, dim=2)

    def looking_beyond(self, objective: Objective, likely: Tensor, model: Simulator) -> Objective:
        """Adds the critics' value of where a plan ends: the mean of the most likely situation's and of none's.

        Where nothing like the robot was trained, the value of a situation is too high where its own policy does not go.

        Args:
            objective: What counts until then.
            likely: How likely each training situation is, (B, N).
            model: The adapted dynamics of B robots.
        """
        likeliest = model.rows(likely.argmax(dim=1)[:, None])
        told = torch.stack([likeliest, torch.full_like(likeliest, -1)])[..., None]  # (2, B * P, 1)

        def value(obs: Tensor) -> Tensor:
            values = self.actor_critic.value(obs.expand(2, *obs.shape), told.expand(2, *obs.shape[:2]))
            return values.mean(dim=0)

        return replace(objective, value_fn=value, discount=float(self.actor_critic.discount))
