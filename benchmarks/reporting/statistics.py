"""Statistics of a group of replicates, and of one group beside another."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

Array = npt.NDArray[np.float64]
Estimate = tuple[float, float, float]
"""A figure and its 95 % interval, which is NaN where there are too few replicates for one."""

_RESAMPLES = 2000
FEWEST = 5
"""Replicates that an interval needs: of fewer, the bootstrap's is far too narrow."""


def solved_at(returns: Any, lengths: Any, threshold: float) -> float:
    """Counts the robot steps until the first episode ends from which three in a row are above the threshold.

    Returns:
        Infinity where there are no three.
    """
    above = np.asarray(returns) > threshold
    three = np.flatnonzero(above[:-2] & above[1:-1] & above[2:])
    return float(np.sum(lengths[: three[0] + 1])) if len(three) else np.inf


def first_crossing(returns: Any, lengths: Any, threshold: float) -> float:
    """Counts the robot steps until the first episode above the threshold ends; infinity where there is none."""
    above = np.flatnonzero(np.asarray(returns) > threshold)
    return float(np.sum(lengths[: above[0] + 1])) if len(above) else np.inf


def interquartile_mean(values: Any) -> Estimate:
    """Computes the mean of the middle half and its bootstrap interval."""
    data = np.asarray(values, dtype=np.float64)
    mean = float(stats.trim_mean(data, 0.25))
    if len(data) < FEWEST:
        return mean, np.nan, np.nan
    if np.ptp(data) == 0.0:
        return mean, mean, mean
    return mean, *_bootstrap((data,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis))


def p_value(x: Any, y: Any, paired: bool = False) -> float:
    """Tests the hypothesis that neither group is better: two-sided, by Wilcoxon where paired, else by Mann and Whitney.

    Arguments as for :func:`probability_of_improvement`. One replicate, or none that differs, says nothing: 1.
    """
    one, other = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if paired:
        return float(stats.wilcoxon(one, other).pvalue) if (one != other).any() else 1.0
    if np.ptp(np.concatenate([one, other])) == 0.0:
        return 1.0
    return float(stats.mannwhitneyu(one, other).pvalue)


def probability_of_improvement(x: Any, y: Any, paired: bool = False) -> Estimate:
    """Computes P(X > Y), a tie counted half, and its bootstrap interval.

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
    fewest = min(len(group) for group in groups)
    if not fewest:
        raise ValueError("Both groups need a replicate to be compared.")
    wins = _pairs_won if paired else _wins
    p = float(wins(*groups))
    if fewest < FEWEST:
        return p, np.nan, np.nan
    if p in (0.0, 1.0):
        exact = stats.binomtest(round(p * fewest), fewest).proportion_ci(0.95)
        return p, float(exact.low), float(exact.high)
    return p, *_bootstrap(groups, wins, paired=paired)


def gap_closed(scores: Any, frozen: Any, oracle: Any) -> Estimate:
    """Computes which part of the way from agents that do not adapt to an oracle a group goes, and its interval.

    It is (scores - frozen) / (oracle - frozen) of interquartile means; replicates are resampled together.

    Args:
        scores: A figure of each replicate of a group, (n,).
        frozen: The same figure of the same replicates without adaptation, (n,).
        oracle: The same figure of the oracle, (n,).

    Raises:
        ValueError: There is no replicate.
    """
    ours, low, high = (np.asarray(group, dtype=np.float64) for group in (scores, frozen, oracle))
    if not len(ours):
        raise ValueError("A gap needs a replicate that all three groups have.")
    part = float(_part_of_gap(ours, low, high))
    if len(ours) < FEWEST or not np.isfinite(part):
        return part, np.nan, np.nan
    return part, *_bootstrap((ours, low, high), _part_of_gap, paired=True)


def _part_of_gap(scores: Array, frozen: Array, oracle: Array, axis: int = -1) -> Any:
    ours, low, high = (stats.trim_mean(group, 0.25, axis=axis) for group in (scores, frozen, oracle))
    with np.errstate(divide="ignore", invalid="ignore"):  # no gap
        return (ours - low) / (high - low)


def _bootstrap(groups: tuple[Array, ...], statistic: Any, paired: bool = False) -> tuple[float, float]:
    interval = stats.bootstrap(
        groups, statistic, paired=paired, n_resamples=_RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _pairs_won(x: Array, y: Array, axis: int = -1) -> Any:
    return (0.5 + 0.5 * np.sign(x - y)).mean(axis=axis)


def _wins(x: Array, y: Array, axis: int = -1) -> Any:
    """Computes the Mann-Whitney statistic as a fraction of all pairs, by the cheapest method as no p is wanted."""
    with np.errstate(all="ignore"):  # where all values are tied there is no p-value
        statistic = stats.mannwhitneyu(x, y, axis=axis, method="asymptotic").statistic
    return statistic / (x.shape[axis] * y.shape[axis])
