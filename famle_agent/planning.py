"""Model-predictive control (line 4 of Algorithm 2): sequences of actions that a model believes to be good.

A planner knows a function that judges candidate sequences, and nothing of what stands behind it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from famle_agent.utils.deadline import Deadline, in_time

__all__ = ["ICEM", "MPPI", "Judge", "Planner", "RandomShooting", "shift"]

Judge = Callable[[Tensor], Tensor]
"""Candidate actions (B, N, H, action_dim) -> the return of each, (B, N)."""


@dataclass(frozen=True)
class Planner(ABC):
    """Looks for the best sequence of actions in [-1, 1].

    Attributes:
        horizon: H, steps that a candidate looks ahead.
        candidates: N, sequences judged per iteration.
    """

    horizon: int = 10
    candidates: int = 100

    @abstractmethod
    def plan(
        self,
        judge: Judge,
        start: Tensor,
        generator: torch.Generator,
        proposals: Tensor | None = None,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Plans for B robots.

        Args:
            judge: Gives the return of candidates.
            start: The plan to begin from, (B, H, action_dim): zeros, or the last plan moved on by one step.
            generator: Source of all the chance, on the device of ``start``.
            proposals: Plans that somebody else has made, (B, M, H, action_dim), which compete.
            deadline: By when to return the best plan so far; there is one after the first iteration.

        Returns:
            The action to apply now, (B, action_dim), and the whole plan, (B, H, action_dim).
        """


@dataclass(frozen=True)
class RandomShooting(Planner):
    """The paper's planner: the best of N uniformly random sequences (Rao, 2009). It starts anew each time.

    It has a single iteration, which no deadline ends.
    """

    def plan(
        self,
        judge: Judge,
        start: Tensor,
        generator: torch.Generator,
        proposals: Tensor | None = None,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`Planner.plan`."""
        shape = (len(start), self.candidates, *start.shape[1:])
        tau = torch.rand(shape, generator=generator, device=start.device, dtype=start.dtype) * 2.0 - 1.0
        tau = tau if proposals is None else torch.cat([tau, proposals], dim=1)
        best = _take(tau, judge(tau).argmax(dim=1, keepdim=True))[:, 0]
        return best[:, 0], best


@dataclass(frozen=True)
class ICEM(Planner):
    """Improved cross-entropy method (Pinneri et al., 2020, "Sample-efficient Cross-Entropy Method").

    Time-correlated noise, a memory for the elite sequences, and the best action seen instead of the mean.

    Attributes:
        iterations: Refits of the sampling distribution per step.
        elites: K, sequences that the distribution is refitted to.
        noise_beta: Exponent of the noise's power spectrum: 0 is white, 2 is a random walk.
        init_std: Deviation of the first iteration.
        momentum: How much of the old mean and deviation a refit keeps.
        keep_fraction: Part of the elites that the next iteration judges again.
    """

    iterations: int = 3
    elites: int = 10
    noise_beta: float = 2.0
    init_std: float = 0.5
    momentum: float = 0.1
    keep_fraction: float = 0.3

    def plan(
        self,
        judge: Judge,
        start: Tensor,
        generator: torch.Generator,
        proposals: Tensor | None = None,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`Planner.plan`."""
        mean, std = start, torch.full_like(start, self.init_std)
        elites = start[:, None]  # the last plan competes
        if proposals is not None:
            elites = torch.cat([elites, proposals], dim=1)
            elites = _take(elites, judge(elites).topk(min(self.elites, elites.shape[1]), dim=1).indices)
            mean = elites[:, 0]
        keep = max(1, int(self.keep_fraction * self.elites))
        for _ in in_time(self.iterations, deadline, at_least=1):
            noise = coloured_noise(start, self.candidates, self.noise_beta, generator)
            tau = (mean[:, None] + std[:, None] * noise).clamp(-1.0, 1.0)
            tau = torch.cat([tau, elites[:, :keep], mean[:, None]], dim=1)

            elites = _take(tau, judge(tau).topk(min(self.elites, tau.shape[1]), dim=1).indices)

            mean = self.momentum * mean + (1.0 - self.momentum) * elites.mean(dim=1)
            std = self.momentum * std + (1.0 - self.momentum) * elites.std(dim=1, correction=0)
        return elites[:, 0, 0], mean


@dataclass(frozen=True)
class MPPI(Planner):
    """Model-predictive path integral control (Williams et al., 2017): candidates averaged by exp(return / lambda).

    Attributes:
        iterations: Averagings per step.
        temperature: lambda, in deviations of the candidates' returns.
        init_std: Deviation of the noise.
        noise_beta: Exponent of the noise's power spectrum, as for :class:`ICEM`.
    """

    iterations: int = 3
    temperature: float = 0.1
    init_std: float = 0.5
    noise_beta: float = 2.0

    def plan(
        self,
        judge: Judge,
        start: Tensor,
        generator: torch.Generator,
        proposals: Tensor | None = None,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, Tensor]:
        """See :meth:`Planner.plan`."""
        mean = start
        for _ in in_time(self.iterations, deadline, at_least=1):
            noise = self.init_std * coloured_noise(start, self.candidates, self.noise_beta, generator)
            tau = torch.cat([mean[:, None], (mean[:, None] + noise).clamp(-1.0, 1.0)], dim=1)
            tau = tau if proposals is None else torch.cat([tau, proposals], dim=1)
            returns = judge(tau)
            best = returns.amax(dim=1, keepdim=True)
            finite = torch.where(returns.isfinite(), returns, best).nan_to_num(neginf=0.0)
            scale = self.temperature * finite.std(dim=1, keepdim=True)
            scale = torch.where(scale > 0.0, scale, 1.0)  # where all are alike, none is better
            # Where no candidate stayed among the finite numbers, none is better than another.
            advantage = torch.where(best.isfinite(), returns - best, 0.0)
            mean = torch.einsum("bn,bnha->bha", torch.softmax(advantage / scale, dim=1), tau)
        return mean[:, 0], mean


def shift(plan: Tensor) -> Tensor:
    """Moves a plan (B, H, action_dim) on by one step; its last action is repeated."""
    return torch.cat([plan[:, 1:], plan[:, -1:]], dim=1)


def _take(tau: Tensor, index: Tensor) -> Tensor:
    """Sequences (B, k, H, action_dim) at the indices (B, k)."""
    return tau.gather(1, index[..., None, None].expand(-1, -1, *tau.shape[2:]))


def coloured_noise(like: Tensor, n: int, beta: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise (B, n, H, action_dim) of unit variance with the power spectrum 1 / f^beta along H.

    Timmer and Koenig (1995): white noise in the frequency domain, scaled by f^(-beta / 2).
    """
    size, horizon, action_dim = like.shape
    if horizon == 1 or beta == 0.0:
        return torch.randn(size, n, horizon, action_dim, generator=generator, device=like.device, dtype=like.dtype)
    frequency = torch.fft.rfftfreq(horizon, device=like.device, dtype=like.dtype)
    frequency[0] = frequency[1]
    scale = frequency ** (-beta / 2.0)
    shape = (2, size, n, action_dim, len(scale))
    real, imaginary = torch.randn(shape, generator=generator, device=like.device, dtype=like.dtype) * scale
    imaginary[..., 0] = 0.0  # a constant has no phase
    real[..., 0] *= math.sqrt(2.0)
    power = 2.0 * scale[1:].square().sum() * 2.0 + 2.0 * scale[0].square()
    if horizon % 2 == 0:
        imaginary[..., -1] = 0.0
        real[..., -1] *= math.sqrt(2.0)
        power = power - 2.0 * scale[-1].square()
    noise = torch.fft.irfft(torch.complex(real, imaginary), n=horizon, dim=-1) * horizon
    scaled: Tensor = noise / power.sqrt()
    return scaled.transpose(-1, -2)
