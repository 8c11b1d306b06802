"""What robots believe about their situation, and the model that they have adapted to it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from famle_agent.adaptation.candidates import Candidates
from famle_agent.models.dynamics import Batch, Dynamics, Theta

__all__ = ["Belief", "choose", "prior", "unadapted"]


@dataclass(frozen=True)
class Belief:
    """What B robots believe about their situation, in each of the P members of the ensemble.

    Attributes:
        theta: theta*, stacked parameters, (B * P, ...).
        h: h*, (B * P, embedding_dim).
        log_posterior: Log P(candidate | memory) but for a constant, (B, C).
        candidate: The candidate with which theta* and h* began, (B,).
        diverged: How many adaptations of each robot left the finite numbers and were taken back, (B,).
        adaptations: How often the robots have adapted.
    """

    theta: Theta
    h: Tensor
    log_posterior: Tensor
    candidate: Tensor
    diverged: Tensor
    adaptations: int = 0

    @property
    def posterior(self) -> Tensor:
        """P(candidate | memory), (B, C)."""
        return torch.softmax(self.log_posterior, dim=1)

    def log_likelihood(self, model: Dynamics, data: Batch) -> Tensor:
        """Log p(s' | s, a, theta*, h*) of the encoded data of the B robots, a mean over the ensemble, (B, n)."""
        rows = Batch(*(values.repeat_interleave(model.members, dim=0) for values in (data.x, data.y, data.weight)))
        log_p = model.log_likelihood(self.theta, self.h, rows)
        return log_p.view(len(self.log_posterior), model.members, -1).mean(dim=1).clamp(min=-1e30)

    def is_finite(self) -> Tensor:
        """For which robots all parameters are finite numbers, (B,)."""
        robots = len(self.log_posterior)
        values = [value.reshape(robots, -1) for value in (*self.theta.values(), self.h)]
        return torch.cat(values, dim=1).isfinite().all(dim=1)

    def where(self, kept: Tensor, other: Belief) -> Belief:
        """This belief for the robots in ``kept`` (B,), and the other one for the rest."""

        def pick(mine: Tensor, theirs: Tensor) -> Tensor:
            return choose(kept.repeat_interleave(len(mine) // len(kept)), mine, theirs)

        theta = {name: pick(value, other.theta[name]) for name, value in self.theta.items()}
        log_posterior = pick(self.log_posterior, other.log_posterior)
        candidate, diverged = pick(self.candidate, other.candidate), pick(self.diverged, other.diverged)
        return Belief(theta, pick(self.h, other.h), log_posterior, candidate, diverged, self.adaptations)


def prior(model: Dynamics, candidates: Candidates, robots: int) -> Belief:
    """What B robots believe before they have seen anything: theta_meta, and the first situation's embedding."""
    return unadapted(model, candidates.log_prior, robots)


def unadapted(model: Dynamics, log_prior: Tensor, robots: int) -> Belief:
    """Returns theta_meta and the first embedding for B robots, with the log prior (C,) of what there is to select."""
    none = torch.zeros(robots, dtype=torch.long, device=model.embeddings.device)
    log_prior = log_prior.expand(robots, -1)
    return Belief(model.theta_of(robots), model.embeddings_of(none), log_prior, candidate=none, diverged=none)


def choose(rows: Tensor, mine: Tensor, theirs: Tensor) -> Tensor:
    """``mine`` where the row is marked, else ``theirs``."""
    return torch.where(rows.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)
