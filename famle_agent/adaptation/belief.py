"""What robots believe about their situation: the embeddings that come into question, and how likely each of them is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from famle_agent.adaptation.memory import Memory
from famle_agent.models.dynamics import Batch, Dynamics, Theta

__all__ = [
    "Belief",
    "Candidates",
    "Evidence",
    "choose",
    "filtered_posterior",
    "prior",
    "systematic_sample",
    "unadapted",
    "updated_bias",
    "updated_excess",
    "window_posterior",
]


_KINDS = (0.4, 0.4, 0.2)  # how likely no fault is, one, and two
_BELIEVED = 10.0  # transitions for which the noise that was fitted in simulation counts
_REMEMBERED = 100.0  # and over which the squares of a robot's errors are averaged
_LASTING = 10.0  # and those over which an error that lasts is told from what is new in it


@dataclass(frozen=True)
class Candidates:
    """The embeddings among which the most likely one is selected: those of the training situations, and their sums.

    Where h enters a model linearly, h_i + h_j - h_0 is the situation with both faults, if h_0 is the intact robot.

    Attributes:
        h: (R, P, C, embedding_dim), those of the N training situations first; R is 1 where robots share networks.
        pairs: What each consists of, (C, 2): the situations i and j; j = 0 where it is i alone.
    """

    h: Tensor
    pairs: Tensor

    @classmethod
    def of(cls, model: Dynamics, compose: bool) -> Candidates:
        """Takes H_meta, and with ``compose`` the sums of two situations other than the first, the intact robot."""
        n = model.n_situations
        alone = torch.stack([torch.arange(n), torch.zeros(n, dtype=torch.long)], dim=1)
        both = torch.combinations(torch.arange(1, n)) if compose else alone[:0]
        pairs = torch.cat([alone, both]).to(model.embeddings.device)
        H = model.embeddings_for(model.robots)
        h = H[:, :, pairs[:, 0]] + H[:, :, pairs[:, 1]] - H[:, :, :1]
        return cls(h, pairs)

    @cached_property
    def log_prior(self) -> Tensor:
        """How likely each is before anything is seen, (C,); probabilities that sum to 1.

        Without sums all are alike, as in the paper. With them the intact robot is as likely as all single faults
        together, and twice as likely as all sums.
        """
        faults = (self.pairs > 0).sum(dim=1)  # of each candidate
        if int(faults.max()) < 2:
            return self.h.new_zeros(len(faults)).log_softmax(dim=0)
        kind = self.h.new_tensor(_KINDS) / faults.bincount()
        return kind[faults].log().log_softmax(dim=0)

    def marginal(self, posterior: Tensor) -> Tensor:
        """Computes how likely each training situation is, alone or as a part: (B, C) -> (B, N)."""
        n = int((self.pairs[:, 1] == 0).sum())
        total = posterior.clone()[:, :n]
        both, (i, j) = posterior[:, n:], self.pairs[n:].T
        return total.index_add(1, i, both).index_add(1, j, both)

    def names(self, situations: Sequence[str]) -> list[str]:
        """Names the candidates, given the names of the training situations."""
        return [situations[i] if j == 0 else f"{situations[i]} + {situations[j]}" for i, j in self.pairs.tolist()]

    def chosen(self, index: Tensor) -> Tensor:
        """Takes a candidate for each robot, (B, 1), or for each member, (B, P), as (B, P, embedding_dim)."""
        h = self.h.expand(len(index), *self.h.shape[1:])  # (B, P, C, embedding_dim)
        return h.take_along_dim(index.expand(h.shape[:2])[..., None, None], dim=2)[:, :, 0]

    def log_likelihood(self, model: Dynamics, data: Batch) -> Tensor:
        """Computes log p(s' | s, a, theta_meta, h) of transitions for each candidate, a mean over the ensemble.

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots, (B, n).

        Returns:
            (B, n, C); 0 for padding.
        """
        residual = self.residuals(model, data)
        log_p = model.log_density(residual.flatten(2, 3)).view(len(residual), *residual.shape[2:4])
        return log_p * data.weight[..., None]

    def residuals(self, model: Dynamics, data: Batch) -> Tensor:
        """Computes the errors of theta_meta with each candidate in fitted deviations, (B, P, n, C, obs_dim).

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots, (B, n).
        """
        robots, n = data.weight.shape
        owners, C = model.robots, len(self.pairs)
        sharing = robots // owners  # B robots share the networks, or each has its own

        # The data of all robots that share a network under each candidate, side by side.
        def rows(values: Tensor) -> Tensor:
            flat = values.reshape(owners, 1, sharing * n, *values.shape[2:])
            return flat.expand(owners, C, *flat.shape[2:]).flatten(1, 2)  # (R, C * sharing * n, ...)

        h = self.h.repeat_interleave(sharing * n, dim=2)
        batch = Batch(rows(data.x), rows(data.y), rows(data.weight))
        residual = model.residuals(batch, h, model.theta_of(owners))  # (R, P, C * sharing * n, obs_dim)
        parts = residual.view(*residual.shape[:2], C, sharing, n, -1)
        return parts.permute(0, 3, 1, 4, 2, 5).flatten(0, 1)


@dataclass(frozen=True)
class Evidence:
    """What one transition of each of B robots says.

    Attributes:
        residual: Errors of each candidate in fitted deviations, (B, P, C, obs_dim).
        log_p: Its log-likelihood under each candidate, (B, C).
        own_log_p: And under the adapted model, (B,).
    """

    residual: Tensor
    log_p: Tensor
    own_log_p: Tensor


@dataclass(frozen=True)
class Belief:
    """What B robots believe about their situation, and the model that they have adapted to it.

    Attributes:
        theta: theta*, in each of the P members of the ensemble, (B, P, ...).
        h: h*, (B, P, embedding_dim).
        log_posterior: Log P(candidate | memory) but for a constant, (B, C).
        bias: The part of each candidate's errors that lasts, in fitted deviations, (B, P, C, obs_dim).
        excess: Mean square of the rest of the robot's errors in each observed number, (B, obs_dim).
        candidate: The candidate with which theta* and h* began, (B,).
        diverged: How many adaptations of each robot left the finite numbers and were taken back, (B,).
        adaptations: How often the robots have adapted.
    """

    theta: Theta
    h: Tensor
    log_posterior: Tensor
    bias: Tensor
    excess: Tensor
    candidate: Tensor
    diverged: Tensor
    adaptations: int = 0

    @property
    def posterior(self) -> Tensor:
        """P(candidate | memory), (B, C)."""
        return torch.softmax(self.log_posterior, dim=1)

    @property
    def errors(self) -> Tensor:
        """Root mean square of what is new in each robot's errors, in fitted deviations, (B,)."""
        return self.excess.mean(dim=1).sqrt()

    def of(self, robot: int) -> Belief:
        """The belief about one robot alone, as of B = 1."""
        theta = {name: value[robot : robot + 1] for name, value in self.theta.items()}
        names = ("h", "log_posterior", "bias", "excess", "candidate", "diverged")
        return replace(self, theta=theta, **{name: getattr(self, name)[robot : robot + 1] for name in names})

    def is_finite(self) -> Tensor:
        """Says for which robots all parameters are finite numbers, (B,)."""
        values = [value.flatten(1) for value in (*self.theta.values(), self.h)]
        return torch.cat(values, dim=1).isfinite().all(dim=1)

    def where(self, kept: Tensor, other: Belief) -> Belief:
        """Takes this belief for the robots in ``kept`` (B,), and the other one for the rest."""
        return Belief(
            {name: choose(kept, value, other.theta[name]) for name, value in self.theta.items()},
            choose(kept, self.h, other.h),
            choose(kept, self.log_posterior, other.log_posterior),
            choose(kept, self.bias, other.bias),
            choose(kept, self.excess, other.excess),
            choose(kept, self.candidate, other.candidate),
            choose(kept, self.diverged, other.diverged),
            self.adaptations,
        )


def prior(model: Dynamics, candidates: Candidates, robots: int) -> Belief:
    """Returns what B robots believe before they have seen anything: theta_meta, and the first situation's embedding."""
    return unadapted(model, candidates.log_prior, robots)


def unadapted(model: Dynamics, log_prior: Tensor, robots: int) -> Belief:
    """Returns theta_meta and the first embedding for B robots, with the log prior (C,) of what there is to select."""
    none = torch.zeros(robots, dtype=torch.long, device=model.embeddings.device)
    bias = log_prior.new_zeros(robots, model.members, len(log_prior), model.obs_dim)
    theta, h, excess = model.theta_of(robots), model.embeddings_of(none), bias.new_ones(robots, model.obs_dim)
    return Belief(theta, h, log_prior.expand(robots, -1), bias, excess, candidate=none, diverged=none)


def window_posterior(candidates: Candidates, memory: Memory) -> Tensor:
    """Computes log P(candidate | D_W) but for a constant, (B, C): the paper's likelihood of the last transitions."""
    return candidates.log_prior + (memory.log_p * memory.judging[..., None]).sum(dim=1)


def filtered_posterior(candidates: Candidates, log_posterior: Tensor, log_p: Tensor, hazard: float) -> Tensor:
    """Computes log P(candidate | all transitions) of a robot that may break at any step, (B, C).

    The forward filter of a hidden Markov model whose state is redrawn from the prior with probability ``hazard``. A
    window has to forget the robot as it was before it believes in its damage; the filter believes as soon as the
    new evidence outweighs the hazard.

    Args:
        candidates: Have a prior.
        log_posterior: After the transitions before, (B, C).
        log_p: Log-likelihood of the newest transition under each candidate, (B, C).
        hazard: Probability of a change per step.
    """
    stays = log_posterior.log_softmax(dim=1) + math.log1p(-hazard)
    return (torch.logaddexp(stays, candidates.log_prior + math.log(hazard)) + log_p).log_softmax(dim=1)


def updated_bias(bias: Tensor, residual: Tensor, seen: Tensor) -> Tensor:
    """Averages the errors of each candidate over the last ten transitions, (B, P, C, obs_dim).

    A model that is wrong in the same way at each step says so at each step, and a posterior that takes this for as
    many independent observations becomes sure of whatever candidate happens to balance the error best. What is
    evidence is how errors change with what the robot does.

    Args:
        bias: Their mean before.
        residual: Of the newest transition.
        seen: How many transitions there were, (B,).
    """
    return torch.lerp(bias, residual, (1.0 / seen.clamp(1.0, _LASTING))[:, None, None, None])


def updated_excess(excess: Tensor, squared: Tensor, seen: Tensor) -> Tensor:
    """Averages squared errors over what a robot has seen, the newest hundred above all, (B, obs_dim).

    Args:
        excess: Their mean before, (B, obs_dim).
        squared: Of the newest transition, (B, obs_dim).
        seen: How many transitions there were, (B,).
    """
    return torch.lerp(excess, squared, (1.0 / (_BELIEVED + seen.clamp(max=_REMEMBERED)))[:, None])


def systematic_sample(posterior: Tensor, n: int, offset: float) -> Tensor:
    """Draws n candidates for each robot, (B, n), each about n times its probability often.

    Systematic resampling, as in a particle filter: the candidates at the quantiles (i + offset) / n.

    Args:
        posterior: (B, C).
        n: Size of the sample.
        offset: In [0, 1).
    """
    descending, order = posterior.sort(dim=1, descending=True, stable=True)
    at = (torch.arange(n, device=posterior.device, dtype=posterior.dtype) + offset) / n
    index = torch.searchsorted(descending.cumsum(dim=1), at.expand(len(posterior), n).contiguous(), right=True)
    return order.gather(1, index.clamp(max=posterior.shape[1] - 1))


def choose(kept: Tensor, mine: Tensor, theirs: Tensor) -> Tensor:
    """Takes ``mine`` where ``kept`` is set, else ``theirs``; it has the first axes of both."""
    if mine is theirs:  # as the networks are wherever only the posterior changes; copying them at each step costs time
        return mine
    return torch.where(kept.view(*kept.shape, *[1] * (mine.ndim - kept.ndim)), mine, theirs)
