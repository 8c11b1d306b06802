"""Training theta and H on all situations at once, before Algorithm 1 turns them into a good place to start from.

Reptile alone leaves embeddings that hardly tell the situations apart: what one inner loop learns about an embedding is
small beside what it learns about the network. Where each minibatch holds all situations, only the embedding can
explain how they differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.training.progress import Progress

__all__ = ["JointTraining"]


@dataclass(frozen=True)
class JointTraining:
    """Stochastic gradient descent (Adam) on the mean loss over situations.

    Attributes:
        iterations: Number of steps.
        lr: Rate of theta; constant in the first half, then decays linearly to 0.
        embedding_lr: Rate of H; decays with it.
        batch_size: Transitions per step and member of the ensemble, drawn from all situations.
    """

    iterations: int
    lr: float = 1e-3
    embedding_lr: float = 5e-3
    batch_size: int = 512

    @torch.enable_grad()
    def steps(
        self, model: Dynamics, data: Batch, generator: torch.Generator, progress: Progress | None = None
    ) -> Iterator[float]:
        """Trains ``model`` in place, from where it is; whoever has enough, stops.

        Args:
            model: Its theta and embeddings are trained.
            data: Encoded transitions of the N situations.
            generator: Source of all the chance; the members of the ensemble see different minibatches.
            progress: Where a training that was stopped goes on from; None begins anew.

        Yields:
            The mean loss of each step.
        """
        groups = [
            {"params": list(model.theta.values()), "lr": self.lr},
            {"params": [model.embeddings], "lr": self.embedding_lr},
        ]
        optimizer = torch.optim.Adam(groups, foreach=True)  # a fused one does not count the changes of a tensor
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda done: min(1.0, 2.0 * (1.0 - done / max(1, self.iterations)))
        )
        left = (progress or Progress()).iterations(
            self.iterations, generator, model=model, optimizer=optimizer, schedule=schedule
        )
        for _ in left:
            c, batch = self.sample(data, model.members, generator)
            loss = model.loss(batch, model.embeddings_by_row(c))
            optimizer.zero_grad()
            loss.sum().backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            yield loss.detach().mean().item()

    def sample(self, data: Batch, members: int, generator: torch.Generator) -> tuple[torch.Tensor, Batch]:
        """Draws a minibatch for each member, and the situations c (1, P, batch_size) that its transitions are from."""
        n_situations, n = data.weight.shape
        shape, device = (1, members, self.batch_size), generator.device
        c = torch.randint(n_situations, shape, generator=generator, device=device).to(data.x.device)
        i = torch.randint(n, shape, generator=generator, device=device).to(data.x.device)
        return c, data[c, i]
