"""Borrowing the global random numbers of NumPy and torch, for code that draws from no others."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

__all__ = ["GlobalChance", "alone"]

_LOCK = threading.RLock()


@contextmanager
def alone() -> Iterator[None]:
    """Keeps other threads of this package from the global generators."""
    with _LOCK:
        yield


class GlobalChance:
    """A stream of random numbers that stands in for the global generators while it is entered.

    What is drawn depends on the seed alone: not on who has drawn before, nor on agents in other threads, who wait. The
    global generators are left as they were found.

    Args:
        seed: Of both generators.
    """

    def __init__(self, seed: int) -> None:
        self._numpy = np.random.RandomState(seed % 2**32).get_state()
        self._torch = torch.Generator().manual_seed(seed).get_state()

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Takes the place of the global generators, and goes on from where it was left."""
        with _LOCK:
            outside = np.random.get_state(), torch.get_rng_state()
            np.random.set_state(self._numpy)
            torch.set_rng_state(self._torch)
            try:
                yield
            finally:
                self._numpy, self._torch = np.random.get_state(), torch.get_rng_state()
                np.random.set_state(outside[0])
                torch.set_rng_state(outside[1])
