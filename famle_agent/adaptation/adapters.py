"""The two ways to adapt a meta-learned model: by its embeddings and gradient steps, or by gradient steps alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from famle_agent.adaptation.belief import Belief, prior, unadapted
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory, Sample, minibatches, whole_memory
from famle_agent.adaptation.posterior import better_explained, filtered_posterior, window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import Model, bounded

__all__ = [
    "Adaptation",
    "EmbeddingAdapter",
    "Epochs",
    "Filter",
    "GradientAdapter",
    "GradientSteps",
    "Steps",
    "Window",
]


_EVERY_SITUATION = "every situation"


@dataclass(frozen=True)
class Window:
    """The posterior is the likelihood of the newest transitions, as in the paper.

    Attributes:
        size: How many; 0, the paper's, takes all of the memory.
    """

    size: int = 0


@dataclass(frozen=True)
class Filter:
    """The posterior is filtered over all transitions.

    Attributes:
        hazard: Probability per step that the robot breaks, or is repaired.
    """

    hazard: float

    def __post_init__(self) -> None:
        if not 0.0 < self.hazard < 1.0:
            raise ValueError(f"hazard is a probability above 0 and below 1, got {self.hazard!r}.")


@dataclass(frozen=True)
class Steps:
    """A number of gradient steps.

    Attributes:
        number: k.
    """

    number: int = 20


@dataclass(frozen=True)
class Epochs:
    """As many gradient steps as it takes to see the memory some times, of several robots that of the one with most.

    Attributes:
        number: How many times.
    """

    number: int


@dataclass(frozen=True)
class GradientSteps:
    """The gradient steps of an adaptation (line 7 of Algorithm 2).

    Attributes:
        length: How many there are.
        lr: alpha, the rate of theta.
        embedding_lr: beta, the rate of h.
        optimizer: ``"sgd"`` (the paper's) or ``"adam"``.
        decay: c; after n transitions, each step takes theta c / n of the way back to theta_meta, so that it goes far
            only where much was seen; 0, the paper's, trusts few transitions as much as many.
        batch_size: Transitions per step, drawn from the memory; 0 takes all, as the paper does.
        validation_size: The newest transitions of the memory, which the steps do not see and which decide whether the
            steps are kept; 0 keeps all, as the paper does.
        keep_adapting: Whether steps go on from where the last ones led, instead of beginning with what was meta-learned
            each time (the paper's). FAMLE begins anew where another embedding than the one it began with explains the
            robot better than its adapted model does, with the transitions that selected it alone. Where it is the same
            embedding, the steps go on, but the embedding alone plans as long as it explains more.
    """

    length: Steps | Epochs = Steps()
    lr: float = 1e-3
    embedding_lr: float = 1e-2
    optimizer: Literal["sgd", "adam"] = "adam"
    decay: float = 0.0
    batch_size: int = 0
    validation_size: int = 0
    keep_adapting: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.length, Epochs) and not self.batch_size:
            raise ValueError("adapt_epochs needs an adapt_batch_size; adapt_steps counts steps on the whole memory.")

    def inner_loop(self, seen: int) -> InnerLoop:
        """Returns U^k on the robot.

        Args:
            seen: Transitions in the memory.
        """
        steps = self.length.number
        if isinstance(self.length, Epochs):
            steps *= -(-seen // self.batch_size)
        return InnerLoop(steps, self.lr, self.embedding_lr, self.optimizer, self.decay)


@dataclass(frozen=True)
class Adaptation:
    """How a model is adapted on the robot.

    Attributes:
        every: K, robot steps between two adaptations; 0 never adapts while an episode lasts.
        at_reset: Whether to adapt when an episode ends.
        memory_size: M, transitions that adaptation looks back on.
        forget_at_reset: Whether a new episode empties the memory; damage outlasts an episode, so not by default.
        evidence: What the posterior of the situations rests on.
        compose: Whether the most likely embedding is looked for among the sums of two training situations too, which
            stand for both faults at once; the paper has none.
        likelihood_power: Exponent of the likelihood of a transition; below 1 where errors are not independent of each
            other, so that one strange moment does not overturn what many have shown. The paper's is 1.
        spread_members: Whether the members of the ensemble start from situations that are sampled from the posterior,
            instead of all from the most likely one (the paper's).
        gradient: The gradient steps on theta and h; None only selects an embedding.
        clamp_predictions: Whether a plan may imagine no observation beyond the range of those in the memory, as soon as
            a robot has adapted.
    """

    every: int = 5
    at_reset: bool = False
    memory_size: int = 50
    forget_at_reset: bool = False
    evidence: Window | Filter = Window()
    compose: bool = False
    likelihood_power: float = 1.0
    spread_members: bool = False
    gradient: GradientSteps | None = GradientSteps()
    clamp_predictions: bool = False

    def __post_init__(self) -> None:
        if self.at_reset and self.forget_at_reset:
            raise ValueError("adapt_at_reset learns from what forget_at_reset throws away; choose one of them.")
        if self.gradient is not None and self.gradient.validation_size >= self.memory_size:
            raise ValueError(
                f"validation_size must be below memory_size, {self.memory_size}, or nothing is left to learn from; "
                f"got {self.gradient.validation_size}."
            )

    @property
    def window(self) -> int:
        """W, how many of the newest transitions the posterior counts where it is a window's."""
        return (self.evidence.size if isinstance(self.evidence, Window) else 0) or self.memory_size

    @property
    def keep_adapting(self) -> bool:
        """Whether there are gradient steps that go on from where the last ones led."""
        return self.gradient is not None and self.gradient.keep_adapting


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

    @property
    def members(self) -> int:
        """See :class:`~famle_agent.adaptation.controller.Adapter`, here and below."""
        return self.model.members

    def initial(self, robots: int) -> Belief:
        """Returns theta_meta with the first situation's embedding."""
        return prior(self.model, self.candidates, robots)

    def log_likelihood(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> tuple[Tensor, Tensor]:
        """Judges a transition by theta_meta with each candidate, and by theta* and h* where steps go on from there."""
        transition = self.model.encode(obs[:, None], action[:, None], next_obs[:, None])  # (B, 1, ...)
        power = self.settings.likelihood_power
        log_p = power * self.candidates.log_likelihood(self.model, transition)[:, 0]  # (B, C)
        if not self.settings.keep_adapting:
            return log_p, torch.zeros_like(log_p[:, 0])
        return log_p, power * belief.log_likelihood(self.model, transition)[:, 0]

    def infer(self, memory: Memory, belief: Belief, moved: Tensor) -> Belief:
        """Filters over all transitions where a hazard is set, else takes the likelihood of the last (the paper)."""
        if isinstance(evidence := self.settings.evidence, Filter):
            new = filtered_posterior(self.candidates, belief.log_posterior, memory.log_p[:, -1], evidence.hazard)
            return replace(belief, log_posterior=torch.where(moved[:, None], new, belief.log_posterior))
        return replace(belief, log_posterior=window_posterior(self.candidates, memory))

    def adapt(self, memory: Memory, belief: Belief) -> tuple[Memory, Belief]:
        """Selects the most likely embedding (line 6), then takes k gradient steps on theta and h (line 7)."""
        start = self._selected(belief)
        if self.settings.keep_adapting:
            changed = better_explained(memory, start.candidate) & (start.candidate != belief.candidate)
            memory = memory.begun_anew(changed, self.settings.window, start.candidate)
            start = start.where(changed, replace(belief, adaptations=start.adaptations))
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed)

    def model_for(self, belief: Belief, memory: Memory) -> Model:
        """Returns theta* and h*; where steps go on, the embedding alone as long as it explains the robot better."""
        if self.settings.keep_adapting:
            better = better_explained(memory, belief.log_posterior.argmax(dim=1))
            if better.any():
                belief = replace(self._selected(belief).where(better, belief), adaptations=belief.adaptations)
        return simulator_of(self.model, belief, memory, self.settings.clamp_predictions)

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Names each candidate, ``"a + b"`` where faults are composed, and says how likely it is."""
        return dict(zip(self.candidates.names(situations), belief.posterior[0].tolist(), strict=True))

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Says how likely each training situation is, alone or as a part of what is wrong."""
        return dict(zip(situations, self.candidates.marginal(belief.posterior)[0].tolist(), strict=True))

    def _selected(self, belief: Belief) -> Belief:
        return select(self.model, self.candidates, belief, self.settings.spread_members)


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

    @property
    def members(self) -> int:
        """See :class:`~famle_agent.adaptation.controller.Adapter`, here and below."""
        return self.model.members

    def initial(self, robots: int) -> Belief:
        """Returns theta_meta."""
        return unadapted(self.model, torch.zeros(1, device=self.model.embeddings.device), robots)

    def log_likelihood(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> tuple[Tensor, Tensor]:
        """Returns zeros: there is one model, and nothing to tell apart."""
        nothing = torch.zeros(len(obs), device=obs.device)
        return nothing[:, None], nothing

    def infer(self, memory: Memory, belief: Belief, moved: Tensor) -> Belief:
        """Returns the belief as it is."""
        return belief

    def adapt(self, memory: Memory, belief: Belief) -> tuple[Memory, Belief]:
        """Takes k gradient steps on theta."""
        start = belief if self.settings.keep_adapting else self.initial(len(memory.weight))
        start = replace(start, diverged=belief.diverged, adaptations=belief.adaptations + 1)
        return memory, gradient_steps(self.model, start, memory, self.settings, self.seed)

    def model_for(self, belief: Belief, memory: Memory) -> Model:
        """Returns theta*."""
        return simulator_of(self.model, belief, memory, self.settings.clamp_predictions)

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Puts all the probability on the one model that there is."""
        return {_EVERY_SITUATION: 1.0}


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


def simulator_of(model: Dynamics, belief: Belief, memory: Memory, clamp: bool) -> Model:
    """Returns the dynamics of a belief; with ``clamp``, within the range of the memory once robots have adapted."""
    simulator = model.simulator(belief.theta, belief.h)
    if not clamp or belief.adaptations == 0:
        return simulator
    low, high = (bound.repeat_interleave(model.members, dim=0) for bound in memory.range())
    return bounded(simulator, low, high)
