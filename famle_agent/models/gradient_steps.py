"""U^k(theta, h): k gradient steps on the network and the embedding together (the paper's eq. 9 and 13).

Meta-learning and online adaptation share this rule, since the one learns the starting point of the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.utils.deadline import Deadline, in_time

__all__ = ["InnerLoop", "prepare_torch"]


def prepare_torch() -> None:
    """Has torch import now what it imports for its first optimizer: seconds for which a robot would stand still."""
    torch.optim.SGD([torch.zeros(1, requires_grad=True)])


@dataclass(frozen=True)
class InnerLoop:
    """The update rule U^k.

    Attributes:
        steps: k, the number of gradient steps.
        lr: alpha, the rate of theta.
        embedding_lr: beta, the rate of h.
        optimizer: ``"sgd"`` (the paper's) or ``"adam"``.
    """

    steps: int = 20
    lr: float = 1e-3
    embedding_lr: float = 1e-2
    optimizer: Literal["sgd", "adam"] = "sgd"

    def __call__(
        self,
        model: Dynamics,
        theta: Theta,
        h: Tensor,
        sample: Callable[[], Batch],
        deadline: Deadline | None = None,
    ) -> tuple[Theta, Tensor, Tensor]:
        """Takes k steps for B situations at once, in each member; none of them influences another.

        Args:
            model: The model whose loss is descended.
            theta: Parameters to start from, (B, P, ...); not changed.
            h: Embeddings to start from, (B, P, embedding_dim); not changed.
            sample: Gives the data of each step.
            deadline: By when to be done; what there is no time for is left out.

        Returns:
            theta~, h~ and the loss before each step, (k, B, P).
        """
        theta = {name: value.detach().clone().requires_grad_() for name, value in theta.items()}
        h = h.detach().clone().requires_grad_()
        groups = [{"params": list(theta.values()), "lr": self.lr}, {"params": [h], "lr": self.embedding_lr}]
        optimizer = {"sgd": torch.optim.SGD, "adam": torch.optim.Adam}[self.optimizer](groups, fused=True)
        losses = []
        with torch.enable_grad():
            for _ in in_time(self.steps, deadline):
                loss = model.loss(sample(), h, theta)
                optimizer.zero_grad()
                loss.sum().backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                losses.append(loss.detach())
        history = torch.stack(losses) if losses else h.new_empty(0, *h.shape[:2])
        return {name: value.detach() for name, value in theta.items()}, h.detach(), history
