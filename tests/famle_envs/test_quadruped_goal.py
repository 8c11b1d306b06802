from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium.envs.registration import EnvSpec

from famle_envs.profile import Profile
from famle_envs.quadruped import QuadrupedEnv
from tests.helpers import making, walk
from tests.worlds import put

Array = npt.NDArray[Any]
Make = Callable[..., QuadrupedEnv]

STAND, FORWARDS = np.array([0.0, 0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(QuadrupedEnv, engine) as make_robot:
        yield make_robot


# --- Reward ---


@pytest.mark.parametrize("goal", [(2.5, 0.0), (-1.0, 0.7)])
def test_reward_is_the_way_by_which_the_goal_has_come_nearer(make: Make, goal: tuple[float, float]) -> None:
    env = make(goal=goal)
    obs = env.reset()[0]
    distance = math.dist(obs[:2], goal)
    for action in np.random.default_rng(0).uniform(-1, 1, (4, 4)):
        obs, reward, *_ = env.step(action)
        assert isinstance(reward, float)
        assert reward == pytest.approx(distance - math.dist(obs[:2], goal), abs=1e-6)
        distance = math.dist(obs[:2], goal)


def test_walk_towards_the_goal_is_rewarded_and_a_walk_away_from_it_is_punished(make: Make) -> None:
    assert make().step(FORWARDS)[1] > 0.15
    assert make(goal=(-2.5, 0.0)).step(FORWARDS)[1] < -0.15


@pytest.mark.parametrize("shape", [(4,), (6, 4), (2, 3, 4)])
def test_reward_of_a_batch_in_numpy_and_torch(make: Make, shape: tuple[int, ...]) -> None:
    env, rng = make(goal=(1.0, -2.0)), np.random.default_rng(0)
    obs, next_obs = rng.normal(size=(2, *shape)).astype(np.float32)
    expected = [np.linalg.norm(each[..., :2] - np.array([1.0, -2.0]), axis=-1) for each in (obs, next_obs)]
    batched = env.reward_fn(obs, None, next_obs)
    np.testing.assert_allclose(batched, expected[0] - expected[1], atol=1e-5)
    tensors = env.reward_fn(torch.from_numpy(obs), None, torch.from_numpy(next_obs))
    assert isinstance(tensors, torch.Tensor)
    assert tensors.shape == shape[:-1]
    np.testing.assert_allclose(tensors.numpy(), batched, atol=1e-6)


# --- Success ---


def test_episode_ends_with_success_at_the_goal_and_not_before(make: Make) -> None:
    env = make(goal=(0.8, 0.0), success_radius=0.25)
    for _ in range(10):
        obs, _, terminated, truncated, info = env.step(FORWARDS)
        assert terminated == info["is_success"] == (math.dist(obs[:2], (0.8, 0.0)) < 0.25)
        assert not truncated
        if terminated:
            break
    assert terminated
    assert obs[0] > 0.5


@pytest.mark.parametrize(("radius", "success"), [(0.3, True), (0.2, False)])
def test_success_is_a_matter_of_the_radius(make: Make, radius: float, success: bool) -> None:
    env = make(goal=(0.2, 0.15), success_radius=radius)
    assert env.reset()[1]["is_success"] is success
    assert env.step(STAND)[2] is success


@pytest.mark.parametrize("place", [(2.5, 0.2), (2.3, 0.0)])
def test_goal_lies_two_and_a_half_metres_ahead_and_a_quarter_of_a_metre_is_near(
    make: Make, place: tuple[float, float]
) -> None:
    env = make()
    assert env.goal == (2.5, 0.0)
    put(env, (*place, 0.142))
    assert env.step(STAND)[2]
    put(env, (2.5 + 3 * (place[0] - 2.5), 3 * place[1], 0.142))
    assert not env.step(STAND)[2]


def test_success_is_where_the_robot_is_and_not_where_its_sensors_say(make: Make) -> None:
    env = make(goal=(0.0, 0.0), profile=Profile("lost", position_noise=100.0))
    obs, _, terminated, _, info = env.step(STAND)
    assert math.hypot(*obs[:2]) > 1.0
    assert terminated
    assert info["is_success"]


def test_reset_begins_an_episode_anew(make: Make) -> None:
    env = make(goal=(0.4, 0.0))
    assert walk(env, FORWARDS, 2)[-1, 0] > 0.2
    assert env.step(STAND)[2]
    assert not env.reset()[1]["is_success"]
    assert not env.step(STAND)[2]


# --- Goals that are given ---


def test_goal_and_radius_are_kept_in_the_spec_also_through_json() -> None:
    env = gym.make("FamleQuadruped-v0", goal=(0.5, -0.5), success_radius=0.1)
    copy = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert copy.unwrapped.goal == env.unwrapped.goal == (0.5, -0.5)
    assert copy.unwrapped.success_radius == env.unwrapped.success_radius == 0.1
    env.close()
    copy.close()


@pytest.mark.parametrize("goal", [(1.0,), (1, 2, 3), (math.nan, 0.0), (0.0, math.inf), None, 1.0, "ab"], ids=str)
def test_bad_goal_is_refused(goal: Any) -> None:
    with pytest.raises(ValueError, match="goal must be two finite numbers, x and y in m"):
        QuadrupedEnv(goal=goal)


@pytest.mark.parametrize("radius", [0.0, -0.25, math.nan, math.inf, "wide", None, True], ids=str)
def test_bad_radius_is_refused(radius: Any) -> None:
    with pytest.raises(ValueError, match=r"success_radius must be a number between 0.01 and 100 m"):
        QuadrupedEnv(success_radius=radius)


# --- Rendering ---


def green_pixels(picture: Array) -> Array:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (green > red + 30) & (green > blue + 20)


def red_pixels(picture: Array) -> Array:
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (red > 100) & (red > 2 * green) & (red > 2 * blue)


def test_goal_is_drawn_in_its_place_and_its_size(make: Make) -> None:
    near, small, far = (
        green_pixels(make(render_mode="rgb_array", **kwargs).render())
        for kwargs in ({"goal": (0.4, 0.1)}, {"goal": (0.4, 0.1), "success_radius": 0.1}, {"goal": (-50.0, -50.0)})
    )
    assert near.sum() > 2 * small.sum() > 1000
    assert not (small & ~near).any()
    assert far.sum() == 0


def test_picture_of_the_goal_does_not_change_the_physics(make: Make) -> None:
    blind, seen = make(goal=(0.2, 0.0)), make(goal=(0.2, 0.0), render_mode="rgb_array")
    for action in np.random.default_rng(0).uniform(-1, 1, (3, 4)):
        seen.render()
        np.testing.assert_array_equal(seen.step(action)[0], blind.step(action)[0])


def test_camera_follows_the_robot(make: Make) -> None:
    env = make(render_mode="rgb_array", situation="joint 1 locked")
    before = red_pixels(env.render())
    put(env, (5.0, -5.0, 0.142))
    after = red_pixels(env.render())
    assert before.sum() > 100
    assert (before == after).mean() > 0.99


@pytest.mark.parametrize("situation", ["joint 4 locked", "back left leg blocked"])
def test_blocked_joints_are_red_until_they_are_repaired(make: Make, situation: str) -> None:
    env = make(render_mode="rgb_array")
    intact = env.render()
    assert not red_pixels(intact).any()
    env.set_situation(situation)
    assert red_pixels(env.render()).sum() > 70 * len(env.situation.locked_joints)
    env.set_situation(None)
    np.testing.assert_array_equal(env.render(), intact)


def test_intact_robot_has_the_colours_of_its_description(make: Make, engine: str) -> None:
    untouched = QuadrupedEnv(render_mode="rgb_array", engine=engine)
    np.testing.assert_array_equal(make(render_mode="rgb_array").render(), untouched.render())
    untouched.close()
