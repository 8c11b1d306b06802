from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from famle_envs.gait_env import GaitEnv
from famle_envs.gaits import trot
from famle_envs.quadruped import QuadrupedEnv
from tests.helpers import making, quadruped_with, walk, watch
from tests.worlds import joint_angles, joint_speeds, put, turn_joint, without_gravity

Make = Callable[..., QuadrupedEnv]

STAND, FORWARDS = np.array([0.0, 0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
HIP = 0


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(quadruped_with, engine) as make_robot:
        yield make_robot


def test_joints_follow_their_commands_leg_by_leg(make: Make) -> None:
    """In each of the two physics steps of a command, a servo without load makes good a tenth of its joint's error."""
    gait = np.array([0.3, 0.7, 1.0, 0.5])
    swing, lift = trot(gait, np.arange(100) * 0.01)
    (bl, fl, fr, br), (e1, e2, *_) = swing.T, lift.T
    commanded = math.pi / 4 * np.array([bl, e1, e1, fl, e2, e2, -fr, e1, e1, -br, e2, e2]).T
    expected = np.zeros((101, 12))
    for t, command in enumerate(commanded):
        expected[t + 1] = command + 0.9**2 * (expected[t] - command)
    env = make()
    without_gravity(env)
    put(env, (0.0, 0.0, 5.0))
    np.testing.assert_allclose(watch(env, gait, joint_angles), expected[1:], atol=0.03)
    assert np.ptp(expected, axis=0).min() > 0.2


def test_latency_lets_the_commands_arrive_later(make: Make) -> None:
    prompt, late = (watch(make(**kwargs), FORWARDS, joint_angles)[:, HIP] for kwargs in ({}, {"latency": 0.2}))
    np.testing.assert_allclose(late[:19], 0.0, atol=0.01)
    np.testing.assert_allclose(late[20:], prompt[:-20], atol=0.02)
    assert np.ptp(prompt) > 0.6


def test_what_is_late_arrives_in_the_next_gait_and_not_after_a_reset(make: Make) -> None:
    env, prompt = make(latency=1.0), make()
    assert np.abs(watch(env, FORWARDS, joint_angles)).max() < 0.05
    np.testing.assert_allclose(walk(env, STAND), walk(prompt, FORWARDS), atol=0.1)
    walk(env, FORWARDS)
    env.reset()
    assert np.abs(watch(env, STAND, joint_angles)).max() < 0.05


@pytest.mark.parametrize("gap", [0.2, 0.3])
def test_backlash_takes_the_play_from_each_swing_and_lets_the_joint_wait_at_its_start(make: Make, gap: float) -> None:
    tight, loose = (watch(make(**kwargs), FORWARDS, joint_angles)[:, HIP] for kwargs in ({}, {"backlash": gap}))
    commanded = math.pi / 4 - 2 * gap  # the servos do not quite keep up with it
    assert 0.9 * commanded < np.ptp(loose[50:]) < commanded
    waiting = round(math.asin(gap / (math.pi / 8)) / (4 * math.pi * 0.01))
    np.testing.assert_allclose(loose[:waiting], 0.0, atol=1e-3)
    assert abs(loose[waiting + 5]) > 0.01
    assert abs(tight[waiting - 1]) > 0.01


def test_play_that_is_wider_than_a_swing_moves_nothing(make: Make) -> None:
    assert np.abs(watch(make(backlash=0.5), FORWARDS, joint_angles)).max() < 0.05


def test_joints_stand_off_by_their_zero_errors(make: Make) -> None:
    errors = tuple(np.linspace(-0.2, 0.2, 12).tolist())
    env = make(zero_errors=errors)
    walk(env, STAND)
    np.testing.assert_allclose(joint_angles(env), errors, atol=0.05)


def test_blocked_joint_has_no_zero_error_left(make: Make) -> None:
    env = make("joint 0 locked", zero_errors=(0.3, *[0.0] * 11))
    assert np.abs(watch(env, FORWARDS, joint_angles)[:, HIP]).max() < 0.02


@pytest.mark.parametrize("factor", [0.1, 0.4])
def test_no_joint_is_faster_than_its_profile_allows(make: Make, factor: float) -> None:
    free, limited = (watch(make(**kwargs), FORWARDS, joint_speeds) for kwargs in ({}, {"motor_speed": factor}))
    assert np.percentile(np.abs(limited), 90) <= 7.0 * factor  # beyond it the floor pushes, not the servo
    assert np.abs(limited).max() < 1.6 * 7.0 * factor < np.abs(free).max()


def test_weak_motors_do_not_carry_the_robot(make: Make) -> None:
    strong, weak = make(motor_strength=0.5), make(motor_strength=0.001)
    for env in (strong, weak):
        walk(env, STAND)
    assert strong.position[2] > 0.13
    assert weak.position[2] < 0.1


def test_blocked_joint_is_held_by_more_than_its_motor(make: Make) -> None:
    env = make("joint 1 locked", motor_strength=0.001)
    angles = watch(env, STAND, joint_angles)
    assert np.abs(angles[:, 1]).max() < 0.02
    assert np.abs(angles[:, 4]).max() > 0.5


def decay(env: GaitEnv) -> float:
    """How fast a hip without a motor loses its speed in weightlessness, in 1/s."""
    without_gravity(env)
    put(env, (0.0, 0.0, 5.0))
    env.world.release()
    turn_joint(env, HIP, 2.0)
    env.world.simulate()
    return math.log(2.0 / joint_speeds(env)[HIP]) / env.time_step


def test_damping_slows_a_joint_down(make: Make) -> None:
    rates = [decay(make(joint_damping=damping)) for damping in (0.0, 0.01, 0.02)]
    assert rates[2] > rates[1] + 1.0 > rates[0] + 2.0


def test_damping_is_added_to_that_of_the_description(make: Make) -> None:
    as_described = QuadrupedEnv()
    expected = decay(as_described)
    as_described.close()
    assert decay(make()) == pytest.approx(expected, abs=0.5)


def test_speed_limit_of_the_joints_lets_the_body_fall_freely(make: Make) -> None:
    slow, fast = make(motor_speed=0.1), make()
    for env in (slow, fast):
        put(env, (0.0, 0.0, 10.0))
        env.step(STAND)
    assert fast.position[2] == pytest.approx(slow.position[2], abs=0.1)
    assert fast.position[2] < 6.0
