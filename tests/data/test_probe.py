"""Functions of users are tried on a batch before anything is simulated."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from famle_agent import FAMLE
from famle_agent.data.probe import check_reward_fn, same_reward

OBS, ACTION = spaces.Box(-np.inf, np.inf, (4,)), spaces.Box(-2.0, 3.0, (2,))


class Point(gym.Env[Any, Any]):
    """Counts its steps."""

    observation_space, action_space, steps = OBS, ACTION, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action: Any) -> Any:
        Point.steps += 1
        return np.zeros(4, np.float32), 0.0, False, False, {}


def in_place(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
    next_obs -= 1.0
    return -next_obs.norm(dim=-1)


def in_place_on_actions(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
    action[..., 0].clamp_(0.0, 0.1)
    return action.sum(dim=-1)


WRONG: dict[str, tuple[Any, str]] = {
    "column": (lambda o, a, n: -n.norm(dim=-1, keepdim=True), r"got torch.float32 \(2, 3, 1\)"),
    "scalar": (lambda o, a, n: n.mean(), r"got torch.float32 \(\)"),
    "number": (lambda o, a, n: 1.0, r"one real number a transition"),
    "dimensions": (lambda o, a, n: n, r"\(2, 3, 4\)"),
    "first row": (lambda o, a, n: n[0, :, 0], r"\(3,\)"),
    "nothing": (lambda o, a, n: None, "failed on a batch"),
    "complex": (lambda o, a, n: n[..., 0] + 1j, "real number"),
    "two arguments": (lambda o, a: a.sum(dim=-1), "failed on a batch.*TypeError"),
    "fails": (lambda o, a, n: n[..., 9], "failed on a batch.*IndexError"),
    "text": ("dense", "must be a function, got 'dense'"),
    "number instead": (3, "must be a function"),
    "in place": (in_place, r"changes what it is given.*x = x - y"),
    "in place on actions": (in_place_on_actions, "changes what it is given"),
}


@pytest.mark.parametrize("of_the_environment", [False, True])
@pytest.mark.parametrize(("reward_fn", "message"), WRONG.values(), ids=WRONG.keys())
def test_reward_that_cannot_judge_is_refused_before_anything_moves(
    reward_fn: Any, message: str, of_the_environment: bool
) -> None:
    Point.steps, env = 0, Point()
    if of_the_environment:
        env.reward_fn = reward_fn  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=message):
        FAMLE(env, device="cpu", **({} if of_the_environment else {"reward_fn": reward_fn}))
    assert Point.steps == 0


@pytest.mark.parametrize(
    ("termination_fn", "message"),
    [
        (lambda n: n[..., :1] > 0, "one real number"),
        (lambda n: (n > 0).any(), "one real number"),
        (lambda o, n: n[..., 0] > 0, "failed on a batch"),
        ("never", "must be a function"),
        (lambda n: n.abs_()[..., 0] > 0, "changes what it is given"),
    ],
)
def test_termination_that_cannot_judge_is_refused(termination_fn: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FAMLE(Point(), device="cpu", termination_fn=termination_fn)
    env = Point()
    env.termination_fn = termination_fn  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match=message):
        FAMLE(env, device="cpu")


@pytest.mark.parametrize(
    "reward_fn",
    [
        lambda o, a, n: n[..., 0],
        lambda o, a, n: (n[..., 0] > 0).float(),
        lambda o, a, n: n[..., 0] > 0,
        lambda o, a, n: np.exp(-np.abs(n.numpy()).sum(axis=-1)),
        lambda o, a, n: torch.zeros(n.shape[:-1], dtype=torch.float64),
    ],
    ids=["view", "float", "bool", "numpy", "double"],
)
def test_rewards_that_judge_are_taken(reward_fn: Any) -> None:
    FAMLE(Point(), device="cpu", reward_fn=reward_fn)


def test_given_numbers_lie_in_the_spaces() -> None:
    seen: list[tuple[Tensor, ...]] = []

    def look(*given: Tensor) -> Tensor:
        seen.append(given)
        return given[0][..., 0]

    half = spaces.Box(np.array([0.0, -1.0, -np.inf, -np.inf], np.float32), np.array([1, 1, np.inf, 2], np.float32))
    check_reward_fn(look, half, ACTION, "cpu")
    (obs, action, next_obs), *_ = seen
    for values, space in ((obs, half), (action, ACTION), (next_obs, half)):
        assert ((values >= torch.from_numpy(space.low)) & (values <= torch.from_numpy(space.high))).all()
    assert not torch.equal(obs, next_obs)


def test_rewards_of_two_goals_are_not_the_same() -> None:
    def towards(x: float) -> Any:
        return lambda o, a, n: -(n[..., 0] - x).abs()

    assert same_reward(towards(1.0), towards(1.0), OBS, ACTION)
    assert not same_reward(towards(1.0), towards(-1.0), OBS, ACTION)
