"""The settings of Algorithm 2 but for its planner: how a model is adapted on the robot. An alternative is a type."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from famle_agent.models.gradient_steps import InnerLoop

__all__ = ["Adaptation", "Epochs", "Filter", "GradientSteps", "Steps", "Window"]


_FILTER_WINDOW = 100


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

    @property
    def surprise(self) -> float:
        """-log(hazard), what the evidence for a change has to outweigh."""
        return -math.log(self.hazard)


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
    """The gradient steps of an adaptation (line 3 of Algorithm 2).

    Attributes:
        length: How many there are.
        lr: alpha, the rate of theta.
        embedding_lr: beta, the rate of h.
        optimizer: ``"sgd"`` (the paper's) or ``"adam"``.
        batch_size: Transitions per step, drawn from the memory; 0 takes all, as the paper does.
        validation_size: The newest transitions of the memory, which the steps do not see and which decide whether the
            steps are kept; 0 keeps all, as the paper does.
        warm_start: Whether steps go on from where the last ones led, instead of beginning with what was meta-learned
            each time (the paper's). FAMLE begins anew where another embedding than the one it began with explains the
            robot better than its adapted model does, with the transitions that selected it alone. Where it is the same
            embedding, the steps go on, but the embedding alone plans as long as it explains more.
        library_size: How many adapted models a robot keeps from before it changed, each with its memory, for when it is
            again what it was then; 0 keeps none, as the paper does. It takes ``warm_start`` and a ``hazard``.
    """

    length: Steps | Epochs = Steps()
    lr: float = 1e-3
    embedding_lr: float = 1e-2
    optimizer: Literal["sgd", "adam"] = "adam"
    batch_size: int = 0
    validation_size: int = 0
    warm_start: bool = False
    library_size: int = 0

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
        return InnerLoop(steps, self.lr, self.embedding_lr, self.optimizer)


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
        """W, how many of the newest transitions judge the candidates against the adapted model."""
        size = self.evidence.size if isinstance(self.evidence, Window) else _FILTER_WINDOW
        return min(size or self.memory_size, self.memory_size)

    @property
    def warm_start(self) -> bool:
        """Whether there are gradient steps that go on from where the last ones led."""
        return self.gradient is not None and self.gradient.warm_start

    @property
    def library_size(self) -> int:
        """How many adapted models are kept from before a change; 0 where changes are not looked for."""
        if self.gradient is None or not self.gradient.warm_start or not isinstance(self.evidence, Filter):
            return 0
        return self.gradient.library_size
