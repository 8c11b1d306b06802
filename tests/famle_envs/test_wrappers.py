from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

from famle_envs import Situation
from famle_envs.wrappers import RandomSituation

MakeEnv = Callable[..., gym.Env[Any, Any]]


def drawn(env: RandomSituation, n: int, seed: int) -> list[str]:
    return [env.reset(seed=seed if i == 0 else None)[1]["situation"] for i in range(n)]


def test_all_training_situations_come(make_env: MakeEnv) -> None:
    env = RandomSituation(make_env())
    counts = Counter(drawn(env, 220, seed=0))
    assert set(counts) == {situation.name for situation in env.unwrapped.training_situations}
    assert max(counts.values()) < 50


def test_situations_follow_the_seed(make_env: MakeEnv) -> None:
    env = RandomSituation(make_env())
    first = drawn(env, 10, seed=3)
    assert drawn(env, 10, seed=3) == first
    assert drawn(env, 10, seed=4) != first


def test_situations_may_be_given_and_overridden(make_env: MakeEnv) -> None:
    env = RandomSituation(make_env(), ["joint 1 dead", Situation(locked_joints=(2,))])
    assert set(drawn(env, 20, seed=0)) == {"joint 1 dead", "joint 2 locked"}
    _, info = env.reset(options={"situation": "joint 0 dead"})
    assert info["situation"] == "joint 0 dead"


def test_it_needs_something_to_draw_from(make_env: MakeEnv) -> None:
    with pytest.raises(ValueError, match="at least one"):
        RandomSituation(make_env(), [])
    with pytest.raises(ValueError, match="takes no situation"):
        RandomSituation(make_env("Pendulum-v1"))
