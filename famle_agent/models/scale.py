"""Scales of data in whatever units they come."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["deviations", "unresolved"]

_CONSTANT = 1e-6  # part of a number's size within which it has not varied: the mean of many is as exact
_ROUNDING = 2.5e-7  # the same of a difference of two float32, some of whose deviations of rounding are 5e-8
_COARSE = 1e-6  # part of a number's size below which float32 shows a change with no more than one digit


def deviations(values: Tensor, size: Tensor | None = None) -> Tensor:
    """Computes the standard deviation of each dimension, (n, dim) -> (dim,), and 1 where it does not vary.

    What never varies carries nothing, and must not be blown up. Whether it does is a question of rounding alone, so
    that it does not depend on the unit.

    Args:
        values: The data.
        size: Of the numbers whose differences the data are, (dim,); None where they are no differences.
    """
    if not values.shape[1]:  # a model may see no more than the actions
        return values.mean(dim=0)
    least = _CONSTANT * values.abs().amax(dim=0) if size is None else _ROUNDING * size
    std = values.std(dim=0)
    return torch.where(std > least, std, 1.0)


def unresolved(obs: Tensor, next_obs: Tensor) -> list[int]:
    """Names the dimensions whose changes are too small beside their size for single precision to show.

    Args:
        obs: (n, obs_dim).
        next_obs: As ``obs``.
    """
    size = torch.maximum(obs.abs().amax(dim=0), next_obs.abs().amax(dim=0))
    change = (next_obs.double() - obs.double()).square().mean(dim=0).sqrt()
    lost: list[int] = ((change > 0.0) & (change < _COARSE * size)).nonzero()[:, 0].tolist()
    return lost
