"""Algorithm 2 of the paper: the most likely embedding, then k gradient steps on theta and h.

Beside the embeddings of the training situations, their sums can be candidates too: where h enters a model linearly,
h_i + h_j - h_0 is the situation with both faults, if h_0 is the intact robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.dynamics import Batch, Dynamics, Theta
from famle_agent.inner_loop import Anchor, InnerLoop
from famle_agent.memory import Memory, Sample, whole_memory

__all__ = [
    "Belief",
    "Candidates",
    "adapt",
    "better_explained",
    "descend",
    "filtered_posterior",
    "prior",
    "select",
    "systematic_sample",
    "window_posterior",
]

_GOLDEN_RATIO = 0.5 * (math.sqrt(5.0) - 1.0)  # multiples of it, less their whole part, fill [0, 1) evenly


@dataclass(frozen=True)
class Candidates:
    """The embeddings among which the most likely one is selected.

    Attributes:
        h: (R * P, C, embedding_dim), those of the N training situations first; R is 1 where robots share networks.
        pairs: What each consists of, (C, 2): the situations i and j; j = 0 where it is i alone.
    """

    h: Tensor
    pairs: Tensor

    @classmethod
    def of(cls, model: Dynamics, compose: bool) -> Candidates:
        """H_meta, and with ``compose`` the sums of two situations other than the first, which is the intact robot."""
        n = model.n_situations
        alone = torch.stack([torch.arange(n), torch.zeros(n, dtype=torch.long)], dim=1)
        both = torch.combinations(torch.arange(1, n)) if compose else alone[:0]
        pairs = torch.cat([alone, both]).to(model.embeddings.device)
        H = model.embeddings.detach()
        h = H[:, pairs[:, 0]] + H[:, pairs[:, 1]] - H[:, :1]
        return cls(h, pairs)

    @property
    def log_prior(self) -> Tensor:
        """One fault is as likely as two, (C,); probabilities that sum to 1."""
        single = self.pairs[:, 1] == 0
        size = torch.where(single, single.sum(), (~single).sum())
        return (-size.float().log()).log_softmax(dim=0)

    def marginal(self, posterior: Tensor) -> Tensor:
        """How likely each training situation is, alone or as a part: (B, C) -> (B, N)."""
        n = int((self.pairs[:, 1] == 0).sum())
        total = posterior.clone()[:, :n]
        both, (i, j) = posterior[:, n:], self.pairs[n:].T
        return total.index_add(1, i, both).index_add(1, j, both)

    def names(self, situations: Sequence[str]) -> list[str]:
        """What the candidates are called, given the names of the training situations."""
        return [situations[i] if j == 0 else f"{situations[i]} + {situations[j]}" for i, j in self.pairs.tolist()]

    def log_likelihood(self, model: Dynamics, data: Batch) -> Tensor:
        """Log p(s' | s, a, theta_meta, h) of the data of B robots for each candidate, a mean over the ensemble.

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots.

        Returns:
            (B, n, C); 0 for padding.
        """
        robots, n = data.weight.shape
        owners, members, size = model.robots, model.members, self.h.shape[1]
        sharing = robots // owners  # B robots share the networks, or each has its own

        # The data of all robots that share a network under each candidate, side by side: C * sharing * n rows.
        def rows(values: Tensor) -> Tensor:
            flat = values.reshape(owners, 1, 1, sharing * n, *values.shape[2:])
            return flat.expand(owners, members, size, *flat.shape[3:]).flatten(2, 3).flatten(0, 1)

        h = self.h.repeat_interleave(sharing * n, dim=1)
        batch = Batch(rows(data.x), rows(data.y), rows(data.weight))
        log_p = model.log_likelihood(model.parameters_by_name(), h, batch)
        log_p = log_p.view(owners, members, size, sharing, n).mean(dim=1)  # (R, C, sharing, n)
        # An observation beyond all measure would make every likelihood -inf and the posterior meaningless.
        return log_p.permute(0, 2, 3, 1).flatten(0, 1).clamp(min=-1e30)


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

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return _choose(kept.repeat_interleave(len(mine) // len(kept)), mine, theirs)

        theta = {name: choose(value, other.theta[name]) for name, value in self.theta.items()}
        log_posterior = choose(self.log_posterior, other.log_posterior)
        candidate, diverged = choose(self.candidate, other.candidate), choose(self.diverged, other.diverged)
        return Belief(theta, choose(self.h, other.h), log_posterior, candidate, diverged, self.adaptations)


def prior(model: Dynamics, candidates: Candidates, robots: int) -> Belief:
    """What B robots believe before they have seen anything: theta_meta, and the first situation's embedding."""
    none = torch.zeros(robots, dtype=torch.long, device=model.embeddings.device)
    log_prior = candidates.log_prior.expand(robots, -1)
    return Belief(model.theta_of(robots), model.embeddings_of(none), log_prior, candidate=none, diverged=none)


def window_posterior(candidates: Candidates, memory: Memory) -> Tensor:
    """Log P(candidate | D_W) but for a constant, (B, C): the paper's likelihood of the last transitions."""
    return candidates.log_prior + (memory.log_p * memory.judging[..., None]).sum(dim=1)


def filtered_posterior(candidates: Candidates, log_posterior: Tensor, log_p: Tensor, hazard: float) -> Tensor:
    """Log P(candidate | all transitions) of a robot that may break at any step, (B, C).

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


def better_explained(memory: Memory, candidate: Tensor) -> Tensor:
    """Whether theta_meta with a candidate (B,) explains the last transitions better than the robots' beliefs did, (B,).

    Both are judged by transitions that no gradient step had seen when they were made.
    """
    return ((memory.explained_by(candidate) - memory.own_log_p) * memory.judging).sum(dim=1) > 0.0


def systematic_sample(posterior: Tensor, n: int, offset: float) -> Tensor:
    """N candidates for each robot, (B, n), each about n times its probability often.

    Systematic resampling, as in a particle filter: the candidates at the quantiles (i + offset) / n.

    Args:
        posterior: (B, C).
        n: Size of the sample.
        offset: In [0, 1).
    """
    descending, order = posterior.sort(dim=1, descending=True, stable=True)
    at = (torch.arange(n, device=posterior.device) + offset) / n
    index = torch.searchsorted(descending.cumsum(dim=1), at.expand(len(posterior), n).contiguous(), right=True)
    return order.gather(1, index.clamp(max=posterior.shape[1] - 1))


def adapt(
    model: Dynamics,
    candidates: Candidates,
    memory: Memory,
    inner_loop: InnerLoop,
    belief: Belief,
    validation_size: int = 0,
    spread: bool = False,
    sample: Sample = whole_memory,
) -> Belief:
    """Lines 6 and 7 of Algorithm 2 for B robots at once.

    Args:
        model: Holds theta_meta and H_meta.
        candidates: The embeddings to select from.
        memory: D_M.
        inner_loop: k steps of gradient descent; where they diverge, theta_meta and the embedding stay, and the belief
            counts it.
        belief: Its posterior counts; theta* and h* are found anew.
        validation_size: As for :func:`descend`.
        spread: As for :func:`select`.
        sample: As for :func:`descend`.
    """
    return descend(model, select(model, candidates, belief, spread), memory, inner_loop, validation_size, sample)


def select(model: Dynamics, candidates: Candidates, belief: Belief, spread: bool = False) -> Belief:
    """Line 6: theta_meta with the most likely embedding, h_likely = argmax log p(D_M | theta_meta, h).

    Args:
        model: Holds theta_meta.
        candidates: The embeddings to select from.
        belief: Its posterior counts.
        spread: Whether the members of the ensemble begin with candidates that are sampled from the posterior, others
            each time, instead of all with the most likely one. A plan has to be good then in several situations that
            may be the case, and a robot that is stuck tries what it would do in another one.
    """
    robots, members = len(belief.log_posterior), model.members
    networks = torch.arange(len(candidates.h), device=candidates.h.device).view(-1, members)  # (R, P)
    likeliest = belief.log_posterior.argmax(dim=1)
    likely = likeliest[:, None].expand(-1, members)
    if spread:
        likely = systematic_sample(belief.posterior, members, offset=belief.adaptations * _GOLDEN_RATIO % 1.0)
    h_likely = candidates.h[networks, likely].flatten(0, 1)
    theta_meta = model.theta_of(robots)
    return Belief(theta_meta, h_likely, belief.log_posterior, likeliest, belief.diverged, belief.adaptations + 1)


@torch.no_grad()
def descend(
    model: Dynamics,
    start: Belief,
    memory: Memory,
    inner_loop: InnerLoop,
    validation_size: int = 0,
    sample: Sample = whole_memory,
) -> Belief:
    """Line 7: theta*, h* = k gradient steps from where a belief is, each member of the ensemble by itself.

    Args:
        model: Says what the parameters mean.
        start: Its theta and h are where the steps begin, and stay where they diverge, which is counted.
        memory: D_M.
        inner_loop: The k steps; theta_meta is their anchor.
        validation_size: The newest transitions, which no gradient step sees. Steps that do not make them more likely
            are taken back, in each member of the ensemble by itself; 0 trusts all steps, as the paper does.
        sample: Chooses the transitions of each step among those it may see.
    """
    if inner_loop.steps == 0:
        return start
    seen, newest = memory.split(validation_size)
    anchor = _anchor(model, seen) if inner_loop.decay else None
    theta, h, _ = inner_loop(model, start.theta, start.h, sample(model, seen), anchor)
    if validation_size:
        batch = whole_memory(model, newest)()
        better = model.loss(theta, h, batch) < model.loss(start.theta, start.h, batch)
        theta = {name: _choose(better, value, start.theta[name]) for name, value in theta.items()}
        h = _choose(better, h, start.h)
    adapted = replace(start, theta=theta, h=h)
    return adapted.where(adapted.is_finite(), replace(start, diverged=start.diverged + 1))


def _anchor(model: Dynamics, memory: Memory) -> Anchor:
    """What the networks of B robots are drawn back to: theta_meta, (B * P, ...)."""
    n = memory.weight.sum(dim=1)
    return Anchor(model.theta_of(len(n)), n.repeat_interleave(model.members))


def _choose(rows: Tensor, mine: Tensor, theirs: Tensor) -> Tensor:
    """``mine`` where the row is marked, else ``theirs``."""
    return torch.where(rows.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)
