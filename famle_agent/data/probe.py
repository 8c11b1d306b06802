"""Trying functions that users and environments give, on a batch, before anything rests on them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

__all__ = ["check_reward_fn", "check_termination_fn", "same_reward"]

_SHAPE = (2, 3)  # two leading axes, as candidates and robots are when a plan is imagined


def check_reward_fn(reward_fn: Any, observation_space: spaces.Box, action_space: spaces.Box, device: Any) -> None:
    """Refuses a reward function with which no plan can be judged.

    Raises:
        ValueError: It is no function of batches of (s, a, s'), fails on one, changes what it is given, or returns
            anything but one reward a transition.
    """
    _try("reward_fn", reward_fn, "(obs, action, next_obs)", _transitions(observation_space, action_space, device))


def check_termination_fn(termination_fn: Any, observation_space: spaces.Box, device: Any) -> None:
    """Refuses a termination function as :func:`check_reward_fn` does a reward."""
    _try("termination_fn", termination_fn, "(next_obs)", (_within(observation_space, 0, device),))


def same_reward(
    one: Callable[..., Any], other: Callable[..., Any], observation_space: spaces.Box, action_space: spaces.Box
) -> bool:
    """Says whether two reward functions agree on a batch, so that they are of the same task."""
    rewards = [
        torch.as_tensor(reward_fn(*_transitions(observation_space, action_space, "cpu"))).float()
        for reward_fn in (one, other)
    ]
    return bool(torch.allclose(rewards[0], rewards[1], equal_nan=True))


def _try(name: str, function: Any, arguments: str, given: tuple[Tensor, ...]) -> None:
    remedy = f"Give {name}{arguments} for torch tensors (..., dim) that returns a tensor (...)"
    if not callable(function):
        raise ValueError(f"{name} must be a function, got {function!r}. {remedy}.")
    before = [values.clone() for values in given]
    try:
        returned = torch.as_tensor(function(*given))
    except Exception as error:
        raise ValueError(
            f"{name} failed on a batch of shape {_SHAPE} ({type(error).__name__}: {error}). {remedy}."
        ) from error
    if not all(torch.equal(values, known) for values, known in zip(given, before, strict=True)):
        raise ValueError(
            f"{name} changes what it is given, which would corrupt every plan: write `x = x - y` instead of `x -= y`."
        )
    if tuple(returned.shape) != _SHAPE or returned.is_complex():
        raise ValueError(
            f"{name} must return one real number a transition: for observations {tuple(given[0].shape)} a tensor "
            f"{_SHAPE}, got {returned.dtype} {tuple(returned.shape)}. {remedy}; sum or squeeze over the last axis "
            "alone (dim=-1)."
        )


def _transitions(observation_space: spaces.Box, action_space: spaces.Box, device: Any) -> tuple[Tensor, Tensor, Tensor]:
    return (
        _within(observation_space, 0, device),
        _within(action_space, 1, device),
        _within(observation_space, 2, device),
    )


def _within(space: spaces.Box, seed: int, device: Any) -> Tensor:
    """Numbers of a space, (2, 3, dim): uniform between its bounds, normal where it has none."""
    rng, bounded = np.random.default_rng(seed), space.bounded_below & space.bounded_above
    low, high = (np.where(bounded, end, fallback) for end, fallback in ((space.low, 0.0), (space.high, 1.0)))
    shape = (*_SHAPE, *space.shape)
    inside = low + rng.random(shape) * (high - low)
    unbounded = np.clip(rng.standard_normal(shape), space.low, space.high)
    return torch.as_tensor(np.where(bounded, inside, unbounded), dtype=torch.float32, device=device)
