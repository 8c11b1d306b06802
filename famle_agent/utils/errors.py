"""Exceptions that are not a wrong type or value."""

__all__ = ["NotLearnedError"]


class NotLearnedError(RuntimeError):
    """The agent has no model yet."""
