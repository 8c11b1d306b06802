from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from benchmarks import gym_robots
from benchmarks.gym_robots import BEDS, METHODS, Args, Bed, Hanging, faulty, main
from benchmarks.results import load

STEPS = 5


def small_bed() -> Bed:
    train = {name: partial(faulty, "Pendulum-v1", name, STEPS) for name in ("intact", "motor 0 reversed")}
    return Bed(train, {"motor 0 dead": partial(faulty, "Pendulum-v1", "motor 0 dead", STEPS)})


@pytest.mark.usefixtures("tiny_budgets")
def test_every_method_lives_one_episode_on_each_unseen_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(gym_robots, "BEDS", {"small": small_bed})
    args = Args(beds=("small",), seeds=1, jobs=1, out=tmp_path / "out", cache=tmp_path / "cache")
    main(args)
    results = load(tmp_path / "out" / "gym-small.csv")
    assert set(results["method"]) == set(METHODS)
    for row in results.to_dict("records"):
        assert set(row["returns"]) == {"motor 0 dead"}
        assert row["steps"] == {"motor 0 dead": STEPS}
        assert np.isfinite(row["returns"]["motor 0 dead"])
    assert {path.name for path in (tmp_path / "cache").iterdir()} == {
        f"gym-small-{kind}-0.zip" for kind in ("FAMLE", "AMPC", "AMPCMAML")
    }
    shown = capsys.readouterr().out
    assert all(method in shown for method in METHODS)
    main(args)  # which has nothing left to do


@pytest.mark.parametrize("name", BEDS)
def test_robots_of_a_bed_are_alike_and_unseen_ones_are_no_training_ones(name: str) -> None:
    bed = BEDS[name]()
    assert next(iter(bed.train)) == "intact"
    assert not bed.train.keys() & bed.test.keys()
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
