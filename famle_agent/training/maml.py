"""MAML (Finn et al., 2017; the paper's eq. 3 to 5): gradient-based meta-learning of one starting point theta.

The rival of Algorithm 1. It has no embedding of the situation, so that all that tells one situation from another
has to come from the k gradient steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.progress import Progress
from famle_agent.training.reptile import MetaStep

__all__ = ["MAML"]


@dataclass(frozen=True)
class MAML:
    """Meta-learns theta such that k gradient steps on a few transitions fit the others of the same situation.

    Attributes:
        iterations: Number of meta-iterations.
        meta_lr: Rate of the outer Adam; decays linearly to 0.
        meta_batch_size: Situations per iteration.
        batch_size: Transitions the inner steps see, the same ones in each step, as after the deployment.
        query_size: Other transitions of the same situation, which judge the adapted parameters.
        first_order: Whether the inner steps count as a constant shift of theta (eq. 5 instead of eq. 4).
        max_grad_norm: The outer gradient of each member of the ensemble is shortened to this length.
    """

    iterations: int = 400
    meta_lr: float = 1.0
    meta_batch_size: int = 20
    batch_size: int = 64
    query_size: int = 64
    first_order: bool = False
    max_grad_norm: float = 1.0

    @torch.enable_grad()
    def steps(
        self,
        model: Dynamics,
        data: Batch,
        inner_loop: InnerLoop,
        generator: torch.Generator,
        progress: Progress | None = None,
    ) -> Iterator[MetaStep]:
        """Runs MAML on ``model`` in place, an iteration a step; whoever has enough, stops.

        Args:
            model: Randomly initialised model of one embedding, which stays as it is; its theta becomes the
                meta-trained one.
            data: Encoded transitions of N situations.
            inner_loop: U^k, by stochastic gradient descent on theta alone.
            generator: Source of all the chance.
            progress: Where meta-learning that was stopped goes on from; None begins anew.

        Yields:
            The mean loss on the inner steps' own data before them, and on the other data after them.

        Raises:
            ValueError: The model, the data or the update rule do not fit, or the parameters diverge.
        """
        self._check(model, data, inner_loop)
        n_situations = len(data.x)
        meta_batch_size = min(self.meta_batch_size, n_situations)
        optimizer = torch.optim.Adam(model.theta.parameters(), lr=self.meta_lr, foreach=True)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda done: 1.0 - done / self.iterations)
        left = (progress or Progress()).iterations(
            self.iterations, generator, model=model, optimizer=optimizer, schedule=schedule
        )
        for iteration in left:
            drawn = torch.randperm(n_situations, generator=generator, device=generator.device)
            c = drawn[:meta_batch_size].to(data.x.device)
            support, query = self.sample(data, c, model.members, generator)

            theta, h = model.parameters_of(meta_batch_size), model.embeddings_of(c)
            theta_tilde, loss_before = self.adapt(model, theta, h, support, inner_loop)
            loss_after = model.loss(query, h, theta_tilde).mean()

            optimizer.zero_grad()
            # The members know nothing of each other: each descends its own mean over the situations.
            torch.autograd.backward(loss_after * model.members)
            self.shorten_gradients(model)
            optimizer.step()
            schedule.step()

            step = MetaStep(iteration + 1, c, loss_before.mean().item(), loss_after.item())
            if not math.isfinite(step.loss_after):
                raise ValueError(f"MAML diverged in iteration {step.iteration}; take a smaller inner_lr or meta_lr.")
            yield step

    def adapt(
        self, model: Dynamics, theta: Theta, h: Tensor, support: Batch, inner_loop: InnerLoop
    ) -> tuple[Theta, Tensor]:
        """Returns theta~ = U^k(theta) as a function of theta, to be differentiated, and the loss before it, (B, P)."""

        def loss_of(theta: Theta) -> tuple[Tensor, Tensor]:
            loss = model.loss(support, h, theta)
            return loss.sum(), loss.detach()

        losses = []
        for _ in range(inner_loop.steps):
            # At a copy of theta, the gradients are constants: theta~ = theta + b, eq. 5.
            at = {name: value.detach() for name, value in theta.items()} if self.first_order else theta
            gradients, loss = torch.func.grad(loss_of, has_aux=True)(at)
            theta = {name: value - inner_loop.lr * gradients[name] for name, value in theta.items()}
            losses.append(loss)
        return theta, losses[0]

    def shorten_gradients(self, model: Dynamics) -> None:
        """Limits the length of each member's gradient.

        Where the inner steps nearly diverge, a few situations' gradients would drown all the others.
        """
        gradients = [value.grad for value in model.theta.values() if value.grad is not None]
        squared = [gradient.flatten(1).square().sum(dim=1) for gradient in gradients]
        factor = (self.max_grad_norm / (torch.stack(squared).sum(dim=0).sqrt() + 1e-6)).clamp(max=1.0)
        for gradient in gradients:
            gradient.mul_(factor.view(-1, *[1] * (gradient.ndim - 1)))

    def sample(self, data: Batch, c: Tensor, members: int, generator: torch.Generator) -> tuple[Batch, Batch]:
        """Draws for each situation in ``c`` and each member transitions for the inner steps, and others to judge by."""
        shape = (len(c), members, data.x.shape[1])
        order = (
            torch.rand(shape, generator=generator, device=generator.device, dtype=torch.float32)
            .argsort(dim=-1)
            .to(data.x.device)
        )
        support, query = order[..., : self.batch_size], order[..., self.batch_size :][..., : self.query_size]
        c = c[:, None, None]
        return data[c, support], data[c, query]

    def _check(self, model: Dynamics, data: Batch, inner_loop: InnerLoop) -> None:
        if model.n_situations != 1:
            raise ValueError(
                f"MAML has no use for embeddings, but the model has {model.n_situations}: build it with n_situations=1."
            )
        if inner_loop.optimizer != "sgd" or inner_loop.embedding_lr != 0 or inner_loop.steps < 1:
            raise ValueError(
                "MAML differentiates through at least one step of gradient descent on theta alone: "
                f'use steps >= 1, optimizer="sgd" and embedding_lr=0 instead of {inner_loop}.'
            )
        n, needed = data.x.shape[1], self.batch_size + self.query_size
        if n < needed:
            raise ValueError(
                f"MAML needs batch_size + query_size = {needed} different transitions of each situation, "
                f"but there are {n}: give more data or take smaller batches."
            )
