from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium.utils.env_checker import check_env as check_with_gymnasium
from stable_baselines3.common.env_checker import check_env as check_with_sb3

from famle_envs import Situation
from famle_envs.quadruped import LEGS, QuadrupedEnv, blocked_leg
from tests.helpers import making, walk, watch
from tests.worlds import joint_angles, masses

Array = npt.NDArray[Any]
Make = Callable[..., QuadrupedEnv]

JOINTS = range(12)
STAND, FORWARDS, BACKWARDS, RIGHT, LEFT = (
    np.array(gait) for gait in ([0, 0, -1, 0], [0, 1, 0, 0], [0, -1, 0, 0], [1, 0, 0, 0], [-1, 0, 0, 0])
)
ALL_JOINTS = np.array([0.3, 0.7, 1.0, 0.0])
"""A gait in which each joint moves by more than 0.2 rad."""


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(QuadrupedEnv, engine) as make_robot:
        yield make_robot


def follow(env: QuadrupedEnv, seed: int = 0, gaits: int = 3) -> Array:
    """The start and what random gaits make of it, each with its reward."""
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in np.random.default_rng(seed).uniform(-1, 1, (gaits, 4)):
        rows.append(np.append(*env.step(action)[:2]))
    return np.stack(rows)


def yaws(rows: Array) -> Array:
    return np.unwrap(np.arctan2(rows[:, 2], rows[:, 3]))


# --- Making and checking ---


BROKEN = {"locked_joints": [0, 1, 2], "orientation_error": 0.5}


@pytest.mark.parametrize("kwargs", [{}, {"situation": BROKEN, "profile": "held-out"}], ids=["intact", "broken"])
@pytest.mark.parametrize("check", [check_with_gymnasium, check_with_sb3], ids=["gymnasium", "sb3"])
def test_environment_checkers_have_no_complaint(check: Callable[[gym.Env], None], kwargs: dict[str, Any]) -> None:
    env = gym.make("FamleQuadruped-v0", render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*observation space m.* value is -?infinity")  # x and y have no bounds
        check(env.unwrapped)
    env.close()


def test_episode_has_eighty_gaits_of_a_second(make: Make) -> None:
    assert gym.spec("FamleQuadruped-v0").max_episode_steps == 80
    assert make().control_period == pytest.approx(1.0)


@pytest.mark.parametrize("situation", [None, "front left leg blocked", "joint 4 locked", "yaw sensor off by 90 deg"])
def test_same_seed_gives_the_same_bits_after_another_history_and_elsewhere(make: Make, situation: str | None) -> None:
    fresh, used = make(situation=situation), make(situation=situation)
    expected = follow(fresh)
    used.set_situation("joint 0 locked, joint 7 locked, friction x 0.2, base mass x 3")
    follow(used, seed=1)
    used.set_situation(situation)
    np.testing.assert_array_equal(follow(used), expected)
    np.testing.assert_array_equal(follow(fresh), expected)


# --- Standing and walking ---


def test_robot_weighs_two_kilograms(make: Make) -> None:
    assert masses(make()).sum() == pytest.approx(2.0)


def test_robot_at_rest_stands_level_at_fourteen_centimetres(make: Make) -> None:
    env = make()
    assert env.reset()[0] == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-3)
    obs = walk(env, STAND, 3)[-1]
    np.testing.assert_allclose(env.position, [0.0, 0.0, 0.14], atol=5e-3)
    np.testing.assert_allclose(joint_angles(env), 0.0, atol=0.05)
    assert abs(yaws(obs[None])[0]) < 0.1


def test_observation_is_the_place_and_the_sine_and_cosine_of_the_yaw(make: Make) -> None:
    env = make()
    for action in np.random.default_rng(1).uniform(-1, 1, (3, 4)):
        obs, *_ = env.step(action)
        assert obs in env.observation_space
        np.testing.assert_allclose(obs[:2], env.position[:2], rtol=1e-6)
        assert math.hypot(*obs[2:]) == pytest.approx(1.0)


@pytest.mark.parametrize(("gait", "sign"), [(FORWARDS, 1.0), (BACKWARDS, -1.0)], ids=["forwards", "backwards"])
def test_positive_step_walks_forwards_and_negative_step_backwards(make: Make, gait: Array, sign: float) -> None:
    rows = walk(make(), gait, 4)
    assert (np.diff(sign * rows[:, 0]) > 0.15).all()
    assert np.abs(rows[:, 1]).max() < 0.1
    assert np.abs(yaws(rows)).max() < 0.2


@pytest.mark.parametrize(("gait", "sign"), [(RIGHT, -1.0), (LEFT, 1.0)], ids=["right", "left"])
def test_positive_steer_turns_right_and_negative_steer_left(make: Make, gait: Array, sign: float) -> None:
    rows = walk(make(), gait, 3)
    assert sign * yaws(rows)[-1] > 0.8
    assert np.abs(rows[:, :2]).max() < 0.2


def test_robot_walks_on_between_actions_and_a_reset_takes_it_back(make: Make) -> None:
    env = make()
    start = env.reset()[0]
    rows = walk(env, FORWARDS, 3)
    assert (np.diff(rows[:, 0]) > 0.15).all()
    np.testing.assert_array_equal(env.reset()[0], start)


# --- Blocked joints and legs ---


@pytest.mark.parametrize("joint", JOINTS)
def test_blocked_joint_stays_at_its_angle_while_the_others_move(make: Make, joint: int) -> None:
    angles = watch(make(situation={"locked_joints": [joint]}), ALL_JOINTS, joint_angles)
    assert np.abs(angles[:, joint]).max() < 0.02
    assert np.delete(np.ptp(angles, axis=0), joint).min() > 0.2


def test_joint_blocked_in_mid_run_is_held_at_rest_until_it_is_repaired(make: Make) -> None:
    env = make()
    assert np.ptp(watch(env, ALL_JOINTS, joint_angles)[:, 4]) > 0.2
    env.set_situation("joint 4 locked")
    assert np.abs(watch(env, ALL_JOINTS, joint_angles)[20:, 4]).max() < 0.02
    env.set_situation(None)
    assert np.ptp(watch(env, ALL_JOINTS, joint_angles)[:, 4]) > 0.2


@pytest.mark.parametrize("leg", range(4), ids=LEGS)
def test_robot_veers_to_the_side_of_a_blocked_leg(make: Make, leg: int) -> None:
    env = make(situation=f"{LEGS[leg]} leg blocked")
    assert env.situation.locked_joints == (3 * leg, 3 * leg + 1, 3 * leg + 2)
    side = 1.0 if "left" in LEGS[leg] else -1.0
    rows = walk(env, FORWARDS, 3)
    assert side * yaws(rows)[-1] > 0.4
    assert rows[-1, 0] > 0.3


# --- The yaw sensor, the floor and the mass ---


@pytest.mark.parametrize("error", [0.5, -2.0, math.pi])
def test_yaw_error_turns_the_measured_heading_only(make: Make, error: float) -> None:
    true, off = follow(make()), follow(make(situation={"orientation_error": error}))
    np.testing.assert_array_equal(off[:, [0, 1, 4]], true[:, [0, 1, 4]])
    np.testing.assert_allclose(off[:, 2:4], [(math.sin(y + error), math.cos(y + error)) for y in yaws(true)], atol=1e-6)


def test_yaw_error_may_appear_in_mid_run(make: Make) -> None:
    intact, surprised = make(), make()
    np.testing.assert_array_equal(walk(surprised, FORWARDS, 2), walk(intact, FORWARDS, 2))
    surprised.set_situation("yaw sensor off by 90 deg")
    true, off = walk(intact, FORWARDS), walk(surprised, FORWARDS)
    np.testing.assert_array_equal(off[:, :2], true[:, :2])
    np.testing.assert_allclose(off[:, 2:], true[:, [3, 2]] * [1.0, -1.0], atol=1e-6)


@pytest.mark.parametrize(("situation", "least"), [("friction x 0.05", 0.05), ("base mass x 2", 0.01)])
def test_floor_and_mass_change_the_way_until_they_are_normal_again(make: Make, situation: str, least: float) -> None:
    env = make()
    before = follow(env)
    env.set_situation(situation)
    assert np.abs(follow(env) - before).max() > least
    env.set_situation(None)
    np.testing.assert_array_equal(follow(env), before)


def test_base_mass_is_that_of_the_trunk_alone(make: Make) -> None:
    intact, heavy = masses(make()), masses(make(situation="base mass x 2"))
    np.testing.assert_allclose(heavy / intact, [2.0, *[1.0] * 12])


def test_robot_does_not_get_as_far_on_ice(make: Make) -> None:
    env = make()
    far = walk(env, FORWARDS, 3)[-1, 0]
    env.reset(options={"situation": "friction x 0.01"})
    assert walk(env, FORWARDS, 3)[-1, 0] < 0.8 * far


# --- Situations by name ---


def test_training_situations_are_intact_each_joint_blocked_and_yaw_errors() -> None:
    situations = QuadrupedEnv.training_situations
    assert situations[0].is_intact
    assert len(set(situations)) == len(situations) == 20
    assert {s.locked_joints for s in situations[1:13]} == {(joint,) for joint in JOINTS}
    assert all(s.faults == {"locked_joints"} for s in situations[1:13])
    assert all(s.faults == {"orientation_error"} for s in situations[13:])


def test_presets_may_be_composed(make: Make) -> None:
    env = make(situation="front left leg blocked + yaw sensor off by 45 deg + joint 0 locked")
    assert env.situation.locked_joints == (0, 3, 4, 5)
    assert env.situation.orientation_error == pytest.approx(math.radians(45))
    for wrong in ("front left leg blocked + no such thing", "paper + yaw sensor off by 45 deg"):
        with pytest.raises(ValueError, match=r"No situation is called|contradicts"):
            env.set_situation(wrong)


def test_presets_are_known_by_name(make: Make) -> None:
    env = make()
    names = {s.name for s in QuadrupedEnv.training_situations} | {f"{leg} leg blocked" for leg in LEGS}
    assert set(QuadrupedEnv.presets) == names | {"paper"}
    for name, situation in QuadrupedEnv.presets.items():
        assert env.reset(options={"situation": name})[1]["situation"] == name
        assert env.situation == situation


def test_blocked_leg_is_no_training_situation() -> None:
    assert not {blocked_leg(leg) for leg in range(4)} & set(QuadrupedEnv.training_situations)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"motor_gain": [0.5]}, "cannot have the fault 'motor_gain'"),
        ({"joint_offset": [0.1]}, "cannot have the fault 'joint_offset'"),
        ("joint 12 locked", "the joints of QuadrupedEnv are 0 to 11"),
        ("front leg blocked", "did you mean 'front left leg blocked'"),
    ],
)
def test_unknown_fault_is_refused_and_changes_nothing(make: Make, fault: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        QuadrupedEnv(situation=fault)
    env = make(situation="joint 1 locked")
    with pytest.raises(ValueError, match=message):
        env.set_situation(fault)
    assert env.situation == Situation(locked_joints=(1,))
