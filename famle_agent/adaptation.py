"""Algorithm 2 of the paper: the most likely embedding, then k gradient steps on theta and h."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.dynamics import Batch, Dynamics, Theta, expand
from famle_agent.inner_loop import InnerLoop

__all__ = ["Belief", "Memory", "adapt", "prior", "situation_log_likelihood"]


@dataclass(frozen=True)
class Memory:
    """D_M, the last M transitions of B robots, oldest first. Immutable: :meth:`add` returns a new one.

    Attributes:
        obs: (B, M, obs_dim).
        action: In [-1, 1], (B, M, action_dim).
        next_obs: (B, M, obs_dim).
        weight: 1 for a transition, 0 for a place that is empty yet, (B, M).
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    weight: Tensor

    @classmethod
    def empty(cls, robots: int, size: int, obs_dim: int, action_dim: int, device: torch.device) -> Memory:
        """A memory of ``size`` M for B robots that have seen nothing."""
        obs = torch.zeros(robots, size, obs_dim, device=device)
        scalar = torch.zeros(robots, size, device=device)
        return cls(obs, torch.zeros(robots, size, action_dim, device=device), obs, scalar)

    def resized(self, size: int) -> Memory:
        """The newest ``size`` places, with empty ones in front where there are fewer."""

        def fit(values: Tensor) -> Tensor:
            empty = values.new_zeros(len(values), size, *values.shape[2:])
            return torch.cat([empty, values], dim=1)[:, -size:]

        return Memory(fit(self.obs), fit(self.action), fit(self.next_obs), fit(self.weight))

    def add(self, obs: Tensor, action: Tensor, next_obs: Tensor, valid: Tensor) -> Memory:
        """Inserts one transition per robot where ``valid`` (B,), and drops that robot's oldest."""

        def push(old: Tensor, new: Tensor) -> Tensor:
            moved = torch.cat([old[:, 1:], new[:, None]], dim=1)
            return torch.where(valid.view(-1, *[1] * (old.ndim - 1)), moved, old)

        return Memory(
            push(self.obs, obs),
            push(self.action, action),
            push(self.next_obs, next_obs),
            push(self.weight, torch.ones_like(valid, dtype=obs.dtype)),
        )


@dataclass(frozen=True)
class Belief:
    """What B robots believe about their situation.

    Attributes:
        theta: theta*, stacked parameters.
        h: h*, (B, embedding_dim).
        log_likelihood: Sum over the memory of log p(s' | s, a, h) for each training situation, (B, N).
        adaptations: How often the robots have adapted.
    """

    theta: Theta
    h: Tensor
    log_likelihood: Tensor
    adaptations: int = 0

    @property
    def posterior(self) -> Tensor:
        """P(situation | memory) under a uniform prior, (B, N)."""
        return torch.softmax(self.log_likelihood, dim=1)

    def is_finite(self) -> Tensor:
        """For which robots all parameters are finite numbers, (B,)."""
        values = [value.flatten(start_dim=1) for value in (*self.theta.values(), self.h)]
        return torch.cat(values, dim=1).isfinite().all(dim=1)

    def where(self, kept: Tensor, other: Belief) -> Belief:
        """This belief for the robots in ``kept`` (B,), and the other one for the rest."""

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(kept.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)

        theta = {name: choose(value, other.theta[name]) for name, value in self.theta.items()}
        likelihood = choose(self.log_likelihood, other.log_likelihood)
        return Belief(theta, choose(self.h, other.h), likelihood, self.adaptations)


def prior(model: Dynamics, robots: int) -> Belief:
    """What B robots believe before they have seen anything: theta_meta, and the first situation's embedding."""
    theta = expand(model.parameters_by_name(), robots)
    h = model.embeddings.detach()[0].expand(robots, -1)
    return Belief(theta, h, torch.zeros(robots, model.n_situations, device=h.device))


@torch.no_grad()
def adapt(model: Dynamics, memory: Memory, inner_loop: InnerLoop, belief: Belief) -> Belief:
    """Lines 6 and 7 of Algorithm 2 for B robots at once.

    Args:
        model: Holds theta_meta and H_meta.
        memory: D_M.
        inner_loop: k steps of gradient descent; where they diverge, theta_meta and the embedding stay.
        belief: The belief until now; of it only the number of adaptations lives on.
    """
    data = model.encode(memory.obs, memory.action, memory.next_obs, memory.weight)

    # h_likely = argmax log p(D_M | theta_meta, h) over H_meta (line 6).
    log_likelihood = situation_log_likelihood(model, data)
    h_likely = model.embeddings[log_likelihood.argmax(dim=1)]

    # theta*, h* = k steps from theta_meta, h_likely (line 7).
    start = Belief(expand(model.parameters_by_name(), len(h_likely)), h_likely, log_likelihood, belief.adaptations + 1)
    theta, h, _ = inner_loop(model, start.theta, start.h, lambda: data)
    adapted = replace(start, theta=theta, h=h)
    return adapted.where(adapted.is_finite(), start)  # steps that diverged are no steps


@torch.no_grad()
def situation_log_likelihood(model: Dynamics, data: Batch) -> Tensor:
    """Log p(D | theta_meta, h) of the data of B robots for each of the N embeddings, (B, N)."""
    robots, n = data.weight.shape
    situations = model.n_situations
    # Every robot's data side by side in each situation's network: N networks, B * n rows.
    rows = Batch(
        *(
            value.reshape(1, robots * n, *value.shape[2:]).expand(situations, -1, *value.shape[2:])
            for value in (data.x, data.y, data.weight)
        )
    )
    theta = expand(model.parameters_by_name(), situations)
    log_p = model.log_likelihood(theta, model.embeddings, rows)
    # An observation beyond all measure would make every likelihood -inf and the posterior meaningless.
    return log_p.view(situations, robots, n).sum(dim=2).T.clamp(min=-1e30)
