"""The robot of an example and its driver: what both do when the other is silent, late or talks nonsense."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from subprocess import Popen
from typing import Any

import numpy as np
import pytest

from examples.robot_device import Device, switched_on
from examples.robot_driver import HOST, PERIOD, READING, Mode, Reading, Robot, RobotLostError

FORWARD = np.array([1.0, 0.0, 0.0], dtype=np.float32)


@pytest.fixture
def robot() -> Iterator[Robot]:
    with closing(Robot()) as robot:
        yield robot


@pytest.fixture
def switch_on(robot: Robot) -> Iterator[Callable[..., Popen[bytes]]]:
    """Switches on a device that loses nothing, unless it is told to."""
    with ExitStack() as stack:

        def switch_on(**settings: Any) -> Popen[bytes]:
            process = stack.enter_context(switched_on(Device(robot.port, **{"lost": 0.0, **settings})))
            robot.connect()
            return process

        yield switch_on


def drive(robot: Robot, until: Callable[[Reading], bool], timeout: float = 10.0) -> Reading:
    """Commands the arm forward until a reading says what is waited for."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        robot.move(FORWARD)
        if until(reading := robot.sense()):
            return reading
    pytest.fail("What was waited for did not come.")


def wait(robot: Robot, until: Callable[[Reading], bool], timeout: float = 10.0) -> Reading:
    """Reads without a command until a reading says what is waited for."""
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        if until(reading := robot.sense()):
            return reading
    pytest.fail("What was waited for did not come.")


def test_device_does_what_it_is_told(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on()
    reading = drive(robot, lambda reading: reading.obs[0] > 0.2)
    assert reading.mode is Mode.MOVING


def test_motor_breaks_in_mid_run(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on(gain=(-1.0, 1.0, 1.0), breaks_at=1.5)
    drive(robot, lambda reading: reading.clock < 1.5 and reading.obs[3] > 0.5)
    assert drive(robot, lambda reading: reading.obs[3] < -0.5).clock > 1.5


def test_watchdog_holds_the_arm_where_no_command_comes_until_one_comes(
    robot: Robot, switch_on: Callable[..., Any]
) -> None:
    switch_on()
    drive(robot, lambda reading: reading.obs[3] > 0.5)
    wait(robot, lambda reading: reading.mode is Mode.HOLDING)
    wait(robot, lambda reading: abs(reading.obs[3]) < 0.05)  # NaN, where a reading is late, is not below it
    drive(robot, lambda reading: reading.mode is Mode.MOVING)


def test_stop_is_for_good_though_orders_get_lost(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on(lost=0.3)
    drive(robot, lambda reading: reading.obs[3] > 0.5)
    robot.stop(timeout=10.0)
    for _ in range(5):
        robot.move(FORWARD)
        assert robot.sense().mode is Mode.STOPPED


def test_driver_counts_on_while_no_reading_comes(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on(silent=(0.3, 0.6))
    silence = drive(robot, lambda reading: bool(np.isnan(reading.obs).all()))
    heard = drive(robot, lambda reading: reading.clock >= 0.6)
    assert heard.number > silence.number
    assert np.isfinite(heard.obs).all()


def test_driver_takes_the_newest_reading_where_the_host_was_late(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on()
    before = wait(robot, lambda reading: bool(np.isfinite(reading.obs).all()))
    time.sleep(10 * PERIOD)
    assert robot.sense().number > before.number + 5


def test_robot_that_is_off_is_missed(robot: Robot) -> None:
    with pytest.raises(RobotLostError, match="is the robot on"):
        robot.connect(timeout=0.05)
    with pytest.raises(RobotLostError, match=r"call connect\(\) first"):
        robot.move(FORWARD)


def test_stop_that_nobody_confirms_is_an_error(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on().kill()
    with pytest.raises(RobotLostError, match="emergency stop"):
        robot.stop(timeout=0.2)


def test_what_is_no_reading_is_refused(robot: Robot) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"hello", (HOST, robot.port))
    with pytest.raises(ValueError, match=f"has {READING.size} bytes, got 5"):
        robot.connect(timeout=5.0)


def test_device_holds_still_where_it_is_told_nonsense(robot: Robot, switch_on: Callable[..., Any]) -> None:
    switch_on()
    drive(robot, lambda reading: reading.mode is Mode.MOVING)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def nonsense(reading: Reading) -> bool:
            stranger.sendto(b"hello", robot.address)
            return reading.mode is Mode.HOLDING

        wait(robot, nonsense)
