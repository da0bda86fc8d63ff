"""What many seeds say: medians, quartiles, intervals of differences, and a word for them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LEVEL = 0.95


class Interval(NamedTuple):
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float
    n: int


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the first quartile, the median and the third quartile."""
    low, middle, high = np.percentile(np.asarray(values, dtype=float), (25, 50, 75))
    return float(low), float(middle), float(high)


def quartile_curve(values: Floats, bins: int) -> dict[str, list[Any]]:
    """Return the quartiles over seeds of the means of equal bins of steps.

    Args:
        values: ``(seeds, steps)``.
        bins: of which there are fewer where there are fewer steps.

    Returns:
        ``steps``, the last of each bin, and ``low``, ``median`` and ``high``, rounded.
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
    """Return the mean with its 95 % interval by Student's t: seeds are few."""
    from scipy import stats

    data = np.asarray(values, dtype=float)
    mean, n = float(data.mean()), len(data)
    if n < 2 or np.ptp(data) == 0.0:
        return Interval(mean, mean, mean, n)
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, n - 1) * data.std(ddof=1) / np.sqrt(n))
    return Interval(mean, mean - reach, mean + reach, n)


def share_interval(count: int, of: int) -> tuple[float, float]:
    """Return the exact 95 % interval of a share (Clopper and Pearson)."""
    from scipy import stats

    found = stats.binomtest(count, of).proportion_ci(LEVEL)
    return float(found.low), float(found.high)


def difference(one: Sequence[float], other: Sequence[float]) -> Interval:
    """Return the interval of ``one - other``, seed by seed."""
    return interval([a - b for a, b in zip(one, other, strict=True)])


def verdict(found: Interval, *, claimed: int) -> str:
    """Return ``holds``, ``fails`` or ``unclear`` for a claimed sign of a difference.

    Unclear is an interval that has 0 in it, or one seed alone.
    """
    if found.n < 2 or found.low <= 0.0 <= found.high:
        return "unclear"
    return "holds" if (found.mean > 0.0) == (claimed > 0) else "fails"


class Survival(NamedTuple):
    """A Kaplan-Meier curve: the share that has not failed yet, by steps walked."""

    steps: list[float]
    share: list[float]
    low: list[float]
    high: list[float]


def survival(first_falls: Sequence[int | None], cycles: Sequence[int]) -> Survival:
    """Return the Kaplan-Meier curve; who never fell is censored at the end of its walk."""
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
        warnings.simplefilter("ignore", RuntimeWarning)  # no bound where nobody or all are left
        bounds = curve.confidence_interval(LEVEL, method="log-log")
    steps = [0.0, *map(float, curve.quantiles)]
    share = [1.0, *map(float, curve.probabilities)]
    low, high = (
        [1.0, *np.where(np.isnan(bound.probabilities), share[1:], bound.probabilities).tolist()]
        for bound in (bounds.low, bounds.high)
    )
    return Survival(steps, share, low, high)
