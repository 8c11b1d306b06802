"""Exceptions of the package."""

__all__ = ["NotLearnedError", "SensorError"]


class NotLearnedError(RuntimeError):
    """The agent has no model yet."""


class SensorError(ValueError):
    """No robot has a sensor that can be believed, or the model's own prediction is too old to plan from."""
