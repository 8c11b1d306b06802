"""P(candidate | transitions): the paper's window of the last ones, or a filter over all of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory

__all__ = ["better_explained", "filtered_posterior", "systematic_sample", "window_posterior"]


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
