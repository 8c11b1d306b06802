from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.results import load
from benchmarks.sensor_faults import FAULTS, Args, BrokenSensors, main


class Counting(gym.Env[Any, Any]):
    """Observes the number of its step, twice."""

    observation_space = gym.spaces.Box(0.0, np.inf, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.clock = 0
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self.clock += 1
        return np.full(2, self.clock, np.float32), 0.0, False, False, {}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_strike_in_bursts_and_leave_the_rest_as_it_is(fault: str) -> None:
    env = BrokenSensors(Counting(), FAULTS[fault], np.random.default_rng(0))
    env.reset()
    wrong = 0
    for clock in range(1, 301):
        before, obs = env.faulty, env.step(np.zeros(1))[0]
        if env.faulty == before:
            np.testing.assert_array_equal(obs, [clock, clock])
        wrong += obs is None or not np.array_equal(obs, [clock, clock])
    assert 50 < env.faulty < 250
    assert env.faulty / 3 < wrong <= env.faulty


def test_benchmark_stores_a_row_of_each_robot_and_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(Args(robots=("ant",), faults=("no message", "late"), steps=40, out=tmp_path))
    table = load(tmp_path / "sensor-faults.csv").set_index("fault")
    assert list(table.index) == ["late", "no message"]
    assert (table[["invalid_actions", "non_finite_beliefs"]] == 0).all(axis=None)
    assert table["faulty_steps"]["late"] == table["faulty_steps"]["no message"] > 0
    assert table["quarantined"]["late"] == 0 < table["quarantined"]["no message"]
    assert "non_finite_beliefs" in capsys.readouterr().out


def test_unknown_fault_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no broken\. Known: NaN"):
        Args(faults=("broken",))
