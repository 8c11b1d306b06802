"""What a model learns does not depend on the units of an environment."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.models.dynamics import Dynamics
from famle_agent.models.observation import ObservationLayout
from famle_agent.models.reward import LearnedReward
from famle_agent.models.scale import deviations, unresolved
from famle_agent.planning import MPPI

UNITS = st.integers(-40, 40).map(lambda power: 2.0**power)  # by which float32 is multiplied without any rounding


def some(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Transitions whose third dimension never changes, and whose fourth changes by its rounding alone."""
    generator = torch.Generator().manual_seed(seed)
    obs = torch.randn(500, 4, generator=generator)
    next_obs = obs + 0.05 * torch.randn(500, 4, generator=generator)
    obs[:, 2] = next_obs[:, 2] = 0.3
    obs[:, 3], next_obs[:, 3] = 0.7, 0.7 + 6e-8 * torch.randint(2, (500,), generator=generator)
    return obs, torch.rand(500, 2, generator=generator) * 2 - 1, next_obs


@given(st.integers(0, 100), UNITS)
def test_model_sees_the_same_in_all_units(seed: int, unit: float) -> None:
    obs, action, next_obs = some(seed)
    model, scaled = (Dynamics(4, 2, 1, normalise_actions=True) for _ in range(2))
    model.fit_normalisation(obs, action, next_obs)
    scaled.fit_normalisation(unit * obs, action, unit * next_obs)
    one = model.encode(obs[None], action[None], next_obs[None])
    other = scaled.encode(unit * obs[None], action[None], unit * next_obs[None])
    varying = [0, 1]
    torch.testing.assert_close(one.x[..., varying], other.x[..., varying])
    torch.testing.assert_close(one.y[..., varying], other.y[..., varying])
    torch.testing.assert_close(scaled.target_std[:2], unit * model.target_std[:2])
    assert model.input_std[2] == scaled.input_std[2] == 1.0
    assert (model.target_std[2:] == 1.0).all()
    assert (scaled.target_std[2:] == 1.0).all()


@given(st.integers(0, 100), UNITS, UNITS)
def test_learnt_reward_is_the_same_in_all_units(seed: int, unit: float, of_reward: float) -> None:
    obs, action, next_obs = (values[:, :2] for values in some(seed))
    reward, predictions = -next_obs[:, 0].abs(), []
    for u, r in ((1.0, 1.0), (unit, of_reward)):
        torch.manual_seed(0)
        learned = LearnedReward(ObservationLayout(2), 2, width=8)
        generator = torch.Generator().manual_seed(1)
        learned.fit(u * obs, action, u * next_obs, r * reward, generator, steps=5)
        predictions.append(learned(u * obs, action, u * next_obs)[:, None] / r)
    torch.testing.assert_close(*predictions, rtol=1e-3, atol=1e-3)


def test_constant_reward_is_learnt() -> None:
    obs, action, next_obs = some(0)
    learned = LearnedReward(ObservationLayout(4), 2, width=8)
    learned.fit(obs, action, next_obs, torch.full((500,), 3.0), torch.Generator().manual_seed(0), steps=400)
    torch.testing.assert_close(learned(obs, action, next_obs), torch.full((500,), 3.0), atol=0.3, rtol=0.0)


@given(st.floats(-1e6, 1e6), st.integers(2, 2000))
def test_constant_is_not_blown_up(value: float, n: int) -> None:
    assert deviations(torch.full((n, 1), value)).tolist() == [1.0]


@given(UNITS)
def test_planner_prefers_the_same_in_all_units(unit: float) -> None:
    planner = MPPI(horizon=3, candidates=50, iterations=2)

    def plan(scale: float) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        return planner.plan(lambda tau: -scale * (tau - 0.5).square().sum((-2, -1)), torch.zeros(1, 3, 2), generator)[1]

    torch.testing.assert_close(plan(1.0), plan(unit))


@pytest.mark.parametrize(
    ("offset", "step", "lost"),
    [(0.0, 0.1, []), (0.0, 1e-9, []), (1e3, 0.1, []), (3948996.0, 0.1, [0]), (1.0, 5e-7, [0]), (5.0, 0.0, [])],
)
def test_changes_that_single_precision_does_not_show(offset: float, step: float, lost: list[int]) -> None:
    walk = torch.linspace(0, 2 * math.pi, 1000, dtype=torch.float64).sin().cumsum(0) * step
    obs = torch.stack([offset + walk, walk], dim=1).float()
    assert unresolved(obs[:-1], obs[1:]) == lost
