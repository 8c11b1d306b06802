from __future__ import annotations

import numpy as np
import pytest

from benchmarks.gym_robots import Actor as AtRandom
from benchmarks.gym_robots import Hanging, rollout
from benchmarks.pendulum_limit import best_return


@pytest.mark.parametrize(("mass", "length"), [(1.0, 1.0), (1.7, 0.3)])
def test_nothing_is_better_than_the_limit(mass: float, length: float) -> None:
    limit = best_return(mass, length, states=101, torques=5)
    at_random, _ = rollout(Hanging(mass, length), AtRandom(), seed=0)
    resting = -200 * np.pi**2
    assert resting < at_random < limit < 0.0


def test_a_finer_grid_says_the_same() -> None:
    coarse, fine = (best_return(1.7, 0.3, states=states, torques=5) for states in (101, 151))
    assert coarse == pytest.approx(fine, rel=0.1)


def test_a_pendulum_that_the_motor_can_lift_at_once_costs_less_than_one_that_it_has_to_swing() -> None:
    assert best_return(0.2, 0.5, states=101, torques=5) > best_return(1.0, 1.0, states=101, torques=5)
