"""U^k(theta, h): k gradient steps on the network and the embedding together (the paper's eq. 8 and 12).

Meta-learning and online adaptation share this rule, since the one learns the starting point of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics, Theta

__all__ = ["Anchor", "InnerLoop", "prepare_torch"]


def prepare_torch() -> None:
    """Has torch import now what it imports for its first optimizer: seconds for which a robot would stand still."""
    torch.optim.SGD([torch.zeros(1, requires_grad=True)])


@dataclass(frozen=True)
class Anchor:
    """What the networks of B robots are drawn back to, the less the more they have to learn from.

    Attributes:
        theta: theta_anchor, (B, P, ...).
        seen: n, the transitions that the networks learn from, (B,).
    """

    theta: Theta
    seen: Tensor

    @torch.no_grad()
    def draw(self, theta: Theta, decay: float) -> None:
        """Takes theta a part of its way back, in place: theta + min(1, c / n) (theta_anchor - theta)."""
        part = (decay / self.seen.clamp(min=1.0)).clamp(max=1.0)
        for name, value in theta.items():
            value.lerp_(self.theta[name], part.view(-1, *[1] * (value.ndim - 1)))


@dataclass(frozen=True)
class InnerLoop:
    """The update rule U^k.

    Attributes:
        steps: k, the number of gradient steps.
        lr: alpha, the rate of theta.
        embedding_lr: beta, the rate of h.
        optimizer: ``"sgd"`` (the paper's) or ``"adam"``.
        decay: c, how strongly an anchor draws; 0, the paper's, not at all. It is the decay of AdamW (Loshchilov and
            Hutter, 2019) towards a starting point instead of zero (Li, Grandvalet and Davoine, 2018, "Explicit
            Inductive Bias for Transfer Learning with Convolutional Networks").
    """

    steps: int
    lr: float
    embedding_lr: float
    optimizer: Literal["sgd", "adam"] = "sgd"
    decay: float = 0.0

    def __call__(
        self, model: Dynamics, theta: Theta, h: Tensor, sample: Callable[[], Batch], anchor: Anchor | None = None
    ) -> tuple[Theta, Tensor, Tensor]:
        """Takes k steps for B situations at once, in each member; none of them influences another.

        Args:
            model: The model whose loss is descended.
            theta: Parameters to start from, (B, P, ...); not changed.
            h: Embeddings to start from, (B, P, embedding_dim); not changed.
            sample: Gives the data of each step.
            anchor: What theta is drawn back to after each step; None leaves it free.

        Returns:
            theta~, h~ and the loss before each step, (k, B, P).

        Raises:
            ValueError: There is a decay and no anchor.
        """
        if self.decay and anchor is None:
            raise ValueError(f"A decay of {self.decay} has nothing to draw theta back to; give an anchor, or decay=0.")
        theta = {name: value.detach().clone().requires_grad_() for name, value in theta.items()}
        h = h.detach().clone().requires_grad_()
        groups = [{"params": list(theta.values()), "lr": self.lr}, {"params": [h], "lr": self.embedding_lr}]
        optimizer = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam}[self.optimizer](groups, foreach=True)
        losses = []
        with torch.enable_grad():
            for _ in range(self.steps):
                loss = model.loss(sample(), h, theta)
                optimizer.zero_grad()
                loss.sum().backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                if anchor is not None:
                    anchor.draw(theta, self.decay)
                losses.append(loss.detach())
        history = torch.stack(losses) if losses else h.new_empty(0, *h.shape[:2])
        return {name: value.detach() for name, value in theta.items()}, h.detach(), history
