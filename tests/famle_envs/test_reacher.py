import math
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from famle_envs import Situation
from famle_envs.reacher import ReacherEnv
from tests.helpers import making

JOINTS = range(5)
TIP = slice(10, 12)
FORWARD = np.full(5, 0.8)
PAPER = Situation(motor_gain=(-1, 1, 1, 0, 1))

Make = Callable[..., ReacherEnv]


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(ReacherEnv, engine) as make_robot:
        yield make_robot


def run(env: ReacherEnv, action: np.ndarray, steps: int) -> np.ndarray:
    """The last observation after repeating an action."""
    for _ in range(steps):
        obs = env.step(action)[0]
    return obs


def trajectory(env: ReacherEnv, seed: int = 0) -> np.ndarray:
    """All observations and rewards of an episode of random actions, (31, 13)."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (30, 5))
    rows = [np.append(env.reset(seed=seed)[0], 0.0)]
    for action in actions:
        obs, reward, *_ = env.step(action)
        rows.append(np.append(obs, reward))
    return np.stack(rows)


# --- The physics of a situation ---


@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("gain", [1.0, 0.5, 0.0, -0.5, -1.0])
def test_gain_scales_the_travel_of_its_joint_only(make: Make, joint: int, gain: float) -> None:
    env = make(situation={"motor_gain": [1.0] * joint + [gain], "partial": True})
    commanded = np.where(np.arange(5) == joint, gain, 1.0) * 0.8 * 0.7  # rad in the 1 s of 10 steps
    np.testing.assert_allclose(run(env, FORWARD, 10)[:5], commanded, atol=0.075)


@pytest.mark.parametrize("joint", JOINTS)
def test_joint_locked_in_mid_run_stays_where_it_was_while_the_others_move(make: Make, joint: int) -> None:
    env = make()
    locked_at = run(env, FORWARD, 5)
    env.set_situation({"locked_joints": [joint]})
    later = run(env, -FORWARD, 10)
    assert later[joint] == pytest.approx(locked_at[joint], abs=0.03)
    assert np.delete(locked_at[:5] - later[:5], joint).min() > 0.4


def test_joint_locked_in_mid_run_is_locked_at_the_start_after_a_reset(make: Make) -> None:
    env = make()
    run(env, FORWARD, 5)
    env.set_situation("joint 1 locked")
    env.reset()
    assert run(env, FORWARD, 10)[1] == pytest.approx(0.0, abs=0.03)


def test_joint_offset_shifts_the_measured_angle_only(make: Make) -> None:
    intact = trajectory(make())
    shifted = trajectory(make(situation={"joint_offset": [0.0, 0.25, 0.0, -0.4]}))
    np.testing.assert_allclose(
        shifted[:, :5] - intact[:, :5], np.broadcast_to([0.0, 0.25, 0.0, -0.4, 0.0], (31, 5)), atol=1e-6
    )
    np.testing.assert_array_equal(shifted[:, 5:], intact[:, 5:])


@pytest.mark.parametrize("offset", [4.0, -4.0, 100.0])
def test_measured_angle_wraps(make: Make, offset: float) -> None:
    env = make(situation={"joint_offset": [0.0, offset]})
    measured = env.reset()[0][1]
    assert -math.pi <= measured <= math.pi
    assert math.cos(measured - offset) == pytest.approx(1.0)


def test_base_joint_turns_past_pi_and_its_measurement_wraps(make: Make) -> None:
    env = make()
    obs = run(env, np.array([1.0, 0.0, 0.0, 0.0, 0.0]), 50)
    assert obs[0] == pytest.approx(3.5 - 2 * math.pi, abs=0.02)
    np.testing.assert_allclose(obs[TIP], [1.5 * math.cos(3.5), 1.5 * math.sin(3.5)], atol=0.1)
    assert obs in env.observation_space


@pytest.mark.parametrize("situation", ["intact", "joint 0 dead", "joint 0 locked"])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_arm_driven_against_its_joint_limits_comes_to_rest_there(make: Make, situation: str, direction: float) -> None:
    obs = run(make(situation=situation), direction * np.array([0.0, 1.0, 1.0, 1.0, 1.0]), 45)
    np.testing.assert_allclose(obs[:5], direction * np.array([0.0, 1.0472, 1.0472, 1.0472, 1.0472]), atol=0.05)
    np.testing.assert_allclose(obs[5:10], 0.0, atol=0.05)


# --- Training situations and others ---


def test_training_situations_are_the_eleven_of_the_paper() -> None:
    expected = {Situation()} | {Situation(motor_gain=[1] * j + [g]) for j in JOINTS for g in (0, -1)}
    assert len(ReacherEnv.training_situations) == 11
    assert set(ReacherEnv.training_situations) == expected
    assert ReacherEnv.presets["paper"] == PAPER


@pytest.mark.parametrize("n_faults", range(1, 6))
def test_sampled_situation_is_unseen_and_has_that_many_faulty_joints(n_faults: int) -> None:
    rng = np.random.default_rng(n_faults)
    sampled = [ReacherEnv.sample_situation(rng, n_faults) for _ in range(60)]
    for situation in sampled:
        assert situation not in ReacherEnv.training_situations
        faulty = (np.array(situation.motor_gain) != 1.0) | (np.array(situation.joint_offset) != 0.0)
        assert faulty.sum() == n_faults
        assert situation.faults <= ReacherEnv.supported_faults
    assert len(set(sampled)) > 10


@pytest.mark.parametrize("n_faults", [-1, 0, 6])
def test_impossible_number_of_faults_is_refused(n_faults: int) -> None:
    with pytest.raises(ValueError, match=f"between 1 and 5, got {n_faults}"):
        ReacherEnv.sample_situation(np.random.default_rng(0), n_faults)


# --- The goal ---


@pytest.mark.parametrize("goal", [(-1.0, 1.0), (0.3, -0.7)])
def test_reward_falls_exponentially_with_the_distance_to_the_goal(make: Make, goal: tuple[float, float]) -> None:
    rows = trajectory(make(goal=goal))[1:]
    np.testing.assert_allclose(rows[:, 12], np.exp(-np.linalg.norm(rows[:, TIP] - goal, axis=1)), rtol=1e-5)


def test_reward_is_one_at_the_goal_and_less_elsewhere(make: Make) -> None:
    at_goal = make(goal=(1.5, 0.0)).step(np.zeros(5))[1]
    elsewhere = make().step(np.zeros(5))[1]
    assert isinstance(at_goal, float)
    assert at_goal == pytest.approx(1.0)
    assert elsewhere == pytest.approx(math.exp(-math.hypot(2.5, 1.0)))


@pytest.mark.parametrize("goal", [(1.0,), (1, 2, 3), (math.nan, 0.0), (0.0, math.inf), None, 1.0, "ab"], ids=str)
def test_bad_goal_is_refused(goal: Any) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 (NumPy's own words for what is not a number)
        ReacherEnv(goal=goal)


def test_goal_is_kept_in_the_spec_also_through_json() -> None:
    env = gym.make("FamleReacher-v0", goal=(0.5, -0.5))
    copy = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert copy.unwrapped.goal == env.unwrapped.goal == (0.5, -0.5)
    env.close()
    copy.close()


def test_goal_is_drawn(make: Make) -> None:
    pictures = [make(render_mode="rgb_array", goal=goal).render() for goal in ((-1.0, 1.0), (0.5, 0.5))]
    assert (pictures[0] != pictures[1]).any()
