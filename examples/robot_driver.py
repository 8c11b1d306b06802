"""The host's side of a robot at the end of a wire: what the datagrams hold, and a Python API for them.

Replace this file by the driver of your robot.
"""

from __future__ import annotations

import enum
import math
import select
import socket
import struct
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["COMMAND", "HOST", "PERIOD", "READING", "Mode", "Order", "Reading", "Robot", "RobotLostError"]

HOST = "127.0.0.1"
PERIOD = 0.02  # from one reading to the next (s)
READING = struct.Struct("<IdB8f")  # number, the device's clock (s), mode, observation
COMMAND = struct.Struct("<B3f")  # order, action


class Mode(enum.IntEnum):
    """What the motors do."""

    HOLDING = 0
    """They stand still, since no command came for too long."""
    MOVING = 1
    """They do what the last command says."""
    STOPPED = 2
    """They stand still until the robot is switched on again."""


class Order(enum.IntEnum):
    """What a command asks for."""

    MOVE = 0
    STOP = 1


class RobotLostError(ConnectionError):
    """The robot does not answer."""


@dataclass(frozen=True)
class Reading:
    """What the robot's sensors say in one period.

    Attributes:
        number: Counts the device's periods.
        clock: The device's own time (s); NaN where nothing came.
        mode: What its motors do; where nothing came, what they did last.
        obs: (8,), float32; NaN where nothing came.
    """

    number: int
    clock: float
    mode: Mode
    obs: npt.NDArray[np.float32]

    @classmethod
    def of(cls, datagram: bytes) -> Reading:
        """Reads a datagram.

        Raises:
            ValueError: It is no reading.
        """
        if len(datagram) != READING.size:
            raise ValueError(f"A reading has {READING.size} bytes, got {len(datagram)}: check the robot's firmware.")
        number, clock, mode, *obs = READING.unpack(datagram)
        return cls(number, clock, Mode(mode), np.array(obs, dtype=np.float32))

    def silence(self) -> Reading:
        """Stands for the next reading, which did not come."""
        return Reading(self.number + 1, math.nan, self.mode, np.full_like(self.obs, np.nan))


class Robot:
    """A robot that sends a reading each period, and takes commands at any time.

    The robot's clock is the clock of the loop: :meth:`sense` waits for the next reading. Where none comes in time, it
    goes on by the host's clock.

    Attributes:
        port: Where it listens for readings.
        address: Where they come from; None until one has come.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((HOST, 0))
        self.port: int = self._socket.getsockname()[1]
        self.address: Any = None
        self._last = Reading(-1, math.nan, Mode.HOLDING, np.full(8, np.nan, dtype=np.float32))
        self._began = 0.0  # when the period of that began, by the host's clock

    def connect(self, timeout: float = 30.0) -> Reading:
        """Waits for the first reading.

        Args:
            timeout: For how long (s).

        Raises:
            RobotLostError: None came.
        """
        if not self._listen(time.monotonic() + timeout):
            raise RobotLostError(f"No reading came within {timeout:g} s: is the robot on, and does it know the port?")
        return self._last

    def sense(self) -> Reading:
        """Waits for the reading of the next period, and returns the newest; one of NaN where it is late.

        Late is half a period. A reading that comes even later is thrown away. Who takes longer than a period between
        two calls finds that numbers are missing.
        """
        if not self._listen(self._began + 1.5 * PERIOD):
            self._last = self._last.silence()
            self._began += PERIOD
        return self._last

    def move(self, action: npt.NDArray[Any]) -> None:
        """Sends a command.

        Args:
            action: Velocities (rad/s), (3,).
        """
        self._send(Order.MOVE, *action)

    def stop(self, timeout: float = 1.0) -> None:
        """Stops the robot for good, and waits until it says so: an order may get lost.

        Args:
            timeout: For how long (s).

        Raises:
            RobotLostError: It does not say so.
        """
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            self._send(Order.STOP, 0.0, 0.0, 0.0)
            if self._listen(time.monotonic() + PERIOD) and self._last.mode is Mode.STOPPED:
                return
        raise RobotLostError("The robot does not confirm that it has stopped: press the emergency stop.")

    def close(self) -> None:
        """Lets go of the port; the robot is not stopped."""
        self._socket.close()

    def _send(self, order: Order, *action: float) -> None:
        if self.address is None:
            raise RobotLostError("The robot has not been heard of yet: call connect() first.")
        self._socket.sendto(COMMAND.pack(order, *action), self.address)

    def _listen(self, deadline: float) -> bool:
        """Waits for a reading that is newer than the last one, and keeps the newest; says whether there is one."""
        heard = False
        while select.select([self._socket], [], [], 0.0 if heard else max(0.0, deadline - time.monotonic()))[0]:
            datagram, address = self._socket.recvfrom(1024)
            reading = Reading.of(datagram)
            if reading.number > self._last.number:
                heard, self._last, self.address = True, reading, address
                self._began = time.monotonic()
        return heard
