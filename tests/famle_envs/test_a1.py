"""The A1: its own body and gait. What all robots have in common is in test_engines.py and test_profile.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from famle_envs import Situation
from famle_envs.a1 import HELD_OUT, A1Env
from famle_envs.goal_walker import LEGS
from famle_envs.quadruped import QuadrupedEnv
from tests.helpers import making, walk, watch
from tests.worlds import joint_angles, masses

pytest.importorskip("pybullet_data")

Array = npt.NDArray[Any]
Make = Callable[..., A1Env]

STAND, FORWARDS, BACKWARDS, RIGHT, LEFT = (
    np.array(gait) for gait in ([0, 0, -1, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0.4, 0, 0, 0], [-0.4, 0, 0, 0])
)
ALL_JOINTS = np.array([0.9, 0.2, 0.5, 0.0])
"""A gait in which each joint moves by more than 0.1 rad."""


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(A1Env, engine) as make_robot:
        yield make_robot


def yaws(rows: Array) -> Array:
    return np.unwrap(np.arctan2(rows[:, 2], rows[:, 3]))


# --- Standing and walking ---


def test_robot_weighs_what_an_a1_does(make: Make) -> None:
    assert masses(make()).sum() == pytest.approx(12.458)


def test_robot_starts_at_the_origin_and_stands_level_on_bent_legs(make: Make) -> None:
    env = make()
    assert env.reset()[0] == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=0.01)
    walk(env, STAND, 2)
    np.testing.assert_allclose(env.position, [0.0, 0.0, 0.25], atol=0.02)
    np.testing.assert_allclose(joint_angles(env), env.rest_angles, atol=0.05)


@pytest.mark.parametrize(("gait", "sign"), [(FORWARDS, 1.0), (BACKWARDS, -1.0)], ids=["forwards", "backwards"])
def test_positive_step_walks_forwards_and_negative_step_backwards(make: Make, gait: Array, sign: float) -> None:
    rows = walk(make(), gait, 3)
    assert (np.diff(sign * rows[:, 0]) > 0.25).all()
    assert np.abs(rows[:, 1]).max() < 0.1
    assert np.abs(yaws(rows)).max() < 0.2


@pytest.mark.parametrize(("gait", "sign"), [(RIGHT, -1.0), (LEFT, 1.0)], ids=["right", "left"])
def test_positive_steer_turns_right_and_negative_steer_left_on_the_spot(make: Make, gait: Array, sign: float) -> None:
    rows = walk(make(), gait, 2)
    assert (np.diff(sign * yaws(rows)) > 0.5).all()
    assert np.abs(rows[:, :2]).max() < 0.15


def test_robot_stays_on_its_feet_whatever_the_gaits(make: Make) -> None:
    env = make(situation="front left leg blocked")
    for action in np.random.default_rng(0).uniform(-1, 1, (15, 4)):
        env.step(action)
        assert env.position[2] > 0.18


# --- Situations ---


@pytest.mark.parametrize("joint", range(12))
def test_blocked_joint_stays_at_its_angle_while_the_others_move(make: Make, joint: int) -> None:
    env = make(situation={"locked_joints": [joint]})
    angles = watch(env, ALL_JOINTS, joint_angles)
    assert np.abs(angles[:, joint] - env.rest_angles[joint]).max() < 0.03
    assert np.delete(np.ptp(angles, axis=0), joint).min() > 0.1


def test_robot_with_a_blocked_leg_gets_elsewhere_and_not_as_far(make: Make) -> None:
    env = make()
    intact = walk(env, FORWARDS, 3)[-1]
    ends = []
    for leg in range(len(LEGS)):
        env.reset(options={"situation": f"{LEGS[leg]} leg blocked"})
        assert env.situation.locked_joints == (3 * leg, 3 * leg + 1, 3 * leg + 2)
        ends.append(walk(env, FORWARDS, 3)[-1])
    assert np.max(ends, axis=0)[0] < 0.9 * intact[0]
    for i in range(len(ends)):
        assert np.abs(np.delete(ends, i, axis=0) - ends[i]).max(axis=1).min() > 0.05


@pytest.mark.parametrize(
    ("situation", "gait", "slower"),
    [("weak motors", FORWARDS, 0.7), ("slippery floor", [0, 1, 1, 0], 0.5)],
    ids=["weak motors", "slippery floor"],
)
def test_robot_does_not_get_as_far(make: Make, situation: str, gait: Any, slower: float) -> None:
    env = make()
    far = walk(env, gait, 3)[-1, 0]
    env.reset(options={"situation": situation})
    assert walk(env, gait, 3)[-1, 0] < slower * far


def test_payload_is_as_heavy_as_the_trunk(make: Make) -> None:
    assert masses(make(situation="payload")).sum() == pytest.approx(12.458 + 4.713)


def test_motors_of_one_leg_may_be_weak(make: Make) -> None:
    env, intact = make(situation="motor 3 strength x 0.1, motor 4 strength x 0.1, motor 5 strength x 0.1"), make()
    sunk = np.abs(np.subtract(*(walk(robot, FORWARDS) for robot in (env, intact))))
    assert sunk.max() > 0.05
    env.set_situation(None)
    env.reset()
    np.testing.assert_array_equal(walk(env, FORWARDS), walk(make(), FORWARDS))


def test_yaw_error_turns_the_measured_heading_only(make: Make) -> None:
    true, off = walk(make(), FORWARDS, 2), walk(make(situation={"orientation_error": 0.5}), FORWARDS, 2)
    np.testing.assert_array_equal(off[:, :2], true[:, :2])
    np.testing.assert_allclose(yaws(off), yaws(true) + 0.5, atol=1e-5)


def test_task_and_training_are_those_of_the_quadruped() -> None:
    assert A1Env.training_situations == QuadrupedEnv.training_situations
    assert QuadrupedEnv.presets.items() <= A1Env.presets.items()
    assert A1Env.task_arguments == QuadrupedEnv.task_arguments


def test_presets_may_be_composed_and_motors_beyond_the_last_are_refused(make: Make) -> None:
    env = make(situation="front left leg blocked + payload + slippery floor")
    assert env.situation == Situation(locked_joints=(3, 4, 5), base_mass=2.0, friction=0.2)
    with pytest.raises(ValueError, match="those of A1Env are 0 to 11"):
        env.set_situation("motor 12 strength x 0.5")


@pytest.mark.parametrize("robot", [A1Env, QuadrupedEnv])
def test_sampled_situation_is_a_blocked_leg_and_a_yaw_error_that_was_not_trained(robot: type[A1Env]) -> None:
    first, again = ([robot.sample_situation(rng) for _ in range(50)] for rng in map(np.random.default_rng, (7, 7)))
    assert first == again
    assert not set(first) & set(robot.training_situations)
    assert {situation.locked_joints for situation in first} == {(i, i + 1, i + 2) for i in (0, 3, 6, 9)}
    assert min(abs(situation.orientation_error) for situation in first) >= math.radians(15)


def test_held_out_dynamics_are_the_quadruped_s_with_motors_that_can_carry_it(make: Make) -> None:
    assert HELD_OUT.zero_errors == QuadrupedEnv.profiles["held-out"].zero_errors
    env = make(profile="held-out")
    walk(env, STAND)
    assert env.position[2] > 0.2


# --- Rendering ---


def test_picture_shows_the_robot_and_its_faulty_leg_in_red(make: Make) -> None:
    env = make(render_mode="rgb_array")
    before = env.render()
    env.set_situation("front left leg blocked")
    red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
    assert ((red > 100) & (red > 2 * green) & (red > 2 * blue)).sum() > 200
    env.set_situation(None)
    np.testing.assert_array_equal(env.render(), before)
