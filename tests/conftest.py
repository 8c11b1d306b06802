from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib as mpl
import pytest
import torch
from hypothesis import settings
from joblib import parallel_config

import famle_envs  # noqa: F401 (registers the robots)
from benchmarks import ppo
from famle_agent import FAMLE, Transitions
from famle_agent.agents.presets import known_robots
from famle_envs.a1 import A1Env
from famle_envs.engines import ENGINES
from tests.helpers import skip_what_cannot_be_drawn
from tests.small_reacher import EPISODE, REDUCED, SMALL_ROLLOUTS

mpl.use("Agg")
torch.set_num_threads(1)
settings.register_profile("famle", deadline=None, max_examples=25, derandomize=True)
settings.load_profile("famle")

SMALL: dict[str, Any] = {
    "transitions_per_situation": 400,
    "action_hold": 5,
    "hidden": (70, 50),
    "meta_iterations": 100,
    "meta_batch_size": 11,
    "inner_steps": 20,
    "adapt_every": 2,
    "memory_size": 50,
    "hazard": 0.0,
    "likelihood_power": 1.0,
    "compose": False,
    "adapt_steps": 20,
    "adapt_batch_size": 64,
    "adapt_embedding_lr": 0.05,
    "horizon": 10,
    "candidates": 100,
    "planner_iterations": 3,
    "elites": 10,
}
"""Settings of an agent that knows its situations after a few seconds of learning, and adapts much as in the paper."""

QUICK: dict[str, Any] = {"adapt_every": 5, "adapt_steps": 2, "candidates": 20, "planner_iterations": 1}
"""Settings of a loaded agent for tests that need it to run and not to be good."""


_OF_THE_A1 = {"a1", "FamleA1-v0", "famle_envs.a1", str(A1Env)}


@pytest.fixture(scope="session")
def transitions() -> Transitions:
    """Random transitions of the reacher's 11 training situations."""
    agent = FAMLE("reacher", seed=0, device="cpu", **SMALL)
    collected = agent.collect()
    agent.get_env().close()
    return collected


@pytest.fixture(scope="session")
def agent_file(transitions: Transitions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small meta-learned agent for the reacher."""
    agent = FAMLE("reacher", seed=0, device="cpu", **SMALL)
    path = tmp_path_factory.mktemp("agent") / "reacher.zip"
    agent.meta_learn(transitions).save(path)
    agent.get_env().close()
    return path


@pytest.fixture
def load_agent(agent_file: Path) -> Iterator[Callable[..., FAMLE]]:
    """Loads fresh copies of the small agent, with settings changed."""
    agents = []

    def load(**overrides: Any) -> FAMLE:
        agents.append(FAMLE.load(agent_file, device="cpu", **overrides))
        return agents[-1]

    yield load
    for agent in agents:
        agent.get_env().close()


@pytest.fixture
def agent(load_agent: Callable[..., FAMLE]) -> FAMLE:
    """A fresh copy of the small agent with its own settings."""
    return load_agent()


@pytest.fixture
def quick_agent(load_agent: Callable[..., FAMLE]) -> FAMLE:
    """A fresh copy of the small agent that plans and adapts in little time, and not well."""
    return load_agent(**QUICK)


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    """The name of each engine that is installed."""
    pytest.importorskip(request.param)
    return str(request.param)


@pytest.fixture(autouse=True)
def _described(request: pytest.FixtureRequest) -> None:
    """Skips what is about the A1 where PyBullet, which describes it, is not installed."""
    parameters = getattr(request.node, "callspec", None)
    if parameters is not None and any(str(value) in _OF_THE_A1 for value in parameters.params.values()):
        pytest.importorskip("pybullet_data")


@pytest.fixture
def make_env() -> Iterator[Callable[..., gym.Env[Any, Any]]]:
    """Makes environments that are closed after the test."""
    envs = []

    def make(env_id: str = "FamleReacher-v0", **kwargs: Any) -> gym.Env[Any, Any]:
        skip_what_cannot_be_drawn(kwargs.get("engine"), kwargs.get("render_mode"))
        envs.append(gym.make(env_id, **kwargs))
        return envs[-1]

    yield make
    for env in envs:
        env.close()


@pytest.fixture
def tiny_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shrinks what an agent spends by default, and the reacher's episodes; shipped models stay what they are."""
    tiny = {**QUICK, "transitions_per_situation": 40, "meta_iterations": 3, "inner_steps": 3}
    tiny |= {"rounds": 0, "joint_iterations": 2}
    policy = {"policy_steps": 120, "policy_random_steps": 20, "policy_updates_per_step": 0.1, "policy_hidden": (8,)}
    for robot in known_robots().values():
        for mode in robot.modes.values():
            small = tiny if robot.pretrained is None else QUICK
            for name, value in (small | (policy if "policy_steps" in mode else {})).items():
                monkeypatch.setitem(mode, name, value)
    monkeypatch.setattr(gym.spec("FamleReacher-v0"), "max_episode_steps", 6)


@pytest.fixture
def small_reacher(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Shrinks what the benchmark's agents for the reacher spend, and its episodes; all in this process."""
    robot = known_robots()["reacher"]
    tuned = [settings for rivals in robot.rivals.values() for settings in rivals.values()]
    for mode in (*robot.modes.values(), *tuned):
        for name, value in REDUCED.items():
            monkeypatch.setitem(mode, name, value)
    monkeypatch.setitem(robot.modes["original"], "adapt_epochs", 1)
    monkeypatch.setitem(ppo.SETTINGS, "reacher", SMALL_ROLLOUTS)  # type: ignore[arg-type]
    monkeypatch.setattr(ppo, "SIMULATED_SETTINGS", SMALL_ROLLOUTS)
    monkeypatch.setitem(ppo.SIMULATED_STEPS, "reacher", 16)  # type: ignore[arg-type]
    monkeypatch.setattr(gym.spec("FamleReacher-v0"), "max_episode_steps", EPISODE)
    with parallel_config("sequential"):
        yield


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tests of a file share what their small agents learn in simulation."""
    return tmp_path_factory.mktemp("cache")
