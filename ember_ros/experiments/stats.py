"""Statistics over seeds: medians, quartiles, confidence intervals, verdicts, survival curves."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LEVEL = 0.95
"""Confidence level of all intervals."""


class Interval(NamedTuple):
    """A mean and its 95 % confidence interval."""

    mean: float
    low: float
    high: float
    n: int
    """Number of values."""


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the first quartile, the median and the third quartile."""
    low, middle, high = np.percentile(np.asarray(values, dtype=float), (25, 50, 75))
    return float(low), float(middle), float(high)


def quartile_curve(values: Floats, bins: int) -> dict[str, list[Any]]:
    """Return a curve over steps: bin means of each seed, then their quartiles over the seeds.

    Args:
        values: one value per seed and step, ``(seeds, steps)``.
        bins: number of bins; at most one per step.

    Returns:
        ``steps``: number of the last step of each bin; ``low``, ``median``, ``high``: the
        quartiles, rounded to five decimals.
    """
    parts = np.array_split(values, min(bins, values.shape[1]), axis=1)
    means = np.stack([part.mean(axis=1) for part in parts], axis=1)
    low, middle, high = np.percentile(means, (25, 50, 75), axis=0)
    return {
        "steps": np.cumsum([part.shape[1] for part in parts]).tolist(),
        "low": low.round(5).tolist(),
        "median": middle.round(5).tolist(),
        "high": high.round(5).tolist(),
    }


def interval(values: Sequence[float]) -> Interval:
    """Return the mean with its 95 % confidence interval, from Student's t distribution."""
    from scipy import stats

    data = np.asarray(values, dtype=float)
    mean, n = float(data.mean()), len(data)
    if n < 2 or np.ptp(data) == 0.0:
        return Interval(mean, mean, mean, n)
    half_width = float(stats.t.ppf(0.5 + LEVEL / 2, n - 1) * data.std(ddof=1) / np.sqrt(n))
    return Interval(mean, mean - half_width, mean + half_width, n)


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Return the exact 95 % confidence interval of a share (Clopper and Pearson)."""
    from scipy import stats

    limits = stats.binomtest(count, total).proportion_ci(LEVEL)
    return float(limits.low), float(limits.high)


def difference(minuend: Sequence[float], subtrahend: Sequence[float]) -> Interval:
    """Return the mean and interval of ``minuend - subtrahend``, paired by seed."""
    return interval([a - b for a, b in zip(minuend, subtrahend, strict=True)])


def verdict(interval: Interval, *, claimed: int) -> str:
    """Return the verdict on the claim that a difference has a certain sign.

    Args:
        interval: the difference.
        claimed: its claimed sign, 1 or -1.

    Returns:
        ``holds`` or ``fails``; ``unclear`` if the interval contains 0 or there is only one seed.
    """
    if interval.n < 2 or interval.low <= 0.0 <= interval.high:
        return "unclear"
    return "holds" if (interval.mean > 0.0) == (claimed > 0) else "fails"


class Survival(NamedTuple):
    """A Kaplan-Meier curve: the share of walkers that have not fallen yet, over the steps."""

    steps: list[float]
    """Steps at which the curve changes, and 0."""
    share: list[float]
    low: list[float]
    """Lower 95 % confidence limit of the share."""
    high: list[float]
    """Upper 95 % confidence limit of the share."""


def survival(first_falls: Sequence[int | None], cycles: Sequence[int]) -> Survival:
    """Return the Kaplan-Meier curve of the steps to the first fall.

    Args:
        first_falls: cycle of the first fall of each walker, from 0; None if it never fell. Such a
            walker is censored at the end of its walk.
        cycles: length of each walk.
    """
    from scipy import stats

    ends = [
        end if fall is None else fall + 1 for fall, end in zip(first_falls, cycles, strict=True)
    ]
    fell = [fall is not None for fall in first_falls]
    if not any(fell):
        last = float(max(cycles))
        return Survival([0.0, last], [1.0, 1.0], [1.0, 1.0], [1.0, 1.0])
    data = stats.CensoredData(
        uncensored=[e for e, f in zip(ends, fell, strict=True) if f],
        right=[e for e, f in zip(ends, fell, strict=True) if not f],
    )
    curve = stats.ecdf(data).sf
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", RuntimeWarning
        )  # no limits where all or no walkers are left
        bounds = curve.confidence_interval(LEVEL, method="log-log")
    steps = [0.0, *map(float, curve.quantiles)]
    share = [1.0, *map(float, curve.probabilities)]
    low, high = (
        [1.0, *np.where(np.isnan(bound.probabilities), share[1:], bound.probabilities).tolist()]
        for bound in (bounds.low, bounds.high)
    )
    return Survival(steps, share, low, high)
