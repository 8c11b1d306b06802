"""Agents under other units, offsets, default dtypes and modes of torch than usual."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from famle_agent import AMPC, FAMLE, FAMLEWrapper
from famle_agent.training.policy_search import PolicySearch, Search

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]
SETTINGS: dict[str, Any] = {
    "policy_steps": 0,
    "transitions_per_situation": 300,
    "hidden": (32,),
    "members": 1,
    "joint_iterations": 300,
    "horizon": 5,
    "candidates": 60,
    "planner_iterations": 3,
    "adapt_every": 3,
    "adapt_steps": 2,
    "device": "cpu",
    "seed": 0,
}


class Point(gym.Env[Any, Any]):
    """Moves 0.1 of a unit a step, towards (1, -1) of them; the origin may be elsewhere."""

    action_space = spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, unit: float = 1.0, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        self.unit, self.origin = unit, np.array(origin)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float64 if any(origin) else np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.x, self.clock = np.zeros(2), 0
        return self.observe(), {}

    def observe(self) -> Array:
        return (self.origin + self.unit * self.x).astype(self.observation_space.dtype)

    def step(self, action: Any) -> Any:
        self.x, self.clock = self.x + 0.1 * np.clip(action, -1, 1), self.clock + 1
        return self.observe(), -self.unit * self.distance, False, self.clock == 30, {}

    @property
    def distance(self) -> float:
        return float(np.linalg.norm(self.x - (1.0, -1.0)))


def ends_at(agent: FAMLE, env: Point, steps: int = 25) -> float:
    """The distance from the goal after some steps, in units."""
    obs, state = env.reset(seed=0)[0], None
    for _ in range(steps):
        action, state = agent.predict(obs, state)
        obs, *_ = env.step(action)
    return env.distance


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_robot_reaches_its_goal_in_any_unit(unit: float) -> None:
    def reward(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return -(next_obs - unit * torch.tensor([1.0, -1.0])).norm(dim=-1)

    agent = FAMLE(Point(unit), reward_fn=reward, **SETTINGS).meta_learn([lambda: Point(unit)], check=False)
    assert ends_at(agent, Point(unit)) < 0.15


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_policy_search_knows_no_units(unit: float) -> None:
    def found(unit: float) -> Any:
        search = Search(PolicySearch(300, hidden=(4,), random_steps=100), [Point(unit), Point(unit)], ["a", "b"], 0)
        list(search.run())
        return search.transitions(), search.actor_critic()

    (seen, usual), (seen_too, scaled) = found(1.0), found(unit)
    n = 40  # while actions are random
    np.testing.assert_allclose(seen_too.obs[:, :n], unit * seen.obs[:, :n], rtol=1e-6)
    torch.testing.assert_close(scaled.std[2:], usual.std[2:], rtol=1e-3, atol=1e-3)
    for relative in (scaled.std[:2] / (unit * usual.std[:2]), scaled.value_scale / (unit * usual.value_scale)):
        assert ((relative > 0.1) & (relative < 10.0)).all()


@pytest.mark.parametrize("origin", [(388096.0, 3948996.0), (1e12, 1e12)])
def test_coordinates_far_from_their_origin_are_warned_of(origin: tuple[float, float]) -> None:
    agent = FAMLE(Point(1.0, origin), reward_fn=lambda o, a, n: n[..., 0], **{**SETTINGS, "joint_iterations": 1})
    with pytest.warns(UserWarning, match=r"single precision.*subtract a constant in float64"):
        agent.meta_learn([lambda: Point(1.0, origin)], check=False)


@pytest.mark.filterwarnings("error:.*single precision")
def test_coordinates_near_their_origin_are_not() -> None:
    settings = {**SETTINGS, "joint_iterations": 1}
    for origin in ((0.0, 0.0), (100.0, -1000.0)):
        agent = FAMLE(Point(1.0, origin), reward_fn=lambda o, a, n: n[..., 0], **settings)
        agent.meta_learn([lambda origin=origin: Point(1.0, origin)], check=False)


# --- torch --------------------------------------------------------------------------------------------------


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    outside = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(outside)


def life(agent: FAMLE, env: gym.Env[Any, Any], steps: int = 7) -> Array:
    """The actions of some steps in which the agent adapts."""
    wrapped, actions = FAMLEWrapper(env, agent), []
    obs, _ = wrapped.reset(seed=0)
    for _ in range(steps):
        action, _ = agent.predict(obs)
        obs, *_ = wrapped.step(action)
        actions.append(action)
    assert agent.belief.adaptations
    return np.array(actions)


MODES: dict[str, Callable[[], Any]] = {
    "double": lambda: default_dtype(torch.float64),
    "half": lambda: default_dtype(torch.bfloat16),
    "inference": torch.inference_mode,
    "no gradients": torch.no_grad,
}


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES.keys())
@pytest.mark.parametrize("robot", ["quadruped", "ant"])
def test_shipped_robot_lives_as_usual_in_other_modes(robot: str, mode: Callable[[], Any]) -> None:
    usual = FAMLE(robot, seed=0, device="cpu", adapt_every=2)
    expected = life(usual, usual.get_env().envs[0])
    with mode():
        agent = FAMLE(robot, seed=0, device="cpu", adapt_every=2)
        np.testing.assert_array_equal(life(agent, agent.get_env().envs[0]), expected)
    life(agent, agent.get_env().envs[0])  # what was made inside is of use outside


LITTLE = {**SETTINGS, "transitions_per_situation": 50, "joint_iterations": 3, "meta_iterations": 2}
SEARCH = {"policy_steps": 120, "policy_hidden": (4,), "policy_random_steps": 20, "joint_iterations": 2, "hidden": (8,)}


@pytest.mark.parametrize("planner", ["icem", "mppi", "random_shooting"])
@pytest.mark.parametrize("mode", MODES.values(), ids=MODES.keys())
def test_agent_learns_and_lives_across_modes(mode: Callable[[], Any], planner: str) -> None:
    settings = {**LITTLE, "planner": planner}
    if planner == "random_shooting":
        del settings["planner_iterations"]

    def reward(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return -(next_obs - torch.tensor([1.0, -1.0])).norm(dim=-1)

    usual = FAMLE(Point(), reward_fn=reward, **settings).meta_learn([Point], check=False)
    with mode():
        agent = FAMLE(Point(), reward_fn=reward, **settings).meta_learn([Point], check=False)
        for name, value in usual.model.state_dict().items():
            assert torch.equal(agent.model.state_dict()[name], value)
        life(usual, Point())
    life(agent, Point())
    agent.learn(5)


@pytest.mark.parametrize("mode", [MODES["double"], MODES["inference"]], ids=["double", "inference"])
def test_policy_search_across_modes(mode: Callable[[], Any]) -> None:
    with mode():
        agent = FAMLE("Pendulum-v1", reward_fn=lambda o, a, n: n[..., 0], seed=0, device="cpu", **SEARCH)
        agent.meta_learn(["intact", "motor 0 reversed"], check=False)
        life(agent, gym.make("Pendulum-v1"), 11)
    life(agent, gym.make("Pendulum-v1"), 11)


def test_rival_without_embeddings_across_modes() -> None:
    with torch.inference_mode(), default_dtype(torch.float64):
        agent = AMPC("reacher", seed=0, device="cpu", transitions_per_situation=20).meta_learn()
    agent.learn(6)


def test_warnings_point_at_who_called(make_env: MakeEnv) -> None:
    class Passing(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            return self.env.step(action)

    settings = {**SETTINGS, "joint_iterations": 1}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        FAMLE("ant", device="cpu", hidden=(8,))
        FAMLE(Passing(make_env()), device="cpu", angle_dims=())
        far = Point(1.0, (388096.0, 3948996.0))
        FAMLE(far, reward_fn=lambda o, a, n: n[..., 0], **settings).meta_learn([far], check=False)
    assert [warning.filename for warning in said] == [__file__] * 3
