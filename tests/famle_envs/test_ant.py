from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from famle_envs.ant import AntEnv
from tests.helpers import making
from tests.worlds import LEVEL, momenta, place_of, push, put, without_gravity

Array = npt.NDArray[Any]
Make = Callable[..., AntEnv]

JOINTS = range(8)
HEIGHT = 0
QUATERNION = slice(1, 5)
ANGLES = slice(5, 13)
VELOCITY = slice(13, 16)
SPEEDS = slice(19, 27)
REST = np.zeros(8)
PERIOD = 1 / 60.6
MEAN_ANGLES = np.array([0.0, math.pi / 4] * 4)


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(AntEnv, engine) as make_robot:
        yield make_robot


def commands(steps: int = 60, seed: int = 0) -> Array:
    """Random actions of which every second one is at full torque."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, 8))
    actions[::2] = np.sign(actions[::2])
    return actions


def follow(env: AntEnv, actions: Array) -> Array:
    """All observations after the actions."""
    return np.stack([env.step(action)[0] for action in actions])


def settle(env: AntEnv) -> Array:
    """The observation of an ant that has come to rest on its feet."""
    return follow(env, np.zeros((120, 8)))[-1]


# --- Observations ---


def test_observation_is_the_state_of_the_simulator_in_the_documented_order(make: Make) -> None:
    env = make()
    for action in commands(40):
        obs = env.step(action)[0]
        place, quaternion = env.world.base_pose()
        velocity, angular = env.world.base_velocity()
        angles, speeds = env.world.joint_states()
        upwards = np.array(quaternion) * (1.0 if quaternion[3] >= 0 else -1.0)
        expected = np.concatenate([place[2:], upwards, angles, velocity, angular, speeds])
        assert obs.shape == (27,)
        assert obs.dtype == np.float32
        np.testing.assert_allclose(obs, expected, rtol=1e-6, atol=1e-7)


def test_velocities_are_those_at_which_the_measured_positions_change(make: Make) -> None:
    env = make(control_rate=500)
    put(env, (0, 0, 5), tuple(Rotation.from_euler("z", 2.0).as_quat()))
    before = follow(env, np.tile(0.1, (20, 8)))[-1]
    place, orientation = place_of(env), Rotation.from_quat(before[QUATERNION])
    after = env.step(np.full(8, 0.1))[0]
    turned = (Rotation.from_quat(after[QUATERNION]) * orientation.inv()).as_rotvec()
    np.testing.assert_allclose((place_of(env) - place) * 500, after[VELOCITY], atol=0.05)
    np.testing.assert_allclose(turned * 500, after[16:19], rtol=0.03, atol=0.01)
    np.testing.assert_allclose((after[ANGLES] - before[ANGLES]) * 500, after[SPEEDS], rtol=0.03)
    assert np.abs(after[SPEEDS]).min() > 0.2


def test_legs_are_front_left_back_left_back_right_and_front_right(make: Make) -> None:
    env = make()
    feet = [env.world.link_position(joint.replace("ankle", "foot")) for joint in env.joints[1::2]]
    np.testing.assert_array_equal(np.sign(feet)[:, :2], [[1, 1], [-1, 1], [-1, -1], [1, -1]])


def test_ant_under_long_random_full_torques_stays_finite_and_near_its_joint_limits(make: Make) -> None:
    env = make()
    rows = follow(env, np.sign(commands(1000)))
    lower, upper = env.joint_limits
    assert np.isfinite(rows).all()
    assert (rows[:, ANGLES] > lower - 0.35).all()
    assert (rows[:, ANGLES] < upper + 0.35).all()
    assert np.abs(rows[:, SPEEDS]).max() < 100.0
    assert rows[:, HEIGHT].max() < 5.0


def test_ant_without_torque_comes_to_rest_above_the_height_of_a_fall(make: Make) -> None:
    obs = settle(make())
    assert 0.3 < obs[HEIGHT] < 0.6
    np.testing.assert_allclose(obs[13:], 0.0, atol=0.02)


def test_torques_within_the_robot_move_it_as_a_whole_hardly(make: Make) -> None:
    env = make()
    put(env, (0, 0, 5))
    without_gravity(env)
    totals, exchanged = [], []
    for action in 0.3 * np.sign(commands()):
        env.step(action)
        parts = momenta(env)
        totals.append(np.linalg.norm(parts.sum(axis=0)))
        exchanged.append(np.linalg.norm(parts, axis=1).sum())
    assert np.mean(exchanged) > 100.0
    assert max(totals) < 0.1 * np.mean(exchanged)


# --- Starts, ends and rewards ---


def test_start_is_random_near_the_middle_of_the_joints_and_follows_the_seed(make: Make) -> None:
    env = make()
    starts = np.stack([env.reset(seed=seed)[0] for seed in range(50)])
    off = starts[:, ANGLES] - MEAN_ANGLES
    assert np.abs(off).max() < 0.1 + 1e-6
    assert (np.ptp(off, axis=0) > 0.15).all()
    np.testing.assert_array_equal(env.reset(seed=7)[0], starts[7])
    assert (env.reset()[0] != starts[7]).any()
    at_rest = np.delete(starts, range(5, 13), axis=1)
    np.testing.assert_array_equal(at_rest, np.tile([0.5, *LEVEL, *[0.0] * 14], (50, 1)))


@pytest.mark.parametrize("terminate", [False, True])
def test_fall_ends_the_episode_only_where_it_shall(make: Make, terminate: bool) -> None:
    env = make(terminate_when_fallen=terminate)
    assert not any(env.step(action)[2] for action in 0.3 * commands(30))
    put(env, (0, 0, 0.3), (1.0, 0.0, 0.0, 0.0))  # on its back
    flags = [env.step(REST)[2] for _ in range(60)]
    assert place_of(env)[2] < 0.26
    assert flags[-1] is terminate


def test_return_is_the_way_along_the_world_x_axis(make: Make) -> None:
    env = make(situation="friction x 0.05, yaw sensor off by 90 deg")
    put(env, (0, 0, 0.5), tuple(Rotation.from_euler("z", 1.0).as_quat()))
    start = place_of(env)
    push(env, 2.0)
    rewards = [env.step(action)[1] for action in 0.2 * commands(150)]
    way = place_of(env) - start
    assert way[0] > 1.0
    assert sum(rewards) * PERIOD == pytest.approx(way[0], rel=0.05)


@pytest.mark.parametrize("shape", [(27,), (6, 27), (2, 3, 27)])
def test_reward_of_a_batch_is_its_x_velocity_in_numpy_and_torch(make: Make, shape: tuple[int, ...]) -> None:
    env = make()
    next_obs = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    np.testing.assert_array_equal(env.reward_fn(None, None, next_obs), next_obs[..., 13])
    rewards = env.reward_fn(None, None, torch.from_numpy(next_obs))
    assert isinstance(rewards, torch.Tensor)
    np.testing.assert_array_equal(rewards.numpy(), next_obs[..., 13])


# --- Faults of the joints ---


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("gain", [0.0, 0.5, -0.25, -1.0])
def test_gain_scales_the_torque_of_its_joint_only(make: Make, joint: int, gain: float) -> None:
    actions, scaled = commands(), commands()
    scaled[:, joint] *= gain
    broken = follow(make(situation={"motor_gain": [1.0] * joint + [gain], "partial": True}), actions)
    np.testing.assert_array_equal(broken, follow(make(), scaled))
    assert np.abs(broken - follow(make(), actions)).max() > 0.1


def test_command_of_a_dead_joint_does_nothing(make: Make) -> None:
    one, other = make(situation="joint 3 dead"), make(situation="joint 3 dead")
    actions = commands()
    rows = follow(one, actions)
    actions[:, 3] *= -1.0
    np.testing.assert_array_equal(follow(other, actions), rows)


@pytest.mark.parametrize("joint", JOINTS)
def test_joint_locked_in_mid_run_stays_near_where_it_was_while_the_others_are_driven_hard(
    make: Make, joint: int
) -> None:
    env = make()
    locked_at = follow(env, 0.2 * commands(10))[-1, 5 + joint]
    env.set_situation({"locked_joints": [joint]})
    angles = follow(env, np.sign(commands(120, seed=1)))[:, ANGLES]
    assert np.abs(angles[:, joint] - locked_at).max() < 0.06
    assert np.delete(np.ptp(angles, axis=0), joint).min() > 0.3


# --- The yaw sensor ---


@given(st.floats(-10, 10), st.floats(-10, 10))
def test_yaw_error_turns_the_measured_orientation_about_the_vertical_and_nothing_else(one: float, two: float) -> None:
    with closing(AntEnv()) as env:
        rows = []
        for error in (0.0, one, one + two):
            env.reset(seed=0, options={"situation": {"orientation_error": error}})
            rows.append(follow(env, commands(30)))
    true, off, further = (Rotation.from_quat(row[:, QUATERNION]) for row in rows)
    for start, turned, error in ((true, off, one), (off, further, two), (true, further, one + two)):
        missed = (Rotation.from_euler("z", error) * start).inv() * turned
        np.testing.assert_allclose(missed.magnitude(), 0.0, atol=1e-5)
    for row in rows:
        assert (row[:, 4] >= 0.0).all()
        np.testing.assert_allclose(np.linalg.norm(row[:, QUATERNION], axis=1), 1.0, atol=1e-6)
        np.testing.assert_array_equal(np.delete(row, range(1, 5), 1), np.delete(rows[0], range(1, 5), 1))


@pytest.mark.parametrize("degrees", range(30, 331, 30))
def test_preset_of_the_yaw_sensor_is_off_by_that_angle(make: Make, degrees: int) -> None:
    env = make(situation=f"yaw sensor off by {degrees} deg")
    measured = Rotation.from_quat(env.reset()[0][QUATERNION])
    missed = Rotation.from_euler("z", degrees, degrees=True).inv() * measured
    assert missed.magnitude() == pytest.approx(0.0, abs=1e-6)


@given(st.floats(-10, 10), st.integers(0, 10))
def test_stuck_yaw_sensor_gives_its_error_instead_of_the_yaw(error: float, seed: int) -> None:
    with closing(AntEnv()) as true, closing(AntEnv(yaw_sensor="stuck")) as stuck:
        true.reset(seed=seed)
        stuck.reset(seed=seed, options={"situation": {"orientation_error": error}})
        actions = commands(30, seed)
        real, seen = follow(true, actions), follow(stuck, actions)
    one, other = (Rotation.from_quat(row[:, QUATERNION]).as_euler("ZYX") for row in (real, seen))
    np.testing.assert_allclose(np.cos(other[:, 0] - error), 1.0, atol=1e-5)
    np.testing.assert_allclose(other[:, 1:], one[:, 1:], atol=1e-5)
    np.testing.assert_array_equal(np.delete(seen, range(1, 5), 1), np.delete(real, range(1, 5), 1))
    assert (seen[:, 4] >= 0.0).all()


@pytest.mark.parametrize("name", ["added", "", None])
def test_unknown_yaw_sensor_is_refused(name: Any) -> None:
    with pytest.raises(ValueError, match='yaw_sensor must be "offset" or "stuck", got'):
        AntEnv(yaw_sensor=name)


# --- The floor ---


def slide(env: AntEnv) -> float:
    """How far an ant at rest goes after a push."""
    settle(env)
    start = place_of(env)
    push(env, 2.0)
    settle(env)
    return float((place_of(env) - start)[0])


def test_ant_slides_further_on_a_slippery_floor_until_it_is_dry_again(make: Make) -> None:
    env = make()
    dry = slide(env)
    env.reset(seed=0, options={"situation": "friction x 0.05"})
    slippery = slide(env)
    env.reset(seed=0, options={"situation": None})
    assert slippery > 4.0 * dry > 0.0
    assert slide(env) == dry


def test_floor_becomes_slippery_under_the_feet_of_a_standing_ant(make: Make) -> None:
    env = make()
    settle(env)
    env.set_situation("friction x 0.05")
    assert slide(env) > 1.0


# --- The control rate ---


@pytest.mark.parametrize(("kwargs", "period"), [({}, PERIOD), ({"control_rate": 100}, 0.01)])
def test_control_period_is_the_inverse_of_the_control_rate(make: Make, kwargs: dict[str, float], period: float) -> None:
    env = make(**kwargs)
    put(env, (0, 0, 50))
    falling = follow(env, np.zeros((20, 8)))[-1, 15]
    assert env.control_period == pytest.approx(period)
    assert falling == pytest.approx(-9.81 * 20 * period, rel=0.05)  # PyBullet's drag takes some


def test_motion_hardly_depends_on_the_control_rate(make: Make) -> None:
    slow, fast = make(), make(control_rate=100)
    pushing = 0.02 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
    ends = []
    for env in (slow, fast):
        put(env, (0, 0, 5))
        ends.append(follow(env, np.tile(pushing, (round(0.3 / env.control_period), 1)))[-1])
    np.testing.assert_allclose(ends[0][:13], ends[1][:13], atol=0.05)
    assert np.abs(ends[0][ANGLES] - MEAN_ANGLES).min() > 0.1


@pytest.mark.parametrize("rate", [0.0, -60.6, 49.9, 500.1, math.nan, math.inf, "fast", None])
def test_control_rate_out_of_range_is_refused(rate: Any) -> None:
    with pytest.raises(ValueError, match="control_rate must be a number between 50 and 500 Hz"):
        AntEnv(control_rate=rate)


# --- Rendering ---


def robot_pixels(picture: Array) -> Array:
    """Where the picture shows the torso and the legs, which are orange, unlike the floor and the feet."""
    return picture[..., 0].astype(int) > picture[..., 2].astype(int) + 50


def test_camera_follows_the_ant(make: Make) -> None:
    env = make(render_mode="rgb_array")
    before = robot_pixels(env.render())
    put(env, (5.0, -5.0, 0.5))
    after = robot_pixels(env.render())
    assert before[180:300, 180:300].sum() > 1000
    assert (before == after).mean() > 0.99


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_planner_is_warned_of_tipping_over_and_the_reward_is_not(kind: str) -> None:
    tilt = np.radians([0.0, 30.0, 90.0, 180.0])
    obs = np.zeros((4, 27), dtype=np.float32)
    obs[:, 1], obs[:, 4], obs[:, 13] = np.sin(tilt / 2), np.cos(tilt / 2), 2.0
    batch = torch.from_numpy(obs) if kind == "torch" else obs
    with closing(AntEnv()) as robot:
        np.testing.assert_allclose(robot.reward_fn(batch, None, batch), 2.0)
        np.testing.assert_allclose(robot.planning_reward_fn(batch, None, batch), [2.0, 2.0, -1.2, -5.2], atol=1e-5)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_planner_of_the_authors_code_pays_for_a_low_torso(kind: str) -> None:
    obs = np.zeros((3, 27), dtype=np.float32)
    obs[:, 0], obs[:, 13] = (0.25, 0.27, 0.5), 1.5
    batch = torch.from_numpy(obs) if kind == "torch" else obs
    with closing(AntEnv()) as robot:
        np.testing.assert_allclose(robot.survival_reward_fn(batch, None, batch), [-0.5, 1.5, 1.5])
