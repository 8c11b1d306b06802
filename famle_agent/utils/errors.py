"""Exceptions of the package, and what is said of those of foreign code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["NotLearnedError", "SensorError", "add_note", "in_situation"]


class NotLearnedError(RuntimeError):
    """The agent has no model yet."""


class SensorError(ValueError):
    """No robot has a sensor that can be believed, or the model's own prediction is too old to plan from."""


def add_note(error: Exception, note: str) -> None:
    """Adds a note to an exception, as the method of that name does, which Python 3.10 has not."""
    vars(error).setdefault("__notes__", []).append(note)


@contextmanager
def in_situation(name: str) -> Iterator[None]:
    """Notes on an exception in which situation it was raised. Its type and its message stay as they are."""
    try:
        yield
    except Exception as error:
        add_note(error, f"It was raised in the situation {name!r}.")
        raise
