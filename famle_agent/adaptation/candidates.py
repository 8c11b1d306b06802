"""The embeddings among which line 2 of Algorithm 2 selects: those of the training situations, and sums of two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics

__all__ = ["Candidates"]

_KINDS = (0.4, 0.4, 0.2)  # how likely no fault is, one, and two


@dataclass(frozen=True)
class Candidates:
    """The embeddings among which the most likely one is selected: those of the training situations, and their sums.

    Where h enters a model linearly, h_i + h_j - h_0 is the situation with both faults, if h_0 is the intact robot.

    Attributes:
        h: (R, P, C, embedding_dim), those of the N training situations first; R is 1 where robots share networks.
        pairs: What each consists of, (C, 2): the situations i and j; j = 0 where it is i alone.
    """

    h: Tensor
    pairs: Tensor

    @classmethod
    def of(cls, model: Dynamics, compose: bool) -> Candidates:
        """Takes H_meta, and with ``compose`` the sums of two situations other than the first, the intact robot."""
        n = model.n_situations
        alone = torch.stack([torch.arange(n), torch.zeros(n, dtype=torch.long)], dim=1)
        both = torch.combinations(torch.arange(1, n)) if compose else alone[:0]
        pairs = torch.cat([alone, both]).to(model.embeddings.device)
        H = model.embeddings_for(model.robots)
        h = H[:, :, pairs[:, 0]] + H[:, :, pairs[:, 1]] - H[:, :, :1]
        return cls(h, pairs)

    @cached_property
    def log_prior(self) -> Tensor:
        """How likely each is before anything is seen, (C,); probabilities that sum to 1.

        Without sums all are alike, as in the paper. With them the intact robot is as likely as all single faults
        together, and twice as likely as all sums.
        """
        faults = (self.pairs > 0).sum(dim=1)  # of each candidate
        if int(faults.max()) < 2:
            return self.h.new_zeros(len(faults)).log_softmax(dim=0)
        kind = self.h.new_tensor(_KINDS) / faults.bincount()
        return kind[faults].log().log_softmax(dim=0)

    @cached_property
    def shares(self) -> Tensor:
        """How much of each training situation each is, (C, N): e_i, or e_i + e_j - e_0."""
        unit = torch.eye(int((self.pairs[:, 1] == 0).sum()), dtype=self.h.dtype, device=self.h.device)
        return unit[self.pairs[:, 0]] + unit[self.pairs[:, 1]] - unit[0]

    def marginal(self, posterior: Tensor) -> Tensor:
        """Computes how likely each training situation is, alone or as a part: (B, C) -> (B, N)."""
        return posterior @ (self.shares > 0.0).to(posterior.dtype)

    def names(self, situations: Sequence[str]) -> list[str]:
        """Names the candidates, given the names of the training situations."""
        return [situations[i] if j == 0 else f"{situations[i]} + {situations[j]}" for i, j in self.pairs.tolist()]

    def chosen(self, index: Tensor) -> Tensor:
        """Takes a candidate for each robot, (B, 1), or for each member, (B, P), as (B, P, embedding_dim)."""
        h = self.h.expand(len(index), *self.h.shape[1:])  # (B, P, C, embedding_dim)
        return h.take_along_dim(index.expand(h.shape[:2])[..., None, None], dim=2)[:, :, 0]

    def log_likelihood(self, model: Dynamics, data: Batch) -> Tensor:
        """Computes log p(s' | s, a, theta_meta, h) of transitions for each candidate, a mean over the ensemble.

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots, (B, n).

        Returns:
            (B, n, C); 0 for padding.
        """
        residual = self.residuals(model, data)
        log_p = model.log_density(residual.flatten(2, 3)).view(len(residual), *residual.shape[2:4])
        return log_p * data.weight[..., None]

    def residuals(self, model: Dynamics, data: Batch) -> Tensor:
        """Computes the errors of theta_meta with each candidate in fitted deviations, (B, P, n, C, obs_dim).

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots, (B, n).
        """
        robots, n = data.weight.shape
        owners, C = model.robots, len(self.pairs)
        sharing = robots // owners  # B robots share the networks, or each has its own

        # The data of all robots that share a network under each candidate, side by side.
        def rows(values: Tensor) -> Tensor:
            flat = values.reshape(owners, 1, sharing * n, *values.shape[2:])
            return flat.expand(owners, C, *flat.shape[2:]).flatten(1, 2)  # (R, C * sharing * n, ...)

        h = self.h.repeat_interleave(sharing * n, dim=2)
        batch = Batch(rows(data.x), rows(data.y), rows(data.weight))
        residual = model.residuals(batch, h, model.theta_of(owners))  # (R, P, C * sharing * n, obs_dim)
        parts = residual.view(*residual.shape[:2], C, sharing, n, -1)
        return parts.permute(0, 3, 1, 4, 2, 5).flatten(0, 1)
