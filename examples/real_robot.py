"""A robot that is no simulator: 50 Hz, a watchdog, readings that get lost, a safe stop, and a log to replay.

python -m examples.own_mjcf     # meta-learns in simulation first
python -m examples.real_robot   # half a minute: two lives of eight seconds, with adaptation and without

A process of its own stands for the robot (``robot_device.py``). What you replace is ``robot_driver.py``.
"""

from __future__ import annotations

import math
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from examples import robot_log
from examples.own_mjcf import Arm
from examples.robot_device import Device, switched_on
from examples.robot_driver import PERIOD, Mode, Robot
from examples.robot_log import Event, Log, tell
from famle_agent import FAMLE

SETTINGS: dict[str, Any] = {
    "blind_steps": 5,  # without a reading, the model says for 0.1 s where the robot is
    "safe_action": (0.0, 0.0, 0.0),  # then it shall stand still
    "step_budget_ms": 15.0,  # of a plan and of the gradient steps after it, of a period of 20
}
LIVES: dict[str, dict[str, Any]] = {
    "adapting": {"adapt_every": 25, "adapt_steps": 5},  # fewer than usual, as a step that adapts takes about a period
    "frozen": {"adapt_every": 0},
}
GIVE_UP = 50  # periods without a reading until the robot is stopped
SILENT = (3.0, 3.3)  # when the wire has a loose contact (s)
GAIN, BREAKS_AT = (-1.0, 0.4, 1.0), 1.0  # motor 0 reversed and motor 1 weak, after a second


def live(agent: FAMLE, robot: Robot, log: Log, steps: int) -> float:
    """Runs an agent on a robot, and stops the robot in the end, whatever comes between.

    Args:
        agent: Plans and learns.
        robot: The driver.
        log: Where all transitions go.
        steps: How many periods.

    Returns:
        The mean reward of the steps whose end was read; NaN where there are none.

    Raises:
        RobotLostError: The robot does not begin, or does not confirm that it has stopped.
        ValueError: A reading has another form than expected.
    """
    reading, start, rewards = robot.connect(), time.monotonic(), list[float]()
    agent.begin_episode()
    agent.locate(reading.obs)
    try:
        for _ in range(steps):
            action, _ = agent.predict(reading.obs)
            robot.move(action)
            newest = robot.sense()
            is_step = newest.number == reading.number + 1 and newest.mode is Mode.MOVING
            event = Event(time.monotonic() - start, newest.clock, reading.obs, action, newest.obs, is_step)
            tell(agent, event)
            log.write(event, agent.diagnose().situation)
            if np.isfinite(newest.obs).all():
                rewards.append(float(Arm.reward_fn(reading.obs, action, newest.obs)))
            if agent.health()["blind"] > GIVE_UP:
                print(f"No reading for {GIVE_UP} periods: the robot is stopped.")
                break
            reading = newest
    finally:
        robot.stop()
    return float(np.mean(rewards)) if rewards else math.nan


def main(
    agent: Path = Path("runs/own_mjcf/arm.zip"),
    seconds: float = 8.0,
    seed: int = 0,
    out: Path = Path("runs/real_robot"),
) -> None:
    """Lives on a robot that breaks, with adaptation and without, and replays what happened.

    Args:
        agent: The meta-learned agent, which ``python -m examples.own_mjcf`` writes.
        seconds: How long each of the two lives lasts.
        seed: Of what the wire loses.
        out: Folder of the logs, and of the agents as they were before.
    """
    for name, changed in LIVES.items():
        mind = FAMLE.load(agent, reward_fn=Arm.reward_fn, **SETTINGS, **changed)  # knows no simulator
        mind.save(out / f"{name}.zip")  # as it begins, for the replay
        with (
            closing(Robot()) as robot,
            switched_on(Device(robot.port, GAIN, BREAKS_AT, SILENT, seed=seed)),
            (out / f"{name}.jsonl").open("w") as file,
        ):
            reward = live(mind, robot, Log(file), round(seconds / PERIOD))
        print(f"{name}: mean reward {reward:.2f}; {mind.diagnose()} {mind.health()}")

    print("What the adapting agent believed, and since when:")
    robot_log.main(out / "adapting.jsonl")


if __name__ == "__main__":
    tyro.cli(main)
