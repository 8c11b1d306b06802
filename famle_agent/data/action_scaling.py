"""Between the units of an environment and those of the model, with the checks that belong there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from torch import Tensor

__all__ = ["ActionScale", "check_action", "check_observation", "to_action_space"]

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
    return np.clip(actions.astype(space.dtype), space.low, space.high)


def check_observation(observation: Any, space: spaces.Box) -> Array:
    """An observation (obs_dim,) or (B, obs_dim) as an array.

    Raises:
        ValueError: It has another shape, is not finite, or is the pair that Gymnasium's ``reset`` returns.
    """
    if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
        raise ValueError("Got (obs, info), as Gymnasium's reset() returns it; give obs alone.")
    return _check("observation", observation, space)


def check_action(action: Any, space: spaces.Box) -> Array:
    """An action (action_dim,) or (B, action_dim) as an array.

    Raises:
        ValueError: It has another shape or is not finite.
    """
    return _check("action", action, space)


def _check(name: str, values: Any, space: spaces.Box) -> Array:
    try:
        array = np.array(values, dtype=np.float32)  # a copy: an environment may fill the same array again
    except (TypeError, ValueError) as error:
        raise ValueError(f"The {name} must be an array of numbers, got {type(values).__name__}.") from error
    if array.ndim not in (1, 2) or array.shape[-1:] != space.shape:
        raise ValueError(
            f"The {name} must have shape {space.shape}, or (B, {space.shape[0]}) for B robots, got {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"The {name} holds NaN or infinite values: {array}. Check the robot's sensors and commands.")
    return array
