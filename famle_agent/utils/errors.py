"""Exceptions of the package, and what is said of those of foreign code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["NotLearnedError", "SensorError", "in_situation"]


class NotLearnedError(RuntimeError):
    """The agent has no model yet."""


class SensorError(ValueError):
    """No robot has a sensor that can be believed, or the model's own prediction is too old to plan from."""


@contextmanager
def in_situation(name: str) -> Iterator[None]:
    """Notes on an exception in which situation it was raised. Its type and its message stay as they are."""
    try:
        yield
    except Exception as error:
        # As its method add_note does, which Python 3.10 has not.
        vars(error).setdefault("__notes__", []).append(f"It was raised in the situation {name!r}.")
        raise
