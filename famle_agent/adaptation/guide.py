"""What a policy learnt in simulation tells the planner (line 4): plans to begin with and to beat, and far sight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from famle_agent.models.actor_critic import ActorCritic
from famle_agent.models.reward import Objective
from famle_agent.models.simulator import Simulator
from famle_agent.planning import Judge, coloured_noise

__all__ = ["Guide"]


@dataclass(frozen=True)
class Guide:
    """Proposes what the actor would do in each likely situation, values where a plan ends, and judges plans.

    What the actor would do in another situation than the most likely one is often better where nothing like the robot
    was trained; the planner judges all of it by the adapted model. A planner finds what a model is wrong about. So a
    plan counts by how much better it is than what the actor would do that is told nothing, and by how sure that is.

    Attributes:
        actor_critic: Learnt in simulation.
        idle: The action that does nothing, (action_dim,).
        situations: The most likely situations whose actor proposes, beside the one that is told nothing.
        noise: Deviation of a second proposal around each.
        noise_beta: Exponent of its spectrum.
        caution: kappa, deviations among the members of the ensemble that an advantage is lowered by.
    """

    actor_critic: ActorCritic
    idle: Tensor
    situations: int = 10
    noise: float = 0.3
    noise_beta: float = 2.0
    caution: float = 1.0

    def proposals(
        self, model: Simulator, obs: Tensor, likely: Tensor, horizon: int, generator: torch.Generator
    ) -> Tensor:
        """Rolls the actor through the adapted model, (B, 2 M + 1, H, action_dim) for M situations.

        The last plan is to do nothing: a policy that has learnt little can be worse than that.

        Args:
            model: The adapted dynamics of B robots.
            obs: Where the robots are, (B, obs_dim).
            likely: How likely each training situation is, (B, N).
            horizon: H.
            generator: Source of all the chance.
        """
        most = likely.topk(min(self.situations, likely.shape[1]), dim=1).indices
        untold = self.actor_critic.untold
        told = torch.cat([untold.expand(len(most), 1, -1), one_hot(most, len(untold))], dim=1)  # (B, M, N)
        told = torch.cat([told, told], dim=1)  # (B, 2 M, N): as it is, and with noise
        B, rows, _ = told.shape
        like = obs.new_zeros(B, horizon, model.action_dim)
        noise = self.noise * coloured_noise(like, rows // 2, self.noise_beta, generator)
        noise = torch.cat([torch.zeros_like(noise), noise], dim=1)  # (B, 2 M, H, action_dim)

        state, actions = obs[:, None].expand(-1, rows, -1), []
        for t in range(horizon):
            # Where the model has left the finite numbers, the actor says nothing.
            actions.append((self.actor_critic.act(state, told) + noise[:, :, t]).nan_to_num(0.0).clamp(-1.0, 1.0))
            if t + 1 < horizon:
                state = model(state, actions[-1]).mean(dim=1)  # of the ensemble
        idle = self.idle.expand(B, 1, horizon, -1)
        return torch.cat([torch.stack(actions, dim=2), idle], dim=1)

    def looking_beyond(self, objective: Objective, shares: Tensor, model: Simulator) -> Objective:
        """Adds the critics' value of where a plan ends.

        Args:
            objective: What counts until then.
            shares: How much of each training situation the most likely candidate is, (B, N).
            model: The adapted dynamics of B robots.
        """
        told = model.rows(shares[:, None, None])  # (B * P, 1, N)
        value = partial(self.actor_critic.value, told=told)
        return replace(objective, value_fn=value, discount=float(self.actor_critic.discount))

    def judge(self, objective: Objective, model: Simulator, obs: Tensor, untold: Tensor) -> Judge:
        """Judges a plan tau by a lower bound of its advantage over the actor that is told nothing, pi.

        With J_m the return in member m of the ensemble,

            d_m(tau) = J_m(tau) - J_m(pi),    judge(tau) = mean_m d_m(tau) - kappa std_m d_m(tau).

        So pi has 0, and goes on where no plan is surely better. What all plans are wrong about alike cancels out. In a
        member that pi leads out of the finite numbers there is nothing to be better than, and J_m(tau) counts.

        Args:
            objective: What counts.
            model: The adapted dynamics of B robots.
            obs: Where they are, (B, obs_dim).
            untold: pi, the first of the :meth:`proposals`, (B, 1, H, action_dim).
        """
        of_policy = model.returns_of_members(objective, obs, untold)  # (B, P, 1)
        of_policy = torch.where(of_policy.isfinite(), of_policy, 0.0)

        def judged(tau: Tensor) -> Tensor:
            advantage = model.returns_of_members(objective, obs, tau) - of_policy  # (B, P, N)
            bound = advantage.mean(dim=1) - self.caution * advantage.std(dim=1, correction=0)
            return bound.nan_to_num(nan=-torch.inf, neginf=-torch.inf)

        return judged
