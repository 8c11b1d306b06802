from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from benchmarks import gym_robots
from benchmarks.gym_robots import BEDS, METHODS, Args, Bed, Env, Hanging, faulty, main, summary
from benchmarks.model_free import MODEL_FREE
from benchmarks.results import load
from famle_agent.training.policy_search import PolicySearch

STEPS = 5
ROOT = Path(__file__).parents[2]


def small_bed() -> Bed:
    train = {name: partial(faulty, "Pendulum-v1", name, STEPS) for name in ("intact", "motor 0 reversed")}
    return Bed(train, {"motor 0 dead": partial(faulty, "Pendulum-v1", "motor 0 dead", STEPS)})


@pytest.mark.usefixtures("tiny_budgets")
def test_every_method_lives_on_each_unseen_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gym_robots, "BEDS", {"small": small_bed})
    args = Args(beds=("small",), seeds=1, lives=2, jobs=1, out=tmp_path / "out", cache=tmp_path / "cache")
    main(args)
    results = load(tmp_path / "out" / "gym-small.csv")
    assert set(results["method"]) == set(METHODS)
    for row in results.to_dict("records"):
        assert set(row["returns"]) == {"motor 0 dead"}
        assert row["steps"] == {"motor 0 dead": [STEPS, STEPS]}
        first, second = row["returns"]["motor 0 dead"]
        assert np.isfinite([first, second]).all()
        assert first != second
    assert {path.name for path in (tmp_path / "cache").glob("*.zip")} == {
        f"gym-small-{kind}-0.zip" for kind in ("FAMLE", "AMPC", "AMPCMAML")
    }
    shown = capsys.readouterr().out
    assert all(method in shown for method in METHODS)
    main(args)  # which has nothing left to do


def test_what_is_unknown_is_refused() -> None:
    with pytest.raises(ValueError, match=r"There is no dog\. Known: halfcheetah"):
        Args(beds=("dog",))
    with pytest.raises(ValueError, match=r"There is no famle-forzen\. Known: famle, famle-frozen"):
        Args(methods=("famle-forzen",))


def test_summary_is_over_meta_trainings_robots_and_lives() -> None:
    returns = [{"a": [1.0, 2.0], "b": [9.0, 4.0]}, {"a": [3.0, 3.0], "b": [8.0, 5.0]}]
    found = summary(pd.DataFrame({"method": ["famle", "famle"], "returns": returns})).loc["famle"]
    assert found.to_dict() == {"lives": 8, "median": 3.5, "min": 1.0, "max": 9.0, "a": 2.5, "b": 6.5}


def test_manual_quotes_the_stored_results() -> None:
    table = (ROOT / "docs" / "results.md").read_text().partition("## Robots that nobody tuned")[2].partition("\n##")[0]
    stored = sorted((ROOT / "benchmarks" / "results").glob("gym-*.csv"))
    assert stored
    for path in stored:
        found = summary(load(path))
        for method in ("famle", "famle-frozen", "famle-actor"):
            median, low, high = (f"{value:,.0f}" for value in found.loc[method, ["median", "min", "max"]])
            assert (median if low == high else f"{median} ({low} to {high})") in table, (path.name, method)


def test_time_of_learning_is_not_said_of_what_is_in_the_cache(tmp_path: Path) -> None:
    (tmp_path / "gym-small-FAMLE-0.zip").touch()
    assert gym_robots.is_learnt("famle-frozen", "small", 0, tmp_path, ())
    assert not gym_robots.is_learnt("famle", "small", 1, tmp_path, ())
    assert not gym_robots.is_learnt("famle", "small", 0, tmp_path, ("policy_steps=9",))
    assert not gym_robots.is_learnt("sac", "small", 0, tmp_path, ())


@pytest.mark.parametrize(
    ("name", "budget", "robots"),
    [("sac", 1, 2), ("sac-10x", 10, 2), ("sac-intact", 1, 1), ("ppo", 1, 2), ("ppo-10x", 10, 2), ("ppo-intact", 1, 1)],
)
def test_agents_without_a_model_get_the_robots_and_steps_that_their_names_say(
    name: str, budget: int, robots: int
) -> None:
    taken = dict.fromkeys(small_bed().train, 0)

    def counted(situation: str) -> Env:
        class Counted(gym.Wrapper[Any, Any, Any, Any]):
            def step(self, action: Any) -> Any:
                taken[situation] += 1
                return super().step(action)

        return Counted(small_bed().train[situation]())

    train = {situation: partial(counted, situation) for situation in taken}
    settings = PolicySearch(steps=30, random_steps=4, hidden=(8,), batch_size=4)
    policy = MODEL_FREE[name].learn(train, settings, seed=0)
    steps = list(taken.values())
    assert all(n > 0 for n in steps[:robots])
    assert not any(steps[robots:])
    rollout = 2048 if name.startswith("ppo") else 50  # which it ends where it has begun one
    assert budget * 30 <= sum(steps) <= budget * 30 + rollout
    assert small_bed().test["motor 0 dead"]().action_space.contains(policy(np.zeros(3)))


@pytest.mark.parametrize("name", BEDS)
def test_robots_of_a_bed_are_alike_and_unseen_faults_are_no_training_ones(name: str) -> None:
    bed = BEDS[name]()
    assert next(iter(bed.train)) == "intact"
    assert bed.train.keys() & bed.test.keys() <= {"intact"}
    spaces = set()
    for make in (*bed.train.values(), *bed.test.values()):
        env = make()
        spaces.add((env.observation_space.shape, env.action_space.shape))
        env.close()
    assert len(spaces) == 1


def test_pendulum_hangs_at_first() -> None:
    env = Hanging(1.3, 0.6)
    obs, _ = env.reset(seed=3)
    np.testing.assert_allclose(obs, [-1.0, 0.0, 0.0], atol=1e-6)
    after, *_ = env.step(np.zeros(1, np.float32))
    np.testing.assert_allclose(after, obs, atol=1e-3)  # it stays there


def test_rivals_get_as_many_steps_as_a_changed_agent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    taken: list[int] = []

    class Counting:
        def learn(self, train: Any, settings: PolicySearch, seed: int) -> Any:
            taken.append(settings.steps)
            return lambda obs: obs

    monkeypatch.setattr(gym_robots, "BEDS", {"small": small_bed})
    monkeypatch.setattr(gym_robots, "MODEL_FREE", {"sac": Counting()})
    gym_robots.actor_of("sac", "small", 0, tmp_path, ("policy_steps=700",))
    gym_robots.actor_of("sac", "small", 0, tmp_path, ())
    assert taken == [700, 500_000]  # what it says, and the default of all robots
