"""A robot at the other end of a wire, simulated in a process of its own: its clock, its watchdog, and what goes wrong.

python -m examples.robot_device --port 5005   # sends its readings to that port of this machine

A real robot's firmware has to do what this one does: hold still when no command comes, and stop for good when told so.
"""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import tyro

from examples.robot_driver import COMMAND, HOST, PERIOD, READING, Mode, Order

WATCHDOG = 0.1  # without a command until the motors hold still (s)
ALONE = 10.0  # without a command until the process ends, so that none is left behind (s)


@dataclass(frozen=True)
class Device:
    """What is particular about one robot and its wire."""

    port: int
    """Where the host listens."""
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """What becomes of each motor's command, once it breaks."""
    breaks_at: float = 0.0
    """When it does (s)."""
    silent: tuple[float, float] = (0.0, 0.0)
    """From when to when no reading gets through (s)."""
    lost: float = 0.02
    """Probability that a datagram gets lost, either way."""
    latency: tuple[float, float] = (0.002, 0.006)
    """How long a reading takes, at least and at most (s)."""
    drift: float = 0.002
    """By how much its clock is faster than the host's."""
    seed: int = 0
    """Of what gets lost and late."""

    def run(self) -> None:
        """Lives until no host has spoken for some time."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.bind((HOST, 0))
            SimulatedArm(self, wire).run()


class SimulatedArm:
    """The arm of ``arm.xml`` and its firmware, in steps of the simulation.

    Args:
        device: What is particular about it.
        wire: A bound socket.
    """

    def __init__(self, device: Device, wire: socket.socket) -> None:
        self.device, self.wire, self.rng = device, wire, np.random.default_rng(device.seed)
        self.model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("arm.xml")))
        self.data = mujoco.MjData(self.model)
        self.per_reading = round(PERIOD / self.model.opt.timestep)
        self.mode, self.command, self.heard_at, self.steps = Mode.HOLDING, np.zeros(3), 0.0, 0
        self.on_the_wire: deque[tuple[float, bytes]] = deque()  # when each reading gets there

    @property
    def clock(self) -> float:
        """The device's time (s)."""
        return self.steps * float(self.model.opt.timestep)

    def run(self) -> None:
        """Keeps pace with the device's clock."""
        mujoco.mj_forward(self.model, self.data)
        start = time.monotonic()
        while self.clock - self.heard_at < ALONE:
            self.listen()
            self.report()
            self.move()
            time.sleep(max(0.0, start + self.clock / (1.0 + self.device.drift) - time.monotonic()))

    def listen(self) -> None:
        """Takes the commands that have come, and holds still where none has come for too long."""
        while select.select([self.wire], [], [], 0.0)[0]:
            datagram = self.wire.recv(1024)
            if len(datagram) != COMMAND.size or self._gets_lost():
                continue  # no command; should more be missing, the watchdog sees to it
            order, *action = COMMAND.unpack(datagram)
            self.heard_at = self.clock
            if order == Order.STOP:
                self.mode = Mode.STOPPED
            elif self.mode is not Mode.STOPPED:
                self.mode, self.command = Mode.MOVING, np.array(action)
        if self.mode is Mode.MOVING and self.clock - self.heard_at > WATCHDOG:
            self.mode = Mode.HOLDING

    def report(self) -> None:
        """Takes a reading each period, and sends those whose time has come."""
        begins, ends = self.device.silent
        if self.steps % self.per_reading == 0 and not (self._gets_lost() or begins <= self.clock < ends):
            obs = (*self.data.qpos, *self.data.qvel, *self.data.site("tip").xpos[:2])
            reading = READING.pack(self.steps // self.per_reading, self.clock, self.mode, *obs)
            self.on_the_wire.append((self.clock + self.rng.uniform(*self.device.latency), reading))
        while self.on_the_wire and self.on_the_wire[0][0] <= self.clock:
            self.wire.sendto(self.on_the_wire.popleft()[1], (HOST, self.device.port))

    def move(self) -> None:
        """Moves for one step of the simulation."""
        gain = self.device.gain if self.clock >= self.device.breaks_at else 1.0
        self.data.ctrl[:] = gain * self.command if self.mode is Mode.MOVING else 0.0
        mujoco.mj_step(self.model, self.data)
        self.steps += 1

    def _gets_lost(self) -> bool:
        return bool(self.rng.random() < self.device.lost)


@contextmanager
def switched_on(device: Device) -> Iterator[subprocess.Popen[bytes]]:
    """Runs a device in a process of its own, and ends that."""
    flags = []
    for name, value in vars(device).items():
        flags += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else (value,))]
    command = [sys.executable, "-m", "examples.robot_device", *flags]
    with subprocess.Popen(command, cwd=Path(__file__).parents[1]) as process:
        try:
            yield process
        finally:
            process.terminate()


if __name__ == "__main__":
    tyro.cli(Device).run()
