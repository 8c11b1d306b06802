from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

from famle_agent import FAMLE
from famle_envs.a1 import A1Env
from famle_envs.gait_env import GaitEnv
from famle_envs.minitaur import MinitaurEnv
from famle_envs.profile import SIMULATOR, Profile, resolve_profile
from famle_envs.quadruped import QuadrupedEnv
from tests.helpers import making, quadruped_with, walk
from tests.worlds import inertias, masses

Make = Callable[..., QuadrupedEnv]

STAND, FORWARDS = np.array([0.0, 0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0, 0.0])
ROBOTS: list[type[GaitEnv]] = [QuadrupedEnv, A1Env, MinitaurEnv]


@pytest.fixture
def make(engine: str) -> Iterator[Make]:
    with making(quadruped_with, engine) as make_robot:
        yield make_robot


# --- Profiles by name ---


@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_is_the_simulator_until_it_is_given_another_profile(robot: type[GaitEnv]) -> None:
    mine = Profile("mine", latency=0.1)
    for given, profile in (
        ({}, SIMULATOR),
        ({"profile": "simulator"}, SIMULATOR),
        ({"profile": "held-out"}, robot.profiles["held-out"]),
        ({"profile": mine}, mine),
    ):
        env = robot(**given)
        assert env.profile is profile
        env.close()


@pytest.mark.parametrize("robot", ROBOTS)
def test_held_out_profile_differs_from_the_simulator_in_every_ingredient(robot: type[GaitEnv]) -> None:
    held_out = robot.profiles["held-out"]
    assert not held_out.is_simulator
    assert [f.name for f in fields(Profile) if getattr(held_out, f.name) == getattr(SIMULATOR, f.name)] == []
    assert len(held_out.zero_errors) == len(robot.joints)


@pytest.mark.parametrize("robot", ROBOTS)
def test_robot_walks_on_held_out_dynamics_too_and_otherwise_than_in_the_simulator(robot: type[GaitEnv]) -> None:
    ends = []
    for profile in ("simulator", "held-out"):
        env = robot(profile=profile)
        env.reset(seed=0)
        ends.append(walk(env, FORWARDS, 4)[-1])
        env.close()
    assert ends[1][0] > 0.2
    assert np.abs(ends[1] - ends[0]).max() > 0.1


@pytest.mark.parametrize("robot", ROBOTS)
def test_unknown_profile_is_refused_with_the_list_of_profiles(robot: type[GaitEnv]) -> None:
    with pytest.raises(ValueError, match=r"There is no profile 'realty'. Profiles: simulator, held-out\."):
        robot(profile="realty")


@pytest.mark.parametrize("robot", ROBOTS)
def test_old_name_of_the_held_out_profile_still_works(robot: type[GaitEnv]) -> None:
    with pytest.warns(DeprecationWarning, match="'held-out' now"):
        env = robot(profile="reality")
    assert env.profile == robot.profiles["held-out"]
    env.close()


def test_old_module_still_works() -> None:
    with pytest.warns(DeprecationWarning, match=r"famle_envs\.profile now"):
        old = importlib.import_module("famle_envs.reality")
    assert old.Profile is Profile


@pytest.mark.parametrize("profile", [None, 1.0, {"latenzy": 0.1}])
def test_profile_of_another_type_is_refused(profile: Any) -> None:
    with pytest.raises(TypeError, match=r"a Profile, a mapping of its fields or a name|latenzy"):
        resolve_profile(profile, {}, 12)


def test_profile_prints_its_name_and_what_differs_from_the_simulator() -> None:
    assert str(SIMULATOR) == "simulator"
    assert str(Profile("twin")) == "twin"
    assert str(Profile("slow", latency=0.1, motor_speed=0.5)) == "slow: motor_speed 0.5, latency 0.1"
    for ingredient in fields(Profile)[1:]:
        assert ingredient.name in str(QuadrupedEnv.profiles["held-out"])


def test_profile_that_differs_in_nothing_gives_the_same_bits(make: Make) -> None:
    np.testing.assert_array_equal(walk(make(latency=0.0), FORWARDS, 2), walk(make(), FORWARDS, 2))


def test_own_profile_is_kept_in_the_spec_also_through_json() -> None:
    env = gym.make("FamleQuadruped-v0", profile=Profile("mine", latency=0.1))
    try:
        copy = gym.make(EnvSpec.from_json(env.spec.to_json()))
        assert copy.unwrapped.profile == env.unwrapped.profile
        copy.close()
    finally:
        env.close()


@pytest.mark.parametrize("errors", [(0.1,), (0.1, 0.2, 0.3)])
def test_zero_errors_for_other_than_all_joints_are_refused(make: Make, errors: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="zero_errors"):
        make(zero_errors=errors)


# --- The body, the floor and the sensors ---


def test_masses_and_inertias_are_those_of_the_description_times_their_factors(make: Make) -> None:
    built, real = make(), make(base_mass=1.5, leg_mass=0.75)
    factors = np.array([1.5, *[0.75] * 12])
    np.testing.assert_allclose(masses(real) / masses(built), factors)
    np.testing.assert_allclose(inertias(real) / inertias(built), np.tile(factors[:, None], 3))


@pytest.mark.parametrize("ingredients", [{"base_mass": 2.0}, {"leg_mass": 2.0}, {"floor_friction": 0.05}])
def test_factor_changes_how_the_robot_walks(make: Make, ingredients: dict[str, float]) -> None:
    assert np.abs(walk(make(**ingredients), FORWARDS, 3) - walk(make(), FORWARDS, 3)).max() > 0.01


def test_situation_multiplies_what_the_profile_does(make: Make) -> None:
    both = make("friction x 0.25, base mass x 2", floor_friction=0.5, base_mass=1.5)
    alone = make("friction x 0.125, base mass x 3")
    np.testing.assert_array_equal(walk(both, FORWARDS, 3), walk(alone, FORWARDS, 3))
    both.set_situation(None)
    both.reset()
    assert masses(both)[0] == pytest.approx(1.5 * masses(make())[0])


def test_robot_sinks_into_a_soft_floor(make: Make) -> None:
    heights = []
    for ingredients in ({}, {"contact_stiffness": 300.0, "contact_damping": 30.0}):
        env = make(**ingredients)
        walk(env, STAND, 2)
        heights.append(env.position[2])
    sunk = 2.0 * 9.81 / (4 * 300.0)
    assert heights[0] - heights[1] == pytest.approx(sunk, rel=0.3)


def test_noise_is_drawn_with_the_seed_and_does_not_move_the_robot(make: Make) -> None:
    noisy, clean = make(position_noise=0.05, orientation_noise=0.1), make()
    rows = []
    for seed in (1, 1, 2):
        start = noisy.reset(seed=seed)[0]
        rows.append([start, *walk(noisy, FORWARDS, 2)])
    np.testing.assert_array_equal(rows[0], rows[1])
    assert (np.array(rows[0]) != rows[2]).all()
    walk(clean, FORWARDS, 2)
    assert noisy.position == clean.position


def test_noise_has_its_deviations_and_the_heading_stays_a_heading(make: Make) -> None:
    env = make(position_noise=0.05, orientation_noise=0.1)
    rows = np.array([env.reset(seed=seed)[0] for seed in range(400)])
    np.testing.assert_allclose(rows[:, :2].std(axis=0), 0.05, rtol=0.2)
    assert np.arctan2(rows[:, 2], rows[:, 3]).std() == pytest.approx(0.1, rel=0.2)
    np.testing.assert_allclose(rows.mean(axis=0)[:3], 0.0, atol=0.02)
    np.testing.assert_allclose(np.hypot(rows[:, 2], rows[:, 3]), 1.0, atol=1e-6)


# --- No agent is trained on a profile ---


REFUSED = r"The profile 'held-out' stands for the robot that an agent is made for, and no agent meta-learns on it"
TINY: dict[str, Any] = {"seed": 0, "device": "cpu", "pretrained": False, "transitions_per_situation": 1}


def real() -> gym.Env[Any, Any]:
    return gym.make("FamleQuadruped-v0", profile="held-out")


def simulated() -> gym.Env[Any, Any]:
    return gym.make("FamleQuadruped-v0")


@pytest.mark.parametrize("envs", [None, ["joint 0 locked"], [simulated, real]], ids=["all", "one", "in the list"])
def test_agent_whose_own_robot_is_real_does_not_train_on_it(envs: Any) -> None:
    agent = FAMLE(real(), **TINY)
    for learn in (agent.meta_learn, agent.collect):
        with pytest.raises(ValueError, match=REFUSED):
            learn(envs)
    agent.get_env().close()


@pytest.mark.parametrize("in_a_factory", [False, True])
def test_real_robot_among_the_simulated_ones_is_refused(in_a_factory: bool) -> None:
    agent, odd = FAMLE(simulated(), **TINY), real()
    with pytest.raises(ValueError, match=REFUSED):
        agent.meta_learn([simulated, real if in_a_factory else odd])
    odd.close()
    agent.get_env().close()


def test_agent_for_a_real_robot_collects_in_the_simulator() -> None:
    agent = FAMLE(real(), **TINY)
    assert agent.collect([simulated]).situations == ("intact",)
    agent.get_env().close()


def test_own_profile_is_refused_by_its_name() -> None:
    agent = FAMLE(gym.make("FamleQuadruped-v0", profile=Profile("mine", latency=0.1)), **TINY)
    with pytest.raises(ValueError, match="The profile 'mine'"):
        agent.meta_learn(["intact"])
    agent.get_env().close()


def test_profile_without_a_name_is_not_the_simulator() -> None:
    assert SIMULATOR.is_simulator
    assert not Profile(base_mass=2.0).is_simulator


def test_agent_for_a_robot_with_an_own_profile_has_the_settings_of_that_robot() -> None:
    agents = [FAMLE(gym.make("FamleQuadruped-v0", profile=p), device="cpu") for p in ("held-out", Profile("mine"))]
    for agent in agents:
        agent.get_env().close()
    assert agents[0].config == agents[1].config
