"""What robots believe about their situation, and the model theta*, h* that they have adapted to it: a value."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.library import Library, either
from famle_agent.models.dynamics import Dynamics, Theta

__all__ = ["Belief", "Evidence", "choose", "prior", "unadapted"]


@dataclass(frozen=True)
class Evidence:
    """What one transition of each of B robots says about which candidate it is.

    Attributes:
        residual: Errors of each candidate in fitted deviations, (B, P, C, obs_dim).
        log_p: Its log-likelihood under each candidate, (B, C).
        own_log_p: And under the adapted model, (B,).
        library_log_p: And under each model of the library, (B, L); None where it was not judged, or there is none.
    """

    residual: Tensor
    log_p: Tensor
    own_log_p: Tensor
    library_log_p: Tensor | None = None


@dataclass(frozen=True)
class Belief:
    """What B robots believe about their situation, and the model that they have adapted to it.

    Attributes:
        theta: theta*, in each of the P members of the ensemble, (B, P, ...).
        h: h*, (B, P, embedding_dim).
        log_posterior: Log P(candidate | memory) but for a constant, (B, C).
        bias: b, the part of each candidate's errors that lasts, in fitted deviations, (B, P, C, obs_dim).
        excess: e, mean square of the rest of the robot's errors in each observed number, (B, obs_dim).
        candidate: The candidate with which theta* and h* began, (B,).
        diverged: How many adaptations of each robot left the finite numbers and were taken back, (B,).
        recognised: Whether theta* and h* began with a model of the library, since the robot is as it was before, (B,).
        adaptations: How often the robots have adapted.
        library: What they had learnt before they changed; None where that is nothing.
    """

    theta: Theta
    h: Tensor
    log_posterior: Tensor
    bias: Tensor
    excess: Tensor
    candidate: Tensor
    diverged: Tensor
    recognised: Tensor
    adaptations: int = 0
    library: Library | None = None

    @property
    def posterior(self) -> Tensor:
        """P(candidate | memory), (B, C)."""
        return torch.softmax(self.log_posterior, dim=1)

    @property
    def errors(self) -> Tensor:
        """Root mean square of what is new in each robot's errors, in fitted deviations, (B,)."""
        return self.excess.mean(dim=1).sqrt()

    @property
    def noise(self) -> Tensor:
        """v, squared noise of each robot, (B, 1, 1, obs_dim); what was fitted in simulation is the least."""
        return self.excess.clamp(min=1.0)[:, None, None]

    def of(self, robot: int) -> Belief:
        """The belief about one robot alone, as of B = 1."""
        theta = {name: value[robot : robot + 1] for name, value in self.theta.items()}
        rows: dict[str, Any] = {name: value[robot : robot + 1] for name, value in self._rows.items()}
        library = None if self.library is None else self.library.of_robot(robot)
        return replace(self, theta=theta, library=library, **rows)

    def judged(self, evidence: Evidence, moved: Tensor) -> Belief:
        """The same with what the newest transition of the robots that ``moved`` (B,) says about the library.

        Where an adapter has not judged the library, it says nothing: the models count as good as the adapted one.
        """
        if self.library is None:
            return self
        log_p = evidence.library_log_p
        if log_p is None:
            log_p = evidence.own_log_p[:, None].expand(self.library.full.shape)
        return replace(self, library=self.library.judged(log_p, moved))

    def is_finite(self) -> Tensor:
        """Says for which robots all parameters are finite numbers, (B,)."""
        values = torch.cat([value.flatten(1) for value in (*self.theta.values(), self.h)], dim=1)
        return values.abs().amax(dim=1).isfinite()  # far faster than to ask each number

    def where(self, kept: Tensor, other: Belief) -> Belief:
        """Takes this belief for the robots in ``kept`` (B,), and the other one for the rest."""
        if (everyone := bool(kept.all())) or not kept.any():  # as nearly always; copying networks each step costs time
            return replace(self if everyone else other, adaptations=self.adaptations)
        theta = {name: choose(kept, value, other.theta[name]) for name, value in self.theta.items()}
        rows: dict[str, Any] = {name: choose(kept, value, getattr(other, name)) for name, value in self._rows.items()}
        return replace(self, theta=theta, library=either(kept, self.library, other.library), **rows)

    @property
    def _rows(self) -> dict[str, Tensor]:
        """The fields that have a row for each robot, but theta."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


def prior(model: Dynamics, candidates: Candidates, robots: int) -> Belief:
    """Returns what B robots believe before they have seen anything: theta_meta, and the first situation's embedding."""
    return unadapted(model, candidates.log_prior, robots)


def unadapted(model: Dynamics, log_prior: Tensor, robots: int) -> Belief:
    """Returns theta_meta and the first embedding for B robots, with the log prior (C,) of what there is to select."""
    none = torch.zeros(robots, dtype=torch.long, device=model.embeddings.device)
    bias = log_prior.new_zeros(robots, model.members, len(log_prior), model.obs_dim)
    theta, h, excess = model.theta_of(robots), model.embeddings_of(none), bias.new_ones(robots, model.obs_dim)
    log_posterior, recognised = log_prior.expand(robots, -1), torch.zeros_like(none, dtype=torch.bool)
    return Belief(theta, h, log_posterior, bias, excess, candidate=none, diverged=none, recognised=recognised)


def choose(kept: Tensor, mine: Tensor, theirs: Tensor) -> Tensor:
    """Takes ``mine`` where ``kept`` is set, else ``theirs``; it has the first axes of both."""
    if mine is theirs:  # as the networks are wherever only the posterior changes; copying them at each step costs time
        return mine
    return torch.where(kept.view(*kept.shape, *[1] * (mine.ndim - kept.ndim)), mine, theirs)
