"""Work in turns that has to end in time."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

__all__ = ["Deadline"]


class Deadline:
    """A moment by which work in turns of about equal length should be done.

    Args:
        ms: Milliseconds from now on.
        device: Where the work is done; what a GPU has been told is waited for.
        clock: Gives the time in s.

    Attributes:
        cut_short: Whether there was no time for another turn.
    """

    def __init__(
        self,
        ms: float,
        device: torch.device = torch.device("cpu"),  # noqa: B008 (immutable)
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._device, self._clock = device, clock
        self._end = clock() + ms / 1e3
        self._turn_began: float | None = None
        self.cut_short = False

    def leaves_time(self) -> bool:
        """Says whether a turn as long as the last one would end in time; the first one may begin in any case."""
        now, began = self._now(), self._turn_began
        self._turn_began = now
        self.cut_short = began is not None and now + (now - began) > self._end
        return not self.cut_short

    @property
    def passed(self) -> bool:
        """Whether it is later than that."""
        return self._now() > self._end

    def _now(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return self._clock()
