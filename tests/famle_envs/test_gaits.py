from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from famle_envs.gaits import FREQUENCY, GAIT_DIM, trot

Array = npt.NDArray[Any]

BACK_LEFT, FRONT_LEFT, FRONT_RIGHT, BACK_RIGHT = LEGS = range(4)
LEFT, RIGHT = [BACK_LEFT, FRONT_LEFT], [FRONT_RIGHT, BACK_RIGHT]
MIRRORED = [BACK_RIGHT, FRONT_RIGHT, FRONT_LEFT, BACK_LEFT]
OTHER_PAIR = [FRONT_LEFT, BACK_LEFT, BACK_RIGHT, FRONT_RIGHT]
PERIOD = 0.5
TIMES = np.linspace(0.0, PERIOD, 101)
CLOSE: dict[str, Any] = {"rtol": 0.0, "atol": 1e-9}

unit = st.floats(-1.0, 1.0)
gaits = st.lists(unit, min_size=4, max_size=4).map(np.array)
moments = st.lists(st.floats(0.0, 10.0), min_size=1, max_size=20).map(np.array)


def height(gait: Array) -> float:
    """E, how far a lift goes at most."""
    return 0.2 * (float(gait[2]) + 1.0)


def with_steer(gait: Array, steer: float) -> Array:
    return np.array([steer, *gait[1:]])


# --- The formulas ---


@given(gaits, moments)
def test_gait_is_the_one_of_the_specification(gait: Array, t: Array) -> None:
    steer, step, extension, offset = gait
    w = 4 * math.pi
    A, B = np.clip(step + steer, -1, 1), np.clip(step - steer, -1, 1)
    E = 0.2 * (extension + 1)
    high, low = np.clip(E + 0.4 * offset, 0, E), np.clip(-E + 0.4 * offset, -E, 0)
    e1 = np.clip(3 * np.sin(w * t + math.pi / 2), low, high)
    e2 = np.clip(3 * np.sin(w * t + 3 * math.pi / 2), low, high)
    front_left, back_left = 0.5 * A * np.sin(w * t), 0.5 * A * np.sin(w * t + math.pi)
    back_right, front_right = 0.5 * B * np.sin(w * t), 0.5 * B * np.sin(w * t + math.pi)
    swing, lift = trot(gait, t)
    np.testing.assert_allclose(swing.T, [back_left, front_left, front_right, back_right], **CLOSE)
    np.testing.assert_allclose(lift.T, [e1, e2, e1, e2], **CLOSE)


@pytest.mark.parametrize("n", [0, 1, 7])
def test_each_leg_has_a_swing_and_a_lift_at_each_time(n: int) -> None:
    swing, lift = trot(np.zeros(GAIT_DIM), np.linspace(0.0, 1.0, n))
    assert swing.shape == lift.shape == (n, len(LEGS))


# --- Laws of all gaits ---


@given(gaits, moments)
def test_swings_and_lifts_are_bounded(gait: Array, t: Array) -> None:
    swing, lift = trot(gait, t)
    assert np.abs(swing).max() <= 0.5
    assert np.abs(lift).max() <= height(gait) + 1e-12 <= 0.4 + 1e-9


@given(gaits, moments, st.integers(1, 5))
def test_gait_repeats_itself_twice_a_second(gait: Array, t: Array, periods: int) -> None:
    assert FREQUENCY * PERIOD == 1.0
    for now, later in zip(trot(gait, t), trot(gait, t + PERIOD * periods), strict=True):
        np.testing.assert_allclose(later, now, **CLOSE)


@given(gaits, moments)
def test_half_a_period_later_each_leg_swings_the_other_way_and_the_other_pair_is_up(gait: Array, t: Array) -> None:
    (swing, lift), (later_swing, later_lift) = trot(gait, t), trot(gait, t + PERIOD / 2)
    np.testing.assert_allclose(later_swing, -swing, **CLOSE)
    np.testing.assert_allclose(later_lift, lift[:, OTHER_PAIR], **CLOSE)


@given(gaits, moments)
def test_diagonal_legs_move_together(gait: Array, t: Array) -> None:
    lift = trot(gait, t)[1]
    straight = trot(with_steer(gait, 0.0), t)[0]
    for one, other in ((BACK_LEFT, FRONT_RIGHT), (FRONT_LEFT, BACK_RIGHT)):
        np.testing.assert_array_equal(lift[:, one], lift[:, other])
        np.testing.assert_array_equal(straight[:, one], straight[:, other])


@given(gaits, moments)
def test_steering_the_other_way_is_the_mirrored_gait_half_a_period_on(gait: Array, t: Array) -> None:
    swing, lift = trot(gait, t)
    mirrored_swing, mirrored_lift = trot(with_steer(gait, -gait[0]), t + PERIOD / 2)
    np.testing.assert_allclose(mirrored_swing[:, MIRRORED], swing, **CLOSE)
    np.testing.assert_allclose(mirrored_lift[:, MIRRORED], lift, **CLOSE)


@given(gaits, moments)
def test_steps_backwards_are_the_same_swings_in_the_other_sense(gait: Array, t: Array) -> None:
    backwards = np.array([-gait[0], -gait[1], *gait[2:]])
    np.testing.assert_array_equal(trot(backwards, t)[0], -trot(gait, t)[0])
    np.testing.assert_array_equal(trot(backwards, t)[1], trot(gait, t)[1])


@given(gaits, moments)
def test_leg_is_on_the_ground_while_it_pushes_the_robot_on(gait: Array, t: Array) -> None:
    """Where a leg swings backwards in a step forwards, it is not lifted."""
    moment = 1e-6
    (before, _), (after, _) = (trot(np.array([0.0, 1.0, *gait[2:]]), t + sign * moment) for sign in (-1, 1))
    lift = trot(gait, t)[1]
    assert (lift[after > before + 1e-9] <= 0.0).all()
    assert (lift[after < before - 1e-9] >= 0.0).all()


# --- What each number does ---


@given(unit, unit, unit, moments)
def test_no_extension_is_no_lift(steer: float, step: float, offset: float, t: Array) -> None:
    np.testing.assert_array_equal(trot(np.array([steer, step, -1.0, offset]), t)[1], 0.0)


@given(unit, unit, unit)
def test_more_extension_is_a_higher_lift(steer: float, one: float, other: float) -> None:
    ranges = [np.ptp(trot(np.array([steer, 1.0, extension, 0.0]), TIMES)[1]) for extension in sorted((one, other))]
    assert ranges[0] <= ranges[1] + 1e-12
    np.testing.assert_allclose(ranges, 0.4 * (np.sort([one, other]) + 1.0), **CLOSE)


@pytest.mark.parametrize(("offset", "low", "high"), [(-1.0, -0.4, 0.0), (0.0, -0.4, 0.4), (1.0, 0.0, 0.4)])
def test_offset_moves_the_lift_between_down_only_and_up_only(offset: float, low: float, high: float) -> None:
    lift = trot(np.array([0.0, 1.0, 1.0, offset]), TIMES)[1]
    np.testing.assert_allclose([lift.min(axis=0), lift.max(axis=0)], [[low] * 4, [high] * 4], **CLOSE)


@given(unit, unit)
def test_offset_in_between_lets_no_leg_further_down_where_it_lifts_them_up(extension: float, offset: float) -> None:
    lift = trot(np.array([0.0, 1.0, extension, offset]), TIMES)[1]
    assert lift.max() <= 0.4 * offset + 0.2 * (extension + 1.0) + 1e-12 or lift.max() == 0.0
    assert lift.min() >= 0.4 * offset - 0.2 * (extension + 1.0) - 1e-12 or lift.min() == 0.0


@given(unit, unit, unit)
def test_legs_swing_by_half_the_step_where_nobody_steers(step: float, extension: float, offset: float) -> None:
    swing = trot(np.array([0.0, step, extension, offset]), TIMES)[0]
    np.testing.assert_allclose(swing.max(axis=0), 0.5 * abs(step), **CLOSE)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_legs_on_the_outside_of_a_curve_take_the_longer_steps(steer: float, step: float) -> None:
    right_curve = np.ptp(trot(np.array([steer, step, 0.0, 0.0]), TIMES)[0], axis=0)
    np.testing.assert_allclose(right_curve[LEFT], min(step + steer, 1.0), **CLOSE)
    np.testing.assert_allclose(right_curve[RIGHT], abs(step - steer), **CLOSE)


@given(unit, moments)
def test_steering_on_the_spot_swings_the_legs_of_a_pair_against_each_other(steer: float, t: Array) -> None:
    swing = trot(np.array([steer, 0.0, 0.0, 0.0]), t)[0]
    np.testing.assert_array_equal(swing[:, FRONT_LEFT], -swing[:, BACK_RIGHT])
    np.testing.assert_array_equal(swing[:, BACK_LEFT], -swing[:, FRONT_RIGHT])
