"""The two ways to adapt a meta-learned model: by its embeddings and gradient steps, or by gradient steps alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from famle_agent.adaptation.belief import (
    Belief,
    Candidates,
    Evidence,
    choose,
    filtered_posterior,
    prior,
    systematic_sample,
    unadapted,
    updated_bias,
    updated_excess,
    window_posterior,
)
from famle_agent.adaptation.memory import Memory, Sample, minibatches, whole_memory
from famle_agent.adaptation.settings import Adaptation, Filter
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.likelihood import trust
from famle_agent.models.simulator import Simulator

__all__ = ["EmbeddingAdapter", "GradientAdapter", "descend", "select"]

_GOLDEN_RATIO = 0.5 * (math.sqrt(5.0) - 1.0)  # multiples of it, less their whole part, fill [0, 1) evenly
_EVERY_SITUATION = "every situation"


@dataclass(frozen=True)
class EmbeddingAdapter:
    """FAMLE's: the most likely embedding, or sum of two, then k gradient steps on theta and h.

    Attributes:
        model: Holds theta_meta and H_meta, which must not change while the adapter is used.
        settings: How to adapt.
        seed: Of the minibatches.
        candidates: The embeddings to select from.
    """

    model: Dynamics
    settings: Adaptation
    seed: int
    candidates: Candidates = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", Candidates.of(self.model, self.settings.compose))

    def initial(self, robots: int) -> Belief:
        """Returns theta_meta with the first situation's embedding.

        See :class:`~famle_agent.adaptation.controller.Adapter`, here and below.
        """
        return prior(self.model, self.candidates, robots)

    def judge(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> Evidence:
        """Judges a transition by theta_meta with each candidate, and by theta* and h* where steps go on from there."""
        transition = self.model.encode(obs[:, None], action[:, None], next_obs[:, None])  # (B, 1, ...)
        residual = self.candidates.residuals(self.model, transition)[:, :, 0]  # (B, P, C, obs_dim)
        log_p = self._log_density(belief, residual)
        own = torch.zeros_like(log_p[:, 0])
        if self.settings.warm_start:
            adapted = self.model.residuals(transition, belief.h, belief.theta)  # (B, P, 1, obs_dim)
            own = self._log_density(belief, adapted)[:, 0]
        return Evidence(residual, log_p, own)

    def infer(self, memory: Memory, belief: Belief, evidence: Evidence, moved: Tensor) -> Belief:
        """Filters over all transitions where a hazard is set, else takes the likelihood of the last (the paper)."""
        if not isinstance(how := self.settings.evidence, Filter):
            return replace(belief, log_posterior=window_posterior(self.candidates, memory))
        fresh = evidence.residual - belief.bias
        log_p, seen = self._log_density(belief, fresh), memory.weight.sum(dim=1)
        posterior = filtered_posterior(self.candidates, belief.log_posterior, log_p, how.hazard)
        bias = updated_bias(belief.bias, evidence.residual, seen)
        excess = updated_excess(belief.excess, self._expected_square(belief, fresh), seen)
        return replace(belief, log_posterior=posterior, bias=bias, excess=excess).where(moved, belief)

    def adapt(self, memory: Memory, belief: Belief) -> tuple[Memory, Belief]:
        """Selects the most likely embedding (line 6), then takes k gradient steps on theta and h (line 7)."""
        start = self._selected(belief)
        if self.settings.warm_start:
            changed = self._has_changed(memory, start.candidate) & (start.candidate != belief.candidate)
            memory = memory.begun_anew(changed, start.candidate)
            start = start.where(changed, replace(belief, adaptations=start.adaptations))
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed)

    def model_for(self, belief: Belief, memory: Memory) -> Simulator:
        """Returns theta* and h*; where steps go on, the embedding alone as long as it explains the robot better."""
        if self.settings.warm_start:
            better = memory.better_explained(belief.log_posterior.argmax(dim=1))
            if better.any():
                belief = replace(self._selected(belief).where(better, belief), adaptations=belief.adaptations)
        return simulator_of(self.model, belief, memory, self.settings.clamp_predictions)

    def likely(self, belief: Belief) -> Tensor:
        """Sums the posterior over what each training situation is a part of, (B, N)."""
        return self.candidates.marginal(belief.posterior)

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Names each candidate, ``"a + b"`` where faults are composed, and says how likely it is."""
        return dict(zip(self.candidates.names(situations), belief.posterior[0].tolist(), strict=True))

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Says how likely each training situation is, alone or as a part of what is wrong."""
        return dict(zip(situations, self.likely(belief)[0].tolist(), strict=True))

    def _log_density(self, belief: Belief, residual: Tensor) -> Tensor:
        """Computes log p of residuals (B, P, C, obs_dim) with the robot's own noise, (B, C)."""
        return self.settings.likelihood_power * self.model.log_density(residual, _noise(belief).sqrt())

    def _expected_square(self, belief: Belief, residual: Tensor) -> Tensor:
        """Squares residuals (B, P, C, obs_dim), by how likely each candidate was before, (B, obs_dim)."""
        squared = residual.square()
        squared = squared * trust(squared / _noise(belief), self.model.degrees_of_freedom)
        return (belief.posterior[:, None, :, None] * squared).sum(dim=2).mean(dim=1)

    def _has_changed(self, memory: Memory, candidate: Tensor) -> Tensor:
        """Says where a candidate (B,) explains what was seen, or the newest of it, better than what was believed, (B,).

        The second is the test of a change point by cumulative sums: of a robot that has just broken, most of the memory
        still speaks for what it was.
        """
        how, gain = self.settings.evidence, memory.gain(candidate)
        surprise = how.surprise if isinstance(how, Filter) else math.inf
        return (gain[:, 0] > 0.0) | (gain.amax(dim=1) > surprise)

    def _selected(self, belief: Belief) -> Belief:
        return select(self.model, self.candidates, belief, self.settings.posterior_sampling)


@dataclass(frozen=True)
class GradientAdapter:
    """AMPC's and AMPC-MAML's: k gradient steps on theta, from theta_meta (the paper's eq. 3) or going on.

    Attributes:
        model: Holds theta_meta and one embedding, which never changes.
        settings: How to adapt.
        seed: Of the minibatches.
    """

    model: Dynamics
    settings: Adaptation
    seed: int

    def initial(self, robots: int) -> Belief:
        """Returns theta_meta. See :class:`~famle_agent.adaptation.controller.Adapter`, here and below."""
        return unadapted(self.model, self.model.embeddings.new_zeros(1), robots)

    def judge(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> Evidence:
        """Returns zeros: there is one model, and nothing to tell apart."""
        nothing = obs.new_zeros(len(obs), 1)
        return Evidence(torch.zeros_like(belief.bias), nothing, nothing[:, 0])

    def infer(self, memory: Memory, belief: Belief, evidence: Evidence, moved: Tensor) -> Belief:
        """Returns the belief as it is."""
        return belief

    def adapt(self, memory: Memory, belief: Belief) -> tuple[Memory, Belief]:
        """Takes k gradient steps on theta."""
        start = belief if self.settings.warm_start else self.initial(len(memory.weight))
        start = replace(start, diverged=belief.diverged, adaptations=belief.adaptations + 1)
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed)

    def model_for(self, belief: Belief, memory: Memory) -> Simulator:
        """Returns theta*."""
        return simulator_of(self.model, belief, memory, self.settings.clamp_predictions)

    def likely(self, belief: Belief) -> Tensor:
        """Returns ones, (B, 1): there is nothing to tell apart."""
        return torch.ones_like(belief.log_posterior)

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}


def _noise(belief: Belief) -> Tensor:
    """Returns the squared noise of each robot, (B, 1, 1, obs_dim); what was fitted in simulation is the least."""
    return belief.excess.clamp(min=1.0)[:, None, None]


def gradient_steps(model: Dynamics, start: Belief, memory: Memory, settings: Adaptation, seed: int) -> Belief:
    """Takes k steps from where a belief is, on all of the memory or on minibatches of it (line 7)."""
    if (steps := settings.gradient) is None:
        return start
    sample = _sample(steps.batch_size, seed, start.adaptations - 1, memory)
    return descend(model, start, memory, steps.inner_loop(memory.seen), steps.validation_size, sample)


def _sample(size: int, seed: int, number: int, memory: Memory) -> Sample:
    """Chooses what the steps of an adaptation see; the same for the same number, so that equal states act alike."""
    if not size:
        return whole_memory
    return minibatches(size, torch.Generator(memory.obs.device).manual_seed(1_000_003 * seed + number))


def simulator_of(model: Dynamics, belief: Belief, memory: Memory, clamp: bool) -> Simulator:
    """Returns the dynamics of a belief; with ``clamp``, within the range of the memory once robots have adapted."""
    within = memory.range() if clamp and belief.adaptations > 0 else None
    return Simulator(model, belief.h, belief.theta, within)


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
    likeliest = belief.log_posterior.argmax(dim=1)  # (B,)
    likely = likeliest[:, None]
    if spread:
        offset = belief.adaptations * _GOLDEN_RATIO % 1.0
        likely = systematic_sample(belief.posterior, model.members, offset)  # (B, P)
    theta_meta, h_likely = model.theta_of(len(likely)), candidates.chosen(likely)
    new = replace(belief, theta=theta_meta, h=h_likely, candidate=likeliest)
    return replace(new, adaptations=belief.adaptations + 1)


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
        inner_loop: The k steps.
        validation_size: The newest transitions, which no gradient step sees. Steps that do not make them more likely
            are taken back, in each member of the ensemble by itself; 0 trusts all steps, as the paper does.
        sample: Chooses the transitions of each step among those it may see.
    """
    if inner_loop.steps == 0:
        return start
    seen, newest = memory.split(validation_size)
    theta, h, _ = inner_loop(model, start.theta, start.h, sample(model, seen))
    if validation_size:
        batch = whole_memory(model, newest)()
        better = model.loss(batch, h, theta) < model.loss(batch, start.h, start.theta)  # (B, P)
        theta = {name: choose(better, value, start.theta[name]) for name, value in theta.items()}
        h = choose(better, h, start.h)
    adapted = replace(start, theta=theta, h=h)
    return adapted.where(adapted.is_finite(), replace(start, diverged=start.diverged + 1))
