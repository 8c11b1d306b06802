"""Between the units of an environment and those of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from torch import Tensor

__all__ = ["ActionScale", "to_action_space"]

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class ActionScale:
    """Actions of a Box space as [-1, 1] and back.

    Attributes:
        low: Lower bounds, (action_dim,).
        high: Upper bounds, (action_dim,).
        is_identity: Whether they are -1 and 1, so that there is nothing to do.
    """

    low: Tensor
    high: Tensor
    is_identity: bool = False

    @classmethod
    def of(cls, space: spaces.Box, device: torch.device) -> ActionScale:
        """The scale of an action space."""
        low, high = (torch.as_tensor(end, dtype=torch.float32, device=device) for end in (space.low, space.high))
        return cls(low, high, is_identity=bool((low == -1.0).all() and (high == 1.0).all()))

    def to_unit(self, action: Tensor) -> Tensor:
        """From the action space to [-1, 1], (..., action_dim)."""
        return action if self.is_identity else 2.0 * (action - self.low) / (self.high - self.low) - 1.0

    def from_unit(self, action: Tensor) -> Tensor:
        """From [-1, 1] to the action space, (..., action_dim)."""
        return action if self.is_identity else self.low + 0.5 * (action + 1.0) * (self.high - self.low)


def to_action_space(action: Tensor, space: spaces.Box) -> Array:
    """Actions in [-1, 1], (..., action_dim), as arrays that lie in an action space, rounding included."""
    actions = ActionScale.of(space, action.device).from_unit(action).cpu().numpy()
    if np.issubdtype(space.dtype, np.integer):
        actions = np.rint(actions)
    return np.clip(actions.astype(space.dtype), space.low, space.high)
