"""Two ways to adapt a meta-learned model (lines 2 and 3): by embeddings and gradient steps, or by gradient steps alone.

Each is an :class:`~famle_agent.adaptation.controller.Adapter`. It holds no state: beliefs and memories go in and out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from famle_agent.adaptation.belief import Belief, Evidence, prior, unadapted
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.library import Library, enlarged
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import (
    expected_square,
    filtered_posterior,
    updated_bias,
    updated_excess,
    window_posterior,
)
from famle_agent.adaptation.settings import Adaptation, Filter
from famle_agent.adaptation.update import gradient_steps, select
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.simulator import Simulator
from famle_agent.utils.deadline import Deadline

__all__ = ["EmbeddingAdapter", "GradientAdapter"]

_EVERY_SITUATION = "every situation"


@dataclass(frozen=True)
class EmbeddingAdapter:
    """FAMLE's: the most likely embedding, or sum of two, then k gradient steps on theta and h.

    Each transition is judged, and changes the posterior (:meth:`judge`, :meth:`infer`). Every K steps the posterior
    selects an embedding, where gradient steps begin (:meth:`adapt`). With ``warm_start`` they go on from where the last
    ones led. Then theta_meta with the most likely embedding competes with theta* and h*, by the likelihood of
    transitions before a gradient step has seen them (:meth:`~famle_agent.adaptation.memory.Memory.gain`). With
    ``library_size``, so do the models of :class:`~famle_agent.adaptation.library.Library`.

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
        """Judges a transition by theta_meta with each candidate, and by theta* and h* where steps go on from there.

        The log-likelihoods are l[t, c] of :mod:`~famle_agent.adaptation.posterior`, with the noise v of the filter.
        """
        transition = self.model.encode(obs[:, None], action[:, None], next_obs[:, None])  # (B, 1, ...)
        residual = self.candidates.residuals(self.model, transition)[:, :, 0]  # (B, P, C, obs_dim)
        log_p = self._log_density(belief, residual)
        own = torch.zeros_like(log_p[:, 0])
        if self.settings.warm_start:
            adapted = self.model.residuals(transition, belief.h, belief.theta)  # (B, P, 1, obs_dim)
            own = self._log_density(belief, adapted)[:, 0]
        stored = None
        if belief.library is not None:
            stored = self._log_density(belief, belief.library.residuals(self.model, transition))
        return Evidence(residual, log_p, own, stored)

    def infer(self, memory: Memory, belief: Belief, evidence: Evidence, moved: Tensor) -> Belief:
        """Filters over all transitions where a hazard is set, else takes the likelihood of the last (the paper).

        The equations and their symbols are in :mod:`~famle_agent.adaptation.posterior`.
        """
        if not isinstance(how := self.settings.evidence, Filter):
            return replace(belief, log_posterior=window_posterior(self.candidates, memory))
        fresh = evidence.residual - belief.bias  # f, (B, P, C, obs_dim)
        log_p, seen = self._log_density(belief, fresh), memory.weight.sum(dim=1)
        posterior = filtered_posterior(self.candidates, belief.log_posterior, log_p, how.hazard)
        bias = updated_bias(belief.bias, evidence.residual, seen)
        squared = expected_square(belief.posterior, fresh, belief.noise, self.model.degrees_of_freedom)
        excess = updated_excess(belief.excess, squared, seen)
        return replace(belief, log_posterior=posterior, bias=bias, excess=excess).where(moved, belief)

    def adapt(self, memory: Memory, belief: Belief, deadline: Deadline | None = None) -> tuple[Memory, Belief]:
        """Selects the most likely embedding (line 2), then takes k gradient steps on theta and h (line 3)."""
        start = self._selected(belief)
        if self.settings.warm_start:
            memory, start = self._going_on(memory, start, replace(belief, adaptations=start.adaptations))
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed, deadline)

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

    def shares(self, belief: Belief) -> Tensor:
        """Says how much of each training situation the most likely candidate is, (B, N)."""
        return self.candidates.shares[belief.log_posterior.argmax(dim=1)]

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Names each candidate, ``"a + b"`` where faults are composed, and says how likely it is."""
        return dict(zip(self.candidates.names(situations), belief.posterior[0].tolist(), strict=True))

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Says how likely each training situation is, alone or as a part of what is wrong."""
        return dict(zip(situations, self.likely(belief)[0].tolist(), strict=True))

    def _log_density(self, belief: Belief, residual: Tensor) -> Tensor:
        """Computes log p of residuals (B, P, C, obs_dim) with the robot's own noise, (B, C)."""
        return self.settings.likelihood_power * self.model.log_density(residual, belief.noise.sqrt())

    def _going_on(self, memory: Memory, selected: Belief, before: Belief) -> tuple[Memory, Belief]:
        """Returns where steps go on: from the last ones, or where robots have changed from what explains that best.

        That is the selected embedding, or a model of the library, with which the memory comes back that it was learnt
        from.
        """
        explained = memory.explained_by(selected.candidate)
        changed = self._has_changed(memory, explained) & (selected.candidate != before.candidate)
        library = before.library if self.settings.library_size else None
        if library is None:
            library = self._kept(None, memory, before, memory.since(explained), changed)
            return memory.begun_anew(changed, explained), replace(selected.where(changed, before), library=library)

        known, evidence = library.likeliest(memory, explained)
        again = evidence > torch.where(changed, 0.0, self._surprise)  # whose damage has come back, (B,)
        stored = replace(selected, theta=known.theta, h=known.h, candidate=known.candidate, recognised=again)
        start = stored.where(again, selected)
        explained, changed = torch.where(again[:, None], known.log_p, explained), changed | again

        since = memory.since(explained)
        library = self._kept(library, memory, before, since, changed)
        memory = memory.begun_anew(changed, explained)
        if library is not None and again.any():
            memory = memory.after(known.memory, since).where(again, memory)
            library = library.resumed(memory, since, again)
        return memory, replace(start.where(changed, before), library=library)

    def _kept(
        self, library: Library | None, memory: Memory, before: Belief, since: Tensor, changed: Tensor
    ) -> Library | None:
        """Keeps what robots had learnt that have ``changed`` (B,), until their newest ``since`` (B,) transitions."""
        if not (self.settings.library_size and changed.any()):
            return library
        new = Library.of(before.theta, before.h, before.candidate, memory.without_newest(since), changed)
        return enlarged(library, new, self._surprise, self.settings.library_size)

    @property
    def _surprise(self) -> float:
        """-log(hazard); without a hazard, changes are no surprise that evidence could outweigh."""
        how = self.settings.evidence
        return how.surprise if isinstance(how, Filter) else math.inf

    def _has_changed(self, memory: Memory, explained: Tensor) -> Tensor:
        """Says where something explains what was seen, or the newest of it, better than what was believed, (B,).

        With g of :meth:`~famle_agent.adaptation.memory.Memory.gain`: g[0] > 0, or max_j g[j] > -log(hazard). The second
        is the test of a change point by cumulative sums: of a robot that has just broken, most of the memory still
        speaks for what it was.

        Args:
            memory: What the robots have gone through.
            explained: Log-likelihood of the newest W transitions under what may be the case, (B, W).
        """
        gain = memory.gain(explained)
        return (gain[:, 0] > 0.0) | (gain.amax(dim=1) > self._surprise)

    def _selected(self, belief: Belief) -> Belief:
        return select(self.model, self.candidates, belief)


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

    def adapt(self, memory: Memory, belief: Belief, deadline: Deadline | None = None) -> tuple[Memory, Belief]:
        """Takes k gradient steps on theta."""
        start = belief if self.settings.warm_start else self.initial(len(memory.weight))
        start = replace(start, diverged=belief.diverged, adaptations=belief.adaptations + 1)
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed, deadline)

    def model_for(self, belief: Belief, memory: Memory) -> Simulator:
        """Returns theta*."""
        return simulator_of(self.model, belief, memory, self.settings.clamp_predictions)

    def likely(self, belief: Belief) -> Tensor:
        """Returns ones, (B, 1): there is nothing to tell apart."""
        return torch.ones_like(belief.log_posterior)

    def shares(self, belief: Belief) -> Tensor:
        """Returns ones, (B, 1), as :meth:`likely`."""
        return self.likely(belief)

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}


def simulator_of(model: Dynamics, belief: Belief, memory: Memory, clamp: bool) -> Simulator:
    """Returns the dynamics of a belief; with ``clamp``, within the range of the memory once robots have adapted."""
    within = memory.range() if clamp and belief.adaptations > 0 else None
    return Simulator(model, belief.h, belief.theta, within)
