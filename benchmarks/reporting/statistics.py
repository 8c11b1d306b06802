"""What is said of a group of replicates, and of one group beside another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

__all__ = [
    "FEWEST",
    "Array",
    "first_crossing",
    "interquartile_mean",
    "median_steps",
    "p_value",
    "probability_of_improvement",
    "quartiles",
    "solved_at",
]

Array = npt.NDArray[np.float64]

Interval = tuple[float, float] | None
"""A 95 % interval; None where there are too few replicates for one."""

_RESAMPLES = 2000
FEWEST = 5
"""Replicates that an interval needs: of fewer, the bootstrap's is far too narrow."""


def solved_at(returns: Sequence[float], lengths: Sequence[int], threshold: float) -> int | None:
    """Robot steps at the end of the first episode from which three in a row are above the threshold."""
    above = np.asarray(returns) > threshold
    for i in range(len(above) - 2):
        if above[i : i + 3].all():
            return int(np.sum(lengths[: i + 1]))
    return None


def first_crossing(returns: Sequence[float], lengths: Sequence[int], threshold: float) -> int | None:
    """Robot steps at the end of the first episode above the threshold."""
    above = np.flatnonzero(np.asarray(returns) > threshold)
    return int(np.sum(lengths[: above[0] + 1])) if len(above) else None


def median_steps(steps: Sequence[int | None]) -> float:
    """The median of robot steps; a replicate that never got there, None, counts as infinite."""
    return float(np.median([np.inf if step is None else step for step in steps]))


def quartiles(values: Any) -> Array:
    """The 25th, 50th and 75th percentile over the first axis."""
    return np.percentile(np.asarray(values, dtype=np.float64), [25, 50, 75], axis=0)


def interquartile_mean(values: Sequence[float] | Array) -> tuple[float, Interval]:
    """The mean of the middle half and its bootstrap interval, which fewer than five replicates do not have."""
    data = np.asarray(values, dtype=np.float64)
    mean = float(stats.trim_mean(data, 0.25))
    if len(data) < FEWEST:
        return mean, None
    if np.ptp(data) == 0.0:
        return mean, (mean, mean)
    interval = stats.bootstrap(
        (data,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        n_resamples=_RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return mean, (float(interval.low), float(interval.high))


def p_value(x: Sequence[float] | Array, y: Sequence[float] | Array, paired: bool = False) -> float:
    """Two-sided p of the hypothesis that neither group is better: Wilcoxon's where paired, else Mann and Whitney's.

    Arguments as for :func:`probability_of_improvement`. One replicate, or none that differs, says nothing: 1.
    """
    one, other = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if paired:
        return float(stats.wilcoxon(one, other).pvalue) if (one != other).any() else 1.0
    if np.ptp(np.concatenate([one, other])) == 0.0:
        return 1.0
    return float(stats.mannwhitneyu(one, other).pvalue)


def probability_of_improvement(
    x: Sequence[float] | Array, y: Sequence[float] | Array, paired: bool = False
) -> tuple[float, Interval]:
    """P(X > Y), a tie counted half, and its bootstrap interval, which fewer than five replicates do not have.

    Where all comparisons go the same way, resampling finds no spread; the interval is then Clopper and Pearson's, of as
    many trials as the smaller group has replicates.

    Args:
        x: A figure of each replicate of one group, (n,).
        y: The same figure of the other group's, (m,).
        paired: Whether x_i is compared with y_i alone (n = m), and pairs are resampled. Else every x_i is compared with
            every y_j, and each group is resampled for itself.

    Raises:
        ValueError: A group is empty.
    """
    groups = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not all(len(group) for group in groups):
        raise ValueError("Both groups need a replicate to be compared.")
    wins = _pairs_won if paired else _wins
    p = float(wins(*groups))
    if (n := min(len(group) for group in groups)) < FEWEST:
        return p, None
    if p in (0.0, 1.0):
        exact = stats.binomtest(round(p * n), n).proportion_ci(0.95)
        return p, (float(exact.low), float(exact.high))
    interval = stats.bootstrap(
        groups, wins, paired=paired, n_resamples=_RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return p, (float(interval.low), float(interval.high))


def _pairs_won(x: Array, y: Array, axis: int = -1) -> Any:
    return (0.5 + 0.5 * np.sign(x - y)).mean(axis=axis)


def _wins(x: Array, y: Array, axis: int = -1) -> Any:
    """The Mann-Whitney statistic as a fraction of all pairs; no p-value is wanted, hence the cheapest method."""
    with np.errstate(all="ignore"):  # where all values are tied there is no p-value
        statistic = stats.mannwhitneyu(x, y, axis=axis, method="asymptotic").statistic
    return statistic / (x.shape[axis] * y.shape[axis])
