"""Names of situations, and situations of robots that know nothing of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from famle_agent import FAMLE
from famle_envs import Situation
from famle_envs.faults import FaultWrapper

MakeEnv = Callable[..., gym.Env[Any, Any]]


def pendulum(**kwargs: Any) -> FAMLE:
    return FAMLE("Pendulum-v1", seed=0, device="cpu", hidden=(32,), joint_iterations=2, **{"policy_steps": 0, **kwargs})


def test_keys_of_a_mapping_name_the_situations(make_env: MakeEnv) -> None:
    agent = pendulum(policy_steps=0, transitions_per_situation=4)
    planets = {"earth": lambda: gym.make("Pendulum-v1"), "moon": make_env("Pendulum-v1", g=1.6)}
    faults = {"lame": Situation(motor_gain=(0.5,), name="not this"), "dead": "motor 0 dead", "on": {"motor_stuck": [1]}}
    assert agent.collect({**planets, **faults}).situations == ("earth", "moon", "lame", "dead", "on")


def test_names_are_what_the_agent_believes_in() -> None:
    agent = pendulum(policy_steps=0, transitions_per_situation=20)
    agent.meta_learn({"earth": lambda: gym.make("Pendulum-v1"), "moon": lambda: gym.make("Pendulum-v1", g=1.6)})
    assert agent.situations == ("earth", "moon")
    assert list(agent.posterior()) == ["earth", "moon"]


@pytest.mark.parametrize("robot", ["Pendulum-v1", "InvertedPendulum-v5"])
def test_foreign_robot_breaks_as_ours_do(robot: str) -> None:
    agent = FAMLE(robot, seed=0, device="cpu", policy_steps=0, transitions_per_situation=20)
    data = agent.collect(["motor 0 dead", Situation(motor_stuck=(1.0,))])
    assert data.situations == ("joint 0 dead", "motor 0 stuck at 1")
    speed = np.abs(data.obs[..., -1]).mean(axis=1)
    assert speed[0] < speed[1]


class Tasked(gym.Env[Any, Any]):
    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))
    angle_dims = (1,)

    def reward_fn(self, obs: Any, action: Any, next_obs: Any) -> Any:
        return next_obs[..., 1]


def test_broken_robot_keeps_its_task_and_its_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "Tasked-v0", EnvSpec("Tasked-v0", Tasked, disable_env_checker=True))
    for env in (Tasked(), gym.make("Tasked-v0")):
        agent = FAMLE(FaultWrapper(env, "motor 0 dead, sensor 0 noise 0.1"), device="cpu")
        assert agent.dims["angle_dims"] == (1,)
        obs = torch.rand(2, 2)
        torch.testing.assert_close(agent.policy.unit_reward_fn()(obs, torch.zeros(2, 1), obs), obs[:, 1])


def test_broken_robot_is_trained_on_the_faults_of_its_motors(make_env: MakeEnv) -> None:
    env = FaultWrapper(make_env("Pendulum-v1"), "sensor 0 off by 0.1")
    agent = FAMLE(env, seed=0, device="cpu", policy_steps=0, transitions_per_situation=4)
    names = ("intact", "joint 0 dead", "joint 0 at gain 0.5", "joint 0 reversed")
    assert agent.collect().situations == names
    assert agent.collect(["sensor 1 frozen"], n_jobs=2).situations == ("sensor 1 frozen",)


@pytest.mark.parametrize(
    ("own", "envs", "message"),
    [
        ("FamleReacher-v0", {}, "at least one environment"),
        ("FamleReacher-v0", {"a\nb": "intact"}, r"name of a situation must be a line of text, got 'a\\nb'"),
        ("FamleReacher-v0", {"": "intact"}, "must be a line of text"),
        ("FamleReacher-v0", [Situation(name="a\tb")], "must be a line of text"),
        ("FamleReacher-v0", {3: "intact"}, "must be a line of text"),
        ("Pendulum-v1", ["friction x 2"], "needs a MuJoCo model"),
        ("Pendulum-v1", {"motor_gain": [0.5]}, "got dict; put a single one into a list"),
    ],
)
def test_names_and_faults_that_make_no_sense_are_refused(own: str, envs: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FAMLE(own, device="cpu").meta_learn(envs)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("intact", ""), "must be a line of text, got ''"),
        (("intact", "a\nb"), "must be a line of text"),
        (("a\tb", "intact"), "must be a line of text"),
        (("intact", "intact"), "Two situations are called 'intact'"),
        (("a", "b", "a + b"), r"called 'a \+ b'.*another name"),
    ],
)
def test_names_of_transitions_that_cannot_be_told_apart_are_refused(names: tuple[str, ...], message: str) -> None:
    n = len(names)
    agent = pendulum(transitions_per_situation=4)
    data = agent.collect(["intact"] * n)
    with pytest.raises(ValueError, match=message):
        agent.meta_learn(replace(data, situations=names))
    if len(set(names)) == n:
        with pytest.raises(ValueError, match=message):
            agent.collect(dict.fromkeys(names, "intact"))
