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

from famle_agent import TruncateOnError
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


class Failing(Cart):
    """Raises an exception in its third step, and where it is reset too often.

    Args:
        resets: How often it can be reset.
    """

    def __init__(self, resets: int = STEPS) -> None:
        super().__init__()
        self.fails_at, self.left = 3, resets

    def reset(self, **arguments: Any) -> Any:
        if not self.left:
            raise ConnectionError("nobody answers")
        self.left -= 1
        return super().reset(**arguments)


def shapeless(step: int, obs: Array) -> Any:
    return "none" if step == 3 else obs[: 2 if step == 2 else DIM]


def garbage(step: int, obs: Array) -> Array:
    values = [np.nan, np.inf, 1e30, -3e38, 25.0]
    return np.full(DIM, values[step % len(values)], np.float32)


TROUBLES: dict[str, Callable[[], gym.Env[Any, Any]]] = {
    "dies": Dying,
    "resets itself": Restless,
    "returns garbage": lambda: Cart(sense=garbage),
    "returns NaN": lambda: Cart(sense=lambda step, obs: obs * np.nan),
    "broken": lambda: Cart(gain=-1.0),
    "raises": lambda: TruncateOnError(Failing()),
    "raises for good": lambda: TruncateOnError(Failing(resets=1)),
    "was never there": lambda: TruncateOnError(Failing(resets=0)),
    "returns no observation": lambda: TruncateOnError(Cart(sense=shapeless)),
}


def robots(trouble: Callable[[], gym.Env[Any, Any]]) -> list[Callable[[], gym.Env[Any, Any]]]:
    makes = [Cart] * BAD + [trouble] + [Cart] * (ROBOTS - BAD - 1)
    return [lambda make=make: gym.wrappers.TimeLimit(make(), EPISODE) for make in makes]


def learned(agent: ModelBasedAgent, trouble: Callable[[], gym.Env[Any, Any]]) -> Array:
    """The actions of all other robots in learn(), (STEPS, ROBOTS - 1, action_dim)."""
    env = DummyVecEnv(robots(trouble))
    env.seed(0)
    agent.set_env(env)
    agent.learn(STEPS * ROBOTS)
    carts = [robot.unwrapped for robot in env.envs]
    return np.array([cart.actions for i, cart in enumerate(carts) if i != BAD])


def predicted(agent: ModelBasedAgent, trouble: Callable[[], gym.Env[Any, Any]]) -> Array:
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
@pytest.mark.filterwarnings("ignore:An observation of robot", "ignore:.*diverged", "ignore:.*failed")
def test_other_robots_do_what_they_do_without_it(
    run: Callable[..., Array], kind: str, trouble: Callable[[], gym.Env[Any, Any]]
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


@pytest.mark.filterwarnings("ignore:An observation of robot", "ignore:.*failed")
def test_robot_that_fails_is_counted() -> None:
    agent = seeded_agent("window")
    learned(agent, TROUBLES["raises for good"])
    assert agent.get_env().get_attr("errors", BAD) == [3]  # a step, the reset after it, and that of the next episode
    assert [agent.health(robot=robot)["quarantined"] for robot in (BAD, BAD + 1)] == [STEPS - 2, 0]


@pytest.mark.filterwarnings("ignore:.*diverged")
def test_exception_names_its_robot_and_leaves_what_is_believed() -> None:
    """Of robots that nothing is wrapped around."""
    agent = seeded_agent("window")
    with pytest.raises(ConnectionError, match="the cable is loose") as caught:
        learned(agent, Failing)
    assert caught.value.__notes__ == [
        f"Robot {BAD} of {ROBOTS} raised it. Wrap each robot in famle_agent.TruncateOnError for the others to go on "
        "where one of them fails."
    ]
    believed = [agent.posterior(robot=robot) for robot in range(ROBOTS)]
    assert believed[0] != believed[1]
    env = DummyVecEnv(robots(Cart))
    env.seed(0)
    agent.set_env(env)
    assert [agent.posterior(robot=robot) for robot in range(ROBOTS)] == believed
    agent.learn(STEPS * ROBOTS)
    adapted = agent.belief.adaptations
    agent.forget()
    agent.learn(STEPS * ROBOTS)
    assert agent.belief.adaptations < adapted
