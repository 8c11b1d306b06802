"""A log of what a robot went through, one line of JSON a period, and its replay.

python -m examples.robot_log   # after real_robot: what the agent believed when
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt
import tyro

from examples.own_mjcf import Arm
from famle_agent import FAMLE

__all__ = ["Event", "Log", "read", "replay", "tell"]

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Event:
    """What happened to a robot within one period.

    Attributes:
        time: When it ended, since the robot began (s).
        clock: The same by the robot's own clock (s); NaN where nothing came.
        obs: What was read before, (8,); NaN where nothing came.
        action: What was sent, (3,).
        next_obs: What was read after it, (8,).
        is_step: Whether the robot did what was sent, for one period: it neither held still nor was the host late.
    """

    time: float
    clock: float
    obs: Array
    action: Array
    next_obs: Array
    is_step: bool

    def to_json(self) -> dict[str, Any]:
        """Returns it as JSON types, bit by bit; JSON has no NaN and no infinity, so that these are null."""
        return {name: _plain(value) for name, value in vars(self).items()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Event:
        """Makes an event of what :meth:`to_json` returned; what was null is NaN."""
        arrays = {name: np.array(values[name], dtype=np.float32) for name in ("obs", "action", "next_obs")}
        clock = math.nan if values["clock"] is None else values["clock"]
        return cls(**{**values, **arrays, "clock": clock})


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(number) for number in value.tolist()]
    return value if math.isfinite(value) else None


def tell(agent: FAMLE, event: Event) -> None:
    """Tells an agent what happened: on the robot and in a replay alike, so that it believes the same."""
    if event.is_step:
        agent.observe(event.obs, event.action, event.next_obs)
    else:
        agent.locate(event.next_obs, dropped=True)


class Log:
    """Writes line by line, so that a crash loses no more than the last one.

    Args:
        file: An open text file.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, event: Event, situation: str) -> None:
        """Adds what happened, and what the agent believes since."""
        self._file.write(json.dumps({**event.to_json(), "situation": situation}) + "\n")
        self._file.flush()


def read(path: Path) -> Iterator[tuple[Event, str]]:
    """Reads a log: what happened, and the situation that the agent believed in then.

    Raises:
        ValueError: A line is no event; a last line that a crash cut off is left out.
    """
    for number, line in enumerate(path.read_text().splitlines(keepends=True), start=1):
        if not line.endswith("\n"):
            return  # a crash cut it off
        try:
            values: dict[str, Any] = json.loads(line)
            situation = str(values.pop("situation"))
            yield Event.from_json(values), situation
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"Line {number} of {path} is no event of a robot: {error}.") from error


def replay(agent: FAMLE, path: Path) -> int:
    """Tells an agent what a log holds, and prints what it believes each time that changes.

    Returns:
        After how many events it believes what the log says that the agent on the robot did.
    """
    last, same = "", 0
    for event, situation in read(path):
        tell(agent, event)
        found = agent.diagnose()
        same += found.situation == situation
        if found.situation != last:
            print(f"{event.time:6.2f} s  {found}")
        last = found.situation
    return same


def main(log: Path = Path("runs/real_robot/adapting.jsonl")) -> None:
    """Replays a log into the agent that it belongs to, as that was before.

    Args:
        log: The log; the agent is beside it.
    """
    same = replay(FAMLE.load(log.with_suffix(".zip"), reward_fn=Arm.reward_fn), log)
    print(f"The replay believes what the agent believed on the robot {same} times of {len(list(read(log)))}.")


if __name__ == "__main__":
    tyro.cli(main)
