"""Robots side by side: what happens to one of them changes nothing for the others, to the last bit."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent.agents.agent import ModelBasedAgent
from tests.agents.test_sensors import DIM, KINDS, Cart, used_agent

Array = npt.NDArray[Any]
ROBOTS, BAD, STEPS, EPISODE = 64, 17, 10, 6


class Dying(Cart):
    """Its episodes end after three steps."""

    def step(self, action: Any) -> Any:
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, self.clock == 3, truncated, info


class Restless(Cart):
    """Resets itself without a word."""

    def step(self, action: Any) -> Any:
        returned = super().step(action)
        return (self.reset()[0], *returned[1:]) if self.clock == 3 else returned


def garbage(step: int, obs: Array) -> Array:
    values = [np.nan, np.inf, 1e30, -3e38, 25.0]
    return np.full(DIM, values[step % len(values)], np.float32)


TROUBLES: dict[str, Callable[[], Cart]] = {
    "dies": Dying,
    "resets itself": Restless,
    "returns garbage": lambda: Cart(sense=garbage),
    "returns NaN": lambda: Cart(sense=lambda step, obs: obs * np.nan),
    "broken": lambda: Cart(gain=-1.0),
}


def robots(trouble: Callable[[], Cart]) -> list[Callable[[], gym.Env[Any, Any]]]:
    makes = [Cart] * BAD + [trouble] + [Cart] * (ROBOTS - BAD - 1)
    return [lambda make=make: gym.wrappers.TimeLimit(make(), EPISODE) for make in makes]


def learned(agent: ModelBasedAgent, trouble: Callable[[], Cart]) -> Array:
    """The actions of all other robots in learn(), (STEPS, ROBOTS - 1, action_dim)."""
    env = DummyVecEnv(robots(trouble))
    env.seed(0)
    agent.set_env(env)
    agent.learn(STEPS * ROBOTS)
    carts = [robot.unwrapped for robot in env.envs]
    return np.array([cart.actions for i, cart in enumerate(carts) if i != BAD])


def predicted(agent: ModelBasedAgent, trouble: Callable[[], Cart]) -> Array:
    """The same in Gymnasium's vector environment, whose robots take a step more to reset."""
    env = gym.vector.SyncVectorEnv(robots(trouble))
    obs, _ = env.reset(seed=list(range(ROBOTS)))
    state, starts, actions = None, np.zeros(ROBOTS, dtype=bool), []
    ended = starts
    for _ in range(STEPS):
        action, state = agent.predict(obs, state, episode_start=starts)
        obs, _, terminated, truncated, _ = env.step(action)
        starts, ended = ended, terminated | truncated
        actions.append(np.delete(action, BAD, axis=0))
    return np.array(actions)


def seeded_agent(kind: str) -> ModelBasedAgent:
    agent = used_agent(kind)
    agent.set_random_seed(0)
    return agent


@cache
def without_trouble(run: Callable[..., Array], kind: str) -> Array:
    return run(seeded_agent(kind), Cart)


@pytest.mark.parametrize("trouble", TROUBLES.values(), ids=TROUBLES)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("run", [learned, predicted])
@pytest.mark.filterwarnings("ignore:An observation of robot", "ignore:.*diverged")
def test_other_robots_do_what_they_do_without_it(
    run: Callable[..., Array], kind: str, trouble: Callable[[], Cart]
) -> None:
    np.testing.assert_array_equal(run(seeded_agent(kind), trouble), without_trouble(run, kind))


def test_each_robot_is_seen_by_its_index() -> None:
    agent = seeded_agent("window")
    learned(agent, TROUBLES["returns NaN"])
    healths = [agent.health(robot=robot) for robot in range(ROBOTS)]
    assert [health["quarantined"] > 0 for health in healths] == [robot == BAD for robot in range(ROBOTS)]
    assert agent.posterior(robot=BAD) != agent.posterior(robot=BAD + 1)
    assert agent.diagnose(robot=BAD + 1)
    with pytest.raises(IndexError, match="robots 0 to 63"):
        agent.health(robot=ROBOTS)
