"""Algorithm 1 of the paper: Reptile on the network and the situation embeddings together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.progress import Progress

__all__ = ["MetaStep", "Reptile"]


@dataclass(frozen=True)
class MetaStep:
    """What one iteration did.

    Attributes:
        iteration: Number of iterations done.
        situations: Indices of the situations of this iteration, (B,).
        loss_before: Mean loss before the first inner step.
        loss_after: Mean loss before the last inner step.
    """

    iteration: int
    situations: Tensor
    loss_before: float
    loss_after: float


@dataclass(frozen=True)
class Reptile:
    """Meta-learns theta and H from the data of N situations.

    Attributes:
        iterations: Number of meta-iterations.
        meta_lr: alpha_meta, the step from theta towards theta~; decays linearly to 0.
        embedding_meta_lr: beta_meta, the step from h towards h~; decays with it.
        meta_batch_size: Situations per iteration; 1 is the paper's.
        batch_size: Transitions per inner step.
    """

    iterations: int = 400
    meta_lr: float = 1.0
    embedding_meta_lr: float = 1.0
    meta_batch_size: int = 20
    batch_size: int = 64

    @torch.no_grad()
    def steps(
        self,
        model: Dynamics,
        data: Batch,
        inner_loop: InnerLoop,
        generator: torch.Generator,
        progress: Progress | None = None,
    ) -> Iterator[MetaStep]:
        """Runs lines 9 to 14 of Algorithm 1 on ``model`` in place, an iteration a step; whoever has enough, stops.

        Args:
            model: Randomly initialised model; its theta and embeddings become the meta-trained ones. With a single
                embedding for many situations, which stays as it is, this is Reptile (Nichol et al., 2018).
            data: Encoded transitions of the N situations.
            inner_loop: U^k.
            generator: Source of all the chance.
            progress: Where meta-learning that was stopped goes on from; None begins anew.

        Yields:
            What each iteration did.

        Raises:
            ValueError: There are not as many situations in the data as embeddings in the model.
        """
        n_situations = len(data.x)
        shared = model.n_situations == 1 < n_situations
        if not shared and model.n_situations != n_situations:
            raise ValueError(
                f"The model has {model.n_situations} embeddings, the data {n_situations} situations; make them equal."
            )
        meta_batch_size = min(self.meta_batch_size, n_situations)
        for iteration in (progress or Progress()).iterations(self.iterations, generator, model=model):
            # Sample situations c and start from theta and h_c (line 10).
            order = torch.randperm(n_situations, generator=generator, device=generator.device)
            c = order[:meta_batch_size].to(data.x.device)
            theta, h = model.theta_of(meta_batch_size), model.embeddings_of(c)

            # theta~, h~ = U^k(theta, h_c) (line 11).
            sample = partial(self.sample, data, c, model.members, generator)
            theta_tilde, h_tilde, losses = inner_loop(model, theta, h, sample)

            # Move theta towards the mean of theta~ and each h_c towards its h~ (lines 12 and 13).
            decay = 1.0 - iteration / self.iterations
            for name, value in model.theta.items():
                value.lerp_(theta_tilde[name].mean(dim=0), decay * self.meta_lr)
            if not shared:
                model.embeddings[:, c] = h.lerp(h_tilde, decay * self.embedding_meta_lr).transpose(0, 1)

            yield MetaStep(iteration + 1, c, losses[0].mean().item(), losses[-1].mean().item())

    def sample(self, data: Batch, c: Tensor, members: int, generator: torch.Generator) -> Batch:
        """Draws minibatches of each situation in ``c`` (B,) for each member, (B, P, batch_size), with repetitions."""
        shape = (len(c), members, self.batch_size)
        i = torch.randint(data.x.shape[1], shape, generator=generator, device=generator.device).to(data.x.device)
        return data[c[:, None, None], i]
