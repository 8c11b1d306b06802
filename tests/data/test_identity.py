from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.monitor import Monitor

from famle_agent.data.identity import identity
from famle_envs import Situation
from tests.clock import Clock

GAIN = 1.0


def times(factor: float) -> Callable[[float], float]:
    return lambda x: factor * x


def with_default(x: float, factor: Any = 1.0) -> float:
    return x * factor


def of_global(x: float) -> float:
    return GAIN * x


class Towards:
    def __init__(self, goal: Any) -> None:
        self.goal = goal

    def __call__(self, x: float) -> float:
        return x - self.goal

    def reward(self, x: float) -> float:
        return -x * self.goal


def pendulum(**kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make("Pendulum-v1", **kwargs)


class Slower(Clock):
    def step(self, action: Any) -> Any:
        return super().step(0.5 * action)


ALIKE: dict[str, Callable[[], Any]] = {
    "closure": lambda: times(2.0),
    "partial": lambda: partial(with_default, factor=2.0),
    "callable": lambda: Towards(np.zeros(2)),
    "method": lambda: Towards(1.0).reward,
    "situation": lambda: Situation(motor_gain=(1, 0)),
    "tensor": lambda: torch.arange(3.0),
    "environment": lambda: pendulum(g=3.0),
    "own environment": Clock,
    "class": lambda: Clock,
    "set": lambda: {"a", "b", "c"},
    "C function": lambda: torch.exp,
}


@pytest.mark.parametrize("name", ALIKE)
def test_what_is_made_alike_is_alike(name: str) -> None:
    one, other = identity(ALIKE[name]()), identity(ALIKE[name]())
    assert json.loads(json.dumps(one)) == json.loads(json.dumps(other))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (times(2.0), times(3.0)),
        (lambda x: x + 1.0, lambda x: x + 2.0),
        (lambda x: x + 1.0, lambda x: x - 1.0),
        (lambda x: abs(x) + 1, lambda x: round(x) + 1),
        (lambda: [x + 1 for x in range(3)], lambda: [x + 2 for x in range(3)]),
        (partial(with_default, factor=2.0), partial(with_default, factor=3.0)),
        (partial(with_default, 2.0), partial(of_global, 2.0)),
        (Towards(np.zeros(2)), Towards(np.ones(2))),
        (Towards(1.0).reward, Towards(2.0).reward),
        (Towards(1.0).reward, Towards(1.0)),
        (Situation(motor_gain=(1, 0)), Situation(motor_gain=(0, 1))),
        (torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)),
        (Clock, Slower),
        (gym.spec("Pendulum-v1"), dataclasses.replace(gym.spec("Pendulum-v1"), entry_point=Clock)),
        (Clock(), Slower()),
        (np.zeros(3), np.zeros(4)),
        (np.zeros(3), np.zeros(3, np.float32)),
        (torch.exp, torch.sin),
        (None, False),
    ],
)
def test_what_does_something_else_differs(one: Any, other: Any) -> None:
    assert identity(one) != identity(other)


def test_environments_differ_in_arguments_and_wrappers() -> None:
    envs = [
        pendulum(),
        pendulum(g=3.0),
        pendulum(max_episode_steps=7),
        gym.wrappers.TransformReward(pendulum(), times(2.0)),
        gym.wrappers.TransformReward(pendulum(), times(3.0)),
        gym.wrappers.RescaleAction(pendulum(), -1.0, 1.0),
        gym.wrappers.RescaleAction(pendulum(), -1.0, 0.5),
    ]
    texts = {json.dumps(identity(env)) for env in envs}
    assert len(texts) == len(envs)


def test_environment_is_the_same_after_use_and_whoever_looks_on() -> None:
    env = pendulum()
    before = identity(env)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert identity(Monitor(env)) == before


def test_data_among_the_globals_count(monkeypatch: pytest.MonkeyPatch) -> None:
    before = identity(of_global)
    monkeypatch.setattr(sys.modules[__name__], "GAIN", 2.0)
    assert identity(of_global) != before


def test_default_values_count() -> None:
    before = identity(with_default)
    try:
        with_default.__defaults__ = (2.0,)
        assert identity(with_default) != before
    finally:
        with_default.__defaults__ = (1.0,)


def test_what_holds_itself_comes_to_an_end() -> None:
    endless = Towards(None)
    endless.goal = [endless]
    assert "itself" in json.dumps(identity(endless))


def test_other_processes_say_the_same() -> None:
    code = (
        "import json; from tests.data.test_identity import ALIKE, identity; "
        "print(json.dumps({name: identity(make()) for name, make in ALIKE.items()}))"
    )
    there = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
        env={"PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1"},
    )
    here = {name: identity(make()) for name, make in ALIKE.items()}
    assert json.loads(there.stdout.splitlines()[-1]) == json.loads(json.dumps(here))
