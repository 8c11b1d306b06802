from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from scipy.spatial.transform import Rotation
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from famle_envs import Situation
from famle_envs.gait_env import GaitEnv
from famle_envs.minitaur import MinitaurEnv
from tests.helpers import making, walk, watch
from tests.worlds import joint_angles, masses, point_of, put

Array = npt.NDArray[Any]
Make = Callable[..., MinitaurEnv]

MOTORS = range(8)
STAND, FORWARDS, BACKWARDS = (np.array(gait) for gait in ([0, 0, -1, 0], [0, 1, 0, 0], [0, -1, 0, 0]))
ALL_JOINTS = np.array([0.0, 0.8, 1.0, 0.0])
"""A gait in which each motor turns by more than 0.5 rad."""
CLOSURE = ((0.0, 0.005, 0.2), (0.0, 0.01, 0.2))
"""Where PyBullet's own Minitaur joins the right and the left shank of a leg, from the centre of each, in m."""


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(MinitaurEnv, engine) as make_robot:
        yield make_robot


def follow(env: MinitaurEnv, seed: int = 0, gaits: int = 2) -> Array:
    """The start and what random gaits make of it, each with its reward."""
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in np.random.default_rng(seed).uniform(-1, 1, (gaits, 4)):
        rows.append(np.append(*env.step(action)[:2]))
    return np.stack(rows)


def shank_ends(env: GaitEnv) -> Array:
    """The ends of the right and the left shank of each leg in the world, (4 legs, 2 shanks, 3)."""
    ends = []
    for motors in np.reshape(env.joints, (4, 2)).tolist():
        for motor, end in zip(motors, CLOSURE, strict=True):
            shank = motor.replace("motor", "lower_leg").replace("joint", "link")
            ends.append(point_of(env, shank, end))
    return np.reshape(ends, (4, 2, 3))


# --- Making and checking ---


@pytest.mark.parametrize("kwargs", [{}, {"situation": "friction x 0.5", "profile": "held-out"}], ids=["intact", "real"])
@pytest.mark.parametrize("check", [check_with_gymnasium, check_with_sb3], ids=["gymnasium", "sb3"])
def test_environment_checkers_have_no_complaint(check: Callable[[gym.Env], None], kwargs: dict[str, Any]) -> None:
    env = gym.make("FamleMinitaur-v0", render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*observation space m.* value is -?infinity")  # a position has no bounds
        check(env.unwrapped)
    env.close()


def test_episode_has_sixty_gaits_of_a_second(make: Make) -> None:
    assert gym.spec("FamleMinitaur-v0").max_episode_steps == 60
    assert make().control_period == pytest.approx(1.0)


@pytest.mark.parametrize("situation", [None, "joint 3 locked", "friction x 0.5, base mass x 2"])
def test_same_seed_gives_the_same_bits_after_another_history_and_elsewhere(make: Make, situation: str | None) -> None:
    fresh, used = make(situation=situation), make(situation=situation)
    expected = follow(fresh)
    used.set_situation("joint 0 locked, friction x 0.2, base mass x 3")
    follow(used, seed=1)
    put(used, (0.0, 0.0, 0.3), (1.0, 0.0, 0.0, 0.0))
    walk(used, ALL_JOINTS)
    used.set_situation(situation)
    np.testing.assert_array_equal(follow(used), expected)
    np.testing.assert_array_equal(follow(fresh), expected)


def test_action_outside_its_range_is_clipped(make: Make) -> None:
    one, other = make(), make()
    np.testing.assert_array_equal(walk(one, [0.0, 3.0, -5.0, 2.0]), walk(other, [0.0, 1.0, -1.0, 1.0]))


def test_step_needs_a_reset_and_a_robot_that_is_not_closed(make: Make) -> None:
    env = MinitaurEnv()
    with pytest.raises(gym.error.ResetNeeded, match="Call reset"):
        env.step(STAND)
    env.close()
    for use in (env.reset, lambda: env.set_situation("joint 0 locked"), lambda: env.position):
        with pytest.raises(RuntimeError, match="closed; make a new one"):
            use()


# --- The body ---


def test_observation_is_the_place_and_the_orientation_of_the_body(make: Make) -> None:
    env = make()
    for action in np.random.default_rng(1).uniform(-1, 1, (2, 4)):
        obs, *_ = env.step(action)
        assert obs in env.observation_space
        np.testing.assert_allclose(obs[:3], env.position, rtol=1e-6)
        quaternion = env.world.base_pose()[1]
        missed = Rotation.from_euler("xyz", obs[3:]).inv() * Rotation.from_quat(quaternion)
        assert missed.magnitude() == pytest.approx(0.0, abs=1e-5)


def test_robot_at_rest_stands_level_on_four_feet_under_its_body(make: Make) -> None:
    env = make()
    obs = walk(env, STAND, 2)[-1]
    assert np.abs(obs[[0, 1]]).max() < 0.08
    assert 0.14 < obs[2] < 0.19
    assert np.abs(obs[3:]).max() < 0.05
    feet = shank_ends(env).mean(axis=1) - env.position
    assert (np.sign(feet[:, :2]) == [[-1, 1], [1, 1], [1, -1], [-1, -1]]).all()  # back left and on clockwise
    np.testing.assert_allclose(feet[:, 2], -obs[2], atol=0.02)


@pytest.mark.parametrize("gait", [FORWARDS, [0, 1, 1, 0], [1, 0, 1, -1], [0.2, 0.8, 1, 1]], ids=str)
def test_loop_of_each_leg_stays_closed_while_it_walks(make: Make, gait: Any) -> None:
    ends = watch(make(), gait, shank_ends)
    gaps = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1)
    assert gaps.max() < 0.03
    assert gaps.mean() < 0.006


@pytest.mark.parametrize(("gait", "sign"), [(FORWARDS, 1.0), (BACKWARDS, -1.0)], ids=["forwards", "backwards"])
def test_positive_step_walks_forwards_and_negative_step_backwards(make: Make, gait: Array, sign: float) -> None:
    rows = walk(make(), gait, 3)
    assert (np.diff(sign * rows[:, 0]) > 0.3).all()
    assert np.abs(rows[:, 1]).max() < 0.3


@pytest.mark.parametrize("steer", [1.0, -1.0])
def test_long_legs_that_step_against_each_other_turn_right_where_steer_is_positive(make: Make, steer: float) -> None:
    yaws = walk(make(), [steer, 0.0, 1.0, -1.0], 3)[:, 5]
    assert steer * yaws[-1] < -0.5


def test_longer_steps_walk_further(make: Make) -> None:
    env, ways = make(), []
    for step in (0.0, 0.5, 1.0):
        env.reset()
        ways.append(walk(env, [0.0, step, 0.0, 0.0], 2)[-1, 0])
    assert ways[0] + 0.2 < ways[1] < ways[2] - 0.2


@pytest.mark.parametrize("motor", MOTORS)
def test_locked_motor_stays_at_its_angle_while_the_others_turn(make: Make, motor: int) -> None:
    env = make(situation={"locked_joints": [motor]})
    angles = watch(env, ALL_JOINTS, joint_angles)
    assert np.abs(angles[:, motor] - env.rest_angles[motor]).max() < 0.03
    assert np.delete(np.ptp(angles, axis=0), motor).min() > 0.5


def test_yaw_error_turns_the_measured_yaw_only(make: Make) -> None:
    rows = []
    for situation in (None, "yaw sensor off by 170 deg"):
        env = make(situation=situation)
        put(env, env.position, Rotation.from_euler("z", 1.0).as_quat())
        rows.append(walk(env, FORWARDS, 2))
    true, off = rows
    np.testing.assert_array_equal(off[:, :5], true[:, :5])
    np.testing.assert_allclose(off[:, 5], true[:, 5] + math.radians(170) - 2 * math.pi, atol=1e-5)


# --- Rewards and falls ---


def test_return_is_the_way_along_the_world_x_axis(make: Make) -> None:
    env = make()
    start = env.position[0]
    rewards = [env.step(action)[1] for action in (FORWARDS, FORWARDS, BACKWARDS)]
    assert sum(rewards) == pytest.approx(env.position[0] - start, abs=1e-6)
    assert np.sign(rewards).tolist() == [1, 1, -1]


@pytest.mark.parametrize("shape", [(6,), (5, 6), (2, 3, 6)])
def test_reward_of_a_batch_in_numpy_and_torch(make: Make, shape: tuple[int, ...]) -> None:
    env = make()
    obs, next_obs = np.random.default_rng(0).normal(size=(2, *shape)).astype(np.float32)
    np.testing.assert_allclose(env.reward_fn(obs, None, next_obs), next_obs[..., 0] - obs[..., 0])
    rewards = env.reward_fn(torch.from_numpy(obs), None, torch.from_numpy(next_obs))
    assert isinstance(rewards, torch.Tensor)
    np.testing.assert_allclose(rewards.numpy(), next_obs[..., 0] - obs[..., 0])


@pytest.mark.parametrize(("roll", "fallen"), [(0.0, False), (90.0, True), (-90.0, True), (180.0, True)])
def test_fall_ends_the_episode_also_in_a_robot_that_is_turned(make: Make, roll: float, fallen: bool) -> None:
    env = make()
    assert not env.step(FORWARDS)[2]
    put(env, (0.0, 0.0, 0.2), Rotation.from_euler("xyz", [roll, 0.0, 120.0], degrees=True).as_quat())
    assert env.step(STAND)[2] is fallen


# --- Situations ---


def test_training_situations_are_the_nine_of_the_paper_and_the_first_is_intact(make: Make) -> None:
    situations = MinitaurEnv.training_situations
    expected = {Situation(friction=f, base_mass=m) for f, m in product((0.5, 1.0, 2.0), (1.0, 1.5, 2.0))}
    assert situations[0].is_intact
    assert len(situations) == len(expected) == 9
    assert set(situations) == expected
    env = make()
    for situation in situations:
        assert env.reset(options={"situation": situation.label})[1]["situation"] == situation.label
        assert env.situation == situation


def test_situations_differ_in_what_they_make_of_a_gait(make: Make) -> None:
    env, ends = make(), []
    for situation in MinitaurEnv.training_situations:
        env.reset(options={"situation": situation})
        ends.append(walk(env, FORWARDS)[-1])
    distances = np.linalg.norm(np.array(ends)[:, None] - np.array(ends), axis=-1)
    assert (distances + np.eye(9)).min() > 1e-3


def test_base_mass_is_that_of_the_base_alone(make: Make) -> None:
    intact, heavy = masses(make()), masses(make(situation="base mass x 1.5"))
    np.testing.assert_allclose(heavy / intact, [1.5, *[1.0] * (len(intact) - 1)])


@pytest.mark.parametrize("fault", [{"motor_gain": [0.0]}, {"joint_offset": [0.1]}])
def test_unsupported_fault_is_refused(fault: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"MinitaurEnv cannot have the fault '{next(iter(fault))}'"):
        MinitaurEnv(situation=fault)
