"""The example of a robot that is no simulator: what it learns from, how it ends, and that its log can be replayed."""

from __future__ import annotations

import json
import math
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from examples import real_robot, robot_log
from examples.own_mjcf import Arm
from examples.robot_device import Device, switched_on
from examples.robot_driver import Mode, Reading, Robot, RobotLostError
from examples.robot_log import Event, Log, read, replay, tell
from famle_agent import FAMLE


class Recorded:
    """Stands for a driver: readings that were recorded, one a period."""

    def __init__(self, *readings: Reading) -> None:
        self.readings, self.sent, self.stopped = list(readings), list[Any](), False

    def connect(self) -> Reading:
        return self.readings.pop(0)

    def sense(self) -> Reading:
        return self.readings.pop(0)

    def move(self, action: Any) -> None:
        self.sent.append(action)

    def stop(self) -> None:
        self.stopped = True


def at(number: int, mode: Mode = Mode.MOVING) -> Reading:
    """Returns a reading of an arm that stands nearly still."""
    obs = np.array([0.001 * number, 0, 0, 0, 0, 0, 0.8, 0], dtype=np.float32)
    return Reading(number, 0.02 * number, mode, obs)


def live(agent: FAMLE, robot: Any, path: Path, steps: int) -> float:
    with path.open("w") as file:
        return real_robot.live(agent, robot, Log(file), steps)


def test_steps_that_are_none_are_not_learnt_from(arm_agent: FAMLE, tmp_path: Path) -> None:
    """Where the arm held still, and where the host was late."""
    robot = Recorded(at(0), at(1), at(2, Mode.HOLDING), at(3), at(6), at(7))
    live(arm_agent, robot, tmp_path / "log.jsonl", 5)
    assert [event.is_step for event, _ in read(tmp_path / "log.jsonl")] == [True, False, True, False, True]
    assert arm_agent.diagnose().steps == 3
    assert arm_agent.health()["dropped"] == 2
    assert robot.stopped


def test_without_readings_it_plans_on_for_some_steps_then_stands_still_then_stops(
    arm_agent: FAMLE, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(real_robot, "GIVE_UP", 4)
    readings = [at(0), at(1)]
    for _ in range(10):
        readings.append(readings[-1].silence())
    robot = Recorded(*readings)
    with pytest.warns(UserWarning, match="cannot be a measurement"):
        live(arm_agent, robot, tmp_path / "log.jsonl", 11)
    moving = [bool(np.any(action)) for action in robot.sent]
    assert moving == [True, True, True, True, False, False]  # two of them planned blindly
    assert robot.stopped
    assert "No reading for 4 periods" in capsys.readouterr().out


def test_robot_is_stopped_where_something_goes_wrong(arm_agent: FAMLE, tmp_path: Path) -> None:
    broken = Reading(1, 0.02, Mode.MOVING, np.zeros(3, dtype=np.float32))
    robot = Recorded(at(0), broken)
    with pytest.raises(ValueError, match="must have shape"):
        live(arm_agent, robot, tmp_path / "log.jsonl", 5)
    assert robot.stopped


def test_robot_that_dies_is_noticed(arm_agent: FAMLE, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(real_robot, "GIVE_UP", 4)
    with closing(Robot()) as robot, switched_on(Device(robot.port)) as process:
        robot.connect()
        process.kill()
        process.wait()
        monkeypatch.setattr(robot, "connect", robot.sense)
        with pytest.warns(UserWarning, match="cannot be a measurement"), pytest.raises(RobotLostError, match="stop"):
            live(arm_agent, robot, tmp_path / "log.jsonl", 50)


def test_example_runs_and_its_replay_believes_the_same(
    arm_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real_robot.main(agent=arm_file, seconds=1.0, out=tmp_path)
    out = capsys.readouterr().out
    assert "adapting: mean reward" in out
    assert "frozen: mean reward" in out
    assert "on the robot 50 times of 50." in out
    events = [event for event, _ in read(tmp_path / "adapting.jsonl")]
    assert sum(event.is_step for event in events) > 0
    for event, following in pairwise(events):
        np.testing.assert_array_equal(event.next_obs, following.obs)


# --- the log ----------------------------------------------------------------------------------------------------------


def event_of(obs: list[float]) -> Event:
    return Event(0.5, math.nan, np.float32(obs), np.float32([0.1, -2.0, 1 / 3]), np.float32(obs), True)


def test_events_are_read_as_they_were_written(tmp_path: Path) -> None:
    event, path = event_of([math.nan, 1 / 3, 1e-30, 0, 0, 0, 0, 0]), tmp_path / "log.jsonl"
    with path.open("w") as file:
        Log(file).write(event, "joint 0 dead")
    json.loads(path.read_text(), parse_constant=pytest.fail)  # JSON as everybody reads it
    [(again, situation)] = read(path)
    assert situation == "joint 0 dead"
    np.testing.assert_equal(vars(again), vars(event))
    assert again.obs.dtype == np.float32


def test_line_that_a_crash_cut_off_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    with path.open("w") as file:
        Log(file).write(event_of([0.0] * 8), "intact")
        file.write('{"time": 0.5, "clo')
    assert len(list(read(path))) == 1


@pytest.mark.parametrize("line", ["hello", "{}", "[1]", '{"situation": "intact", "time": 1.0}'])
def test_line_that_is_no_event_is_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(ValueError, match=r"Line 1 of .* is no event"):
        list(read(path))


def test_replay_counts_where_it_believes_the_same(arm_file: Path, arm_agent: FAMLE, tmp_path: Path) -> None:
    path, event = tmp_path / "log.jsonl", event_of([0.0] * 6 + [0.8, 0.0])
    tell(arm_agent, event)
    with path.open("w") as file:
        Log(file).write(event, arm_agent.diagnose().situation)
        Log(file).write(event, "what it cannot believe")
    assert replay(FAMLE.load(arm_file, reward_fn=Arm.reward_fn), path) == 1


def test_log_names_the_agent_that_it_belongs_to(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"lost\.zip"):
        robot_log.main(tmp_path / "lost.jsonl")
