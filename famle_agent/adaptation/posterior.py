"""How likely each candidate is (line 2 of Algorithm 2): by the paper's window of transitions, or by a Bayesian filter.

Errors are counted in the deviations that were fitted in simulation: ``r[t, p, c, d]`` is that of transition t in the
observed number d, as predicted by member p of the ensemble with theta_meta and candidate c
(:meth:`~famle_agent.adaptation.candidates.Candidates.residuals`). p_nu is the standard Gaussian or Student-t, lambda is
``likelihood_power``, w_0 the prior, and n how many transitions the memory holds, t among them. Terms that are the same
for all candidates are left out.

The paper takes the likelihood of the newest W transitions (:func:`window_posterior`):

    l[t, c]   = lambda mean_p sum_d log p_nu(r[t, p, c, d])
    log w[c]  = log w_0[c] + sum_t l[t, c]

The filter takes from the errors what has lasted, b, and scales them by the robot's own noise, v. Then it predicts with
the hazard eta, and corrects by the newest transition (:func:`filtered_posterior`):

    f[p, c, d] = r[t, p, c, d] - b[t-1, p, c, d]
    v[d]       = max(1, e[t-1, d])
    l[c]       = lambda mean_p sum_d log p_nu(f[p, c, d] / sqrt(v[d]))
    w[t, c]    ~ ((1 - eta) w[t-1, c] + eta w_0[c]) exp(l[c])

What lasts (:func:`updated_bias`) and the mean square of the rest (:func:`expected_square`, :func:`updated_excess`) are
averages over a robot's last transitions:

    b[t]  = b[t-1] + (r[t] - b[t-1]) / min(n, 10)
    q[d]  = sum_c w[t-1, c] mean_p u f[p, c, d]^2, where u = (nu + 1) / (nu + f[p, c, d]^2 / v[d]), or 1 for a Gaussian
    e[t]  = e[t-1] + (q - e[t-1]) / (10 + min(n, 100))

At t = 0, w is w_0, b is 0 and e is 1. :meth:`~famle_agent.adaptation.adapters.EmbeddingAdapter.infer` takes the steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.models.likelihood import trust

__all__ = [
    "expected_square",
    "filtered_posterior",
    "updated_bias",
    "updated_excess",
    "window_posterior",
]

_BELIEVED = 10.0  # transitions for which the noise that was fitted in simulation counts
_REMEMBERED = 100.0  # and over which the squares of a robot's errors are averaged
_LASTING = 10.0  # and those over which an error that lasts is told from what is new in it


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
        seen: n, how many transitions the memory holds, the newest among them, (B,).
    """
    return torch.lerp(bias, residual, (1.0 / seen.clamp(1.0, _LASTING))[:, None, None, None])


def expected_square(posterior: Tensor, fresh: Tensor, noise: Tensor, degrees_of_freedom: float) -> Tensor:
    """Squares what is new in the errors, by how likely each candidate was before, (B, obs_dim).

    Args:
        posterior: After the transitions before, (B, C).
        fresh: What is new in the errors of the newest transition, (B, P, C, obs_dim).
        noise: The robot's squared noise, (B, 1, 1, obs_dim).
        degrees_of_freedom: nu of a Student-t, to which a large error says little about the noise; 0 is a Gaussian.
    """
    squared = fresh.square()
    squared = squared * trust(squared / noise, degrees_of_freedom)
    return (posterior[:, None, :, None] * squared).sum(dim=2).mean(dim=1)


def updated_excess(excess: Tensor, squared: Tensor, seen: Tensor) -> Tensor:
    """Averages squared errors over what a robot has seen, the newest hundred at most, (B, obs_dim).

    The memory bounds n too: a shorter one averages over fewer.

    Args:
        excess: Their mean before, (B, obs_dim).
        squared: Of the newest transition, (B, obs_dim).
        seen: n, how many transitions the memory holds, the newest among them, (B,).
    """
    return torch.lerp(excess, squared, (1.0 / (_BELIEVED + seen.clamp(max=_REMEMBERED)))[:, None])
