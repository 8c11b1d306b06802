from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from famle_agent import AMPC, FAMLE, FAMLEWrapper
from famle_agent.agents.presets import known_robots
from famle_agent.rollout import rollout

MakeEnv = Callable[..., gym.Env[Any, Any]]


@pytest.fixture(scope="module")
def agent() -> Any:
    agent = FAMLE("ant", seed=0, device="cpu")
    yield agent
    agent.get_env().close()


def test_robot_reads_what_the_agent_believes(agent: FAMLE, make_env: MakeEnv) -> None:
    env = make_env("FamleAnt-v0")
    for name in agent.posterior():
        parts = name.split(" + ")
        yaw_errors = sum("yaw" in part for part in parts)
        if yaw_errors == 2:  # which no robot has
            with pytest.raises(ValueError, match="contradicts"):
                env.get_wrapper_attr("set_situation")(name)
        else:
            env.get_wrapper_attr("set_situation")(name)
            text = str(env.get_wrapper_attr("situation"))
            assert all(str(env.get_wrapper_attr("presets")[part]) in text for part in parts)


def test_package_ships_a_model_of_these_settings(agent: FAMLE) -> None:
    assert agent.dynamics is not None
    assert agent.dynamics.members == agent.config.model.members
    assert len(agent.situations) == 20
    assert agent.situations[0] == "intact"


def test_shipped_model_is_small() -> None:
    file = known_robots()["ant"].pretrained
    assert file is not None
    assert len(file.read_bytes()) < 2_000_000


@pytest.mark.parametrize("settings", [{"mode": "paper"}, {"members": 2}, {"pretrained": False}])
def test_other_settings_begin_without_a_model(settings: dict[str, Any]) -> None:
    other = FAMLE("ant", device="cpu", **settings)
    assert other.dynamics is None
    other.get_env().close()


def test_another_control_rate_is_another_world(make_env: MakeEnv) -> None:
    with pytest.warns(UserWarning, match=r"not taken: it has another environment \(control_rate\)\. meta_learn"):
        assert FAMLE(make_env("FamleAnt-v0", control_rate=100), device="cpu").dynamics is None


@pytest.mark.filterwarnings("error:.*not taken")
@pytest.mark.parametrize(
    "arguments",
    [
        {"control_rate": 60.6},
        {"control_rate": np.float64(60.6), "yaw_sensor": "offset"},
        {"situation": "joint 0 dead", "terminate_when_fallen": np.bool_(True)},
    ],
)
def test_default_that_is_said_is_the_same_world(make_env: MakeEnv, arguments: Any) -> None:
    assert FAMLE(make_env("FamleAnt-v0", **arguments), device="cpu").dynamics is not None


def test_what_refused_the_shipped_model_is_said_once() -> None:
    with pytest.warns(UserWarning, match="another hidden, members") as said:
        FAMLE("ant", device="cpu", hidden=(8,), members=2)
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert FAMLE("ant", device="cpu", hidden=(8,), pretrained=False).dynamics is None
        assert FAMLE("ant", "paper", device="cpu").dynamics is None
        AMPC("ant", device="cpu")


@pytest.mark.slow
def test_ant_walks_at_once_and_again_after_it_broke(agent: FAMLE, make_env: MakeEnv) -> None:
    agent.forget()
    agent.set_random_seed(0)
    env = FAMLEWrapper(make_env("FamleAnt-v0", max_episode_steps=330), agent)
    run = rollout(env, 0, "joint 4 dead, yaw sensor off by 100 deg", breaks_at=150)
    assert run.reward[100:150].mean() > 0.8
    assert run.reward[-100:].mean() > 0.8
    assert run.situations[149] == "intact"
    assert run.situations[-1] in ("joint 4 dead + yaw sensor off by 90 deg", "joint 4 dead + yaw sensor off by 120 deg")


@pytest.mark.slow
def test_situation_is_named_from_random_transitions(agent: FAMLE) -> None:
    held_out = FAMLE("ant", seed=123, device="cpu", pretrained=False, transitions_per_situation=100).collect()
    named = []
    for i in range(len(held_out.situations)):
        agent.forget()
        for t in range(100):
            agent.observe(held_out.obs[i, t], held_out.action[i, t], held_out.next_obs[i, t])
        posterior = agent.posterior()
        named.append(max(posterior, key=lambda name: posterior[name]) == held_out.situations[i])
    agent.forget()
    assert np.mean(named) >= 0.95
