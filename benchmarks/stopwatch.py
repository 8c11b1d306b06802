"""Timings of the processor that can be compared, and how they grow."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

__all__ = ["growth_of", "machine", "medians", "repeat"]


def medians(repeats: int, *calls: Callable[[], object], warm_up: int = 2) -> list[float]:
    """Returns the median milliseconds of calls that take turns; the first turns only warm up."""
    seconds = np.zeros((max(1, repeats) + warm_up, len(calls)))
    for turn in range(len(seconds)):
        for i, call in enumerate(calls):
            start = time.process_time()
            call()
            seconds[turn, i] = time.process_time() - start
    return [float(median) for median in 1e3 * np.median(seconds[warm_up:], axis=0)]


def growth_of(sizes: Sequence[int], milliseconds: Sequence[float]) -> float:
    """Fits the slope of the logarithms; NaN of a single size."""
    return float(np.polyfit(np.log(sizes), np.log(milliseconds), 1)[0]) if len(sizes) > 1 else float("nan")


def repeat(times: int, call: Callable[[], object]) -> None:
    """Calls something again and again."""
    for _ in range(times):
        call()


def machine() -> str:
    """Names the processor and how many of its cores there are."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return f"{names[0] if names else platform.processor() or platform.machine()}, {os.cpu_count()} cores"
