"""Work on the side that may take only so much of the time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["Allowance"]


class Allowance:
    """Lets work on the side take a share of all time, by being done as rarely as that takes.

    Args:
        share: Of the time since this was made, above 0.
        clock: Gives the time in s.

    Attributes:
        spent: Seconds that the work has taken.
    """

    def __init__(self, share: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self.spent = 0.0
        self._share, self._clock, self._began = share, clock, clock()

    def is_left(self) -> bool:
        """Says whether the work that was done has taken no more than its share yet."""
        return self.spent <= self._share * (self._clock() - self._began)

    @contextmanager
    def spending(self) -> Iterator[None]:
        """Counts the time of what is done within."""
        start = self._clock()
        try:
            yield
        finally:
            self.spent += self._clock() - start
