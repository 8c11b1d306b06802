"""Work in turns that has to end in time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import torch

__all__ = ["Deadline", "in_time"]


class Deadline:
    """A moment by which work in turns of about equal length should be done.

    Args:
        ms: Milliseconds from now on; below 0 it has passed.
        device: Where the work is done; what a GPU has been told is waited for.
        turn_ms: How long a turn takes, as far as that is known before one has ended; 0 where it is not.
        clock: Gives the time in s.

    Attributes:
        ms: Milliseconds that there are in all.
        turn_ms: Milliseconds of the shortest turn, as soon as one has ended.
        left_out: Turns for which there was no time.
    """

    def __init__(
        self,
        ms: float,
        device: torch.device = torch.device("cpu"),  # noqa: B008 (immutable)
        turn_ms: float = 0.0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._device, self._clock = device, clock
        self.ms, self.turn_ms, self.left_out = ms, turn_ms, 0
        self._began, self._shortest = clock(), math.inf

    def turns(self, number: int, at_least: int = 0) -> Iterator[int]:
        """Counts turns as long as another one, as long as the shortest, would end in time.

        Args:
            number: How many there are to do.
            at_least: How many begin in any case.
        """
        for i in range(number):
            began = self.spent_ms
            if i >= at_least and began + self.turn_ms > self.ms:
                self.left_out += number - i
                return
            yield i
            self._shortest = self.turn_ms = min(self._shortest, self.spent_ms - began)

    @property
    def spent_ms(self) -> float:
        """Milliseconds since it began."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return 1e3 * (self._clock() - self._began)

    @property
    def passed(self) -> bool:
        """Whether it is later than that."""
        return self.spent_ms > self.ms


def in_time(number: int, deadline: Deadline | None, at_least: int = 0) -> Iterator[int]:
    """Counts the turns that a deadline leaves time for, see :meth:`Deadline.turns`; all of them where there is none."""
    return iter(range(number)) if deadline is None else deadline.turns(number, at_least)
