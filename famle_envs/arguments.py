"""Checks of what users give to the robots' constructors."""

from __future__ import annotations

from numbers import Real
from typing import Any

import numpy as np

__all__ = ["finite_point", "number_within"]


def finite_point(name: str, value: Any) -> tuple[float, float]:
    """A point on the floor.

    Raises:
        ValueError: It is not two finite numbers.
    """
    try:
        point = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        point = np.empty(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ValueError(f"{name} must be two finite numbers, x and y in m, got {value!r}.")
    return float(point[0]), float(point[1])


def number_within(name: str, value: Any, low: float, high: float, unit: str) -> float:
    """A number from ``low`` to ``high``.

    Raises:
        ValueError: It is none.
    """
    number = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(number, (bool, np.bool_)) or not isinstance(number, Real) or not low <= float(number) <= high:
        raise ValueError(f"{name} must be a number between {low:g} and {high:g} {unit}, got {value!r}.")
    return float(number)
