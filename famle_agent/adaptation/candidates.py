"""The embeddings among which the most likely one is selected: those of the training situations, and their sums.

Where h enters a model linearly, h_i + h_j - h_0 is the situation with both faults, if h_0 is the intact robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics

__all__ = ["Candidates"]


@dataclass(frozen=True)
class Candidates:
    """The embeddings among which the most likely one is selected.

    Attributes:
        h: (R * P, C, embedding_dim), those of the N training situations first; R is 1 where robots share networks.
        pairs: What each consists of, (C, 2): the situations i and j; j = 0 where it is i alone.
    """

    h: Tensor
    pairs: Tensor

    @classmethod
    def of(cls, model: Dynamics, compose: bool) -> Candidates:
        """H_meta, and with ``compose`` the sums of two situations other than the first, which is the intact robot."""
        n = model.n_situations
        alone = torch.stack([torch.arange(n), torch.zeros(n, dtype=torch.long)], dim=1)
        both = torch.combinations(torch.arange(1, n)) if compose else alone[:0]
        pairs = torch.cat([alone, both]).to(model.embeddings.device)
        H = model.embeddings.detach()
        h = H[:, pairs[:, 0]] + H[:, pairs[:, 1]] - H[:, :1]
        return cls(h, pairs)

    @property
    def log_prior(self) -> Tensor:
        """One fault is as likely as two, (C,); probabilities that sum to 1."""
        single = self.pairs[:, 1] == 0
        size = torch.where(single, single.sum(), (~single).sum())
        return (-size.float().log()).log_softmax(dim=0)

    def marginal(self, posterior: Tensor) -> Tensor:
        """How likely each training situation is, alone or as a part: (B, C) -> (B, N)."""
        n = int((self.pairs[:, 1] == 0).sum())
        total = posterior.clone()[:, :n]
        both, (i, j) = posterior[:, n:], self.pairs[n:].T
        return total.index_add(1, i, both).index_add(1, j, both)

    def names(self, situations: Sequence[str]) -> list[str]:
        """What the candidates are called, given the names of the training situations."""
        return [situations[i] if j == 0 else f"{situations[i]} + {situations[j]}" for i, j in self.pairs.tolist()]

    def log_likelihood(self, model: Dynamics, data: Batch) -> Tensor:
        """Log p(s' | s, a, theta_meta, h) of the data of B robots for each candidate, a mean over the ensemble.

        Args:
            model: Holds theta_meta.
            data: Encoded transitions of the B robots.

        Returns:
            (B, n, C); 0 for padding.
        """
        robots, n = data.weight.shape
        owners, members, size = model.robots, model.members, self.h.shape[1]
        sharing = robots // owners  # B robots share the networks, or each has its own

        # The data of all robots that share a network under each candidate, side by side: C * sharing * n rows.
        def rows(values: Tensor) -> Tensor:
            flat = values.reshape(owners, 1, 1, sharing * n, *values.shape[2:])
            return flat.expand(owners, members, size, *flat.shape[3:]).flatten(2, 3).flatten(0, 1)

        h = self.h.repeat_interleave(sharing * n, dim=1)
        batch = Batch(rows(data.x), rows(data.y), rows(data.weight))
        log_p = model.log_likelihood(model.parameters_by_name(), h, batch)
        log_p = log_p.view(owners, members, size, sharing, n).mean(dim=1)  # (R, C, sharing, n)
        # An observation beyond all measure would make every likelihood -inf and the posterior meaningless.
        return log_p.permute(0, 2, 3, 1).flatten(0, 1).clamp(min=-1e30)
