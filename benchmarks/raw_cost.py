"""The raw cost of what models do: bare matrix products, and Algorithm 1 as it is written, one situation at a time."""

from __future__ import annotations

import copy
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import nn

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop

__all__ = ["OneByOne", "bare_products"]


def bare_products(model: Dynamics, networks: int, rows: int, backward: bool = False) -> Callable[[], None]:
    """Makes the matrix products of a step through a number of networks; with ``backward`` those of gradients, too."""
    layers = [
        (torch.randn(networks, rows, a), torch.randn(networks, a, b), torch.randn(networks, rows, b))
        for a, b in pairwise(layer_widths(model))
    ]

    def step() -> None:
        for x, weight, out in layers:
            torch.bmm(x, weight, out=out)
            if backward:
                torch.bmm(x.transpose(1, 2), out)  # to the weights
                torch.bmm(out, weight.transpose(1, 2))  # to the inputs

    return step


class OneByOne:
    """Algorithm 1 as it is written: one situation after the other, with PyTorch's own layers.

    Args:
        model: Says how large the network is.
        data: Transitions of N situations.
        inner_loop: U^k.
        batch_size: Transitions per step.
    """

    def __init__(self, model: Dynamics, data: Batch, inner_loop: InnerLoop, batch_size: int) -> None:
        E, sizes = model.embeddings.shape[-1], layer_widths(model)
        sizes = [sizes[0] + E, *sizes[1:]]
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b, dtype=torch.float32), nn.SiLU())]
        self.theta, self.H = nn.Sequential(*layers[:-1]), torch.randn(len(data.x), E)
        self.data, self.inner_loop, self.batch_size, self.iteration = data, inner_loop, batch_size, 0

    def situation(self) -> None:
        """Runs lines 10 to 13 for the next situation."""
        c = self.iteration % len(self.H)
        theta, h = copy.deepcopy(self.theta), self.H[c].clone().requires_grad_()
        groups = [{"params": [*theta.parameters()], "lr": self.inner_loop.lr}, {"params": [h], "lr": 1e-2}]
        optimizer = torch.optim.SGD(groups)
        for _ in range(self.inner_loop.steps):
            i = torch.randint(self.data.x.shape[1], (self.batch_size,))
            predicted = theta(torch.cat([self.data.x[c, i], h.expand(self.batch_size, -1)], dim=1))
            loss = nn.functional.mse_loss(predicted, self.data.y[c, i])
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
        with torch.no_grad():
            for mine, adapted in zip(self.theta.parameters(), theta.parameters(), strict=True):
                mine.lerp_(adapted, 0.5)
            self.H[c] = self.H[c].lerp(h, 0.5)
        self.iteration += 1


def layer_widths(model: Dynamics) -> list[int]:
    """The widths of a model's layers, from inputs to outputs."""
    return [model.n_features + model.action_dim, *model.network.hidden, model.obs_dim]
