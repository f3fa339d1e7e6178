"""Evaluation: greedy episodes on goals and seeds of their own, summarised with 95 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from star.episode import Episode


def summarise(episode: Episode) -> dict[str, Any]:
    """Statistics of the episodes of one seed (arrays [E]).

    `success_any` and `success_final` come with Wilson score intervals, `distance` (units of the state, at the end of
    the episode) and `return` (sum of -||g* - s||) with Student's t intervals. Keys ending in `_interval` hold
    [low, high] at 95 %.
    """
    any_, final, distance, total = (
        np.asarray(x, np.float64).ravel()
        for x in (episode.success_any, episode.success_final, episode.distance, episode.total)
    )
    return {
        "episodes": len(any_),
        "success_any": float(any_.mean()),
        "success_any_interval": proportion_interval(int(any_.sum()), len(any_)),
        "success_final": float(final.mean()),
        "success_final_interval": proportion_interval(int(final.sum()), len(final)),
        "distance": float(distance.mean()),
        "distance_interval": mean_interval(distance),
        "return": float(total.mean()),
        "return_interval": mean_interval(total),
    }


def proportion_interval(successes: int, trials: int) -> list[float]:
    """Wilson score interval of a proportion at 95 %."""
    interval = stats.binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return [float(interval.low), float(interval.high)]


def bootstrap(values: Sequence[float], statistic: Callable[..., Any]) -> tuple[float, float, float]:
    """The statistic of `values` with its 95 % percentile bootstrap interval; a single value is its own interval."""
    data = np.asarray(values, float)
    middle = float(statistic(data))
    if len(data) < 2 or np.ptp(data) == 0:
        return middle, middle, middle
    found = stats.bootstrap((data,), statistic, method="percentile", vectorized=False, rng=0, n_resamples=4999)
    return middle, float(found.confidence_interval.low), float(found.confidence_interval.high)


def mean_band(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean, low, high), each [T], of the rows of `values` [n, T], with 95 % percentile bootstrap intervals over rows.

    A single row is its own interval; where a value is NaN, so are all three.
    """
    n = len(values)
    mean = values.mean(axis=0)
    if n < 2:
        return mean, mean, mean
    weights = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=4999) / n
    low, high = np.quantile(weights @ values, (0.025, 0.975), axis=0)
    return mean, low, high


def mean_interval(values: np.ndarray) -> list[float]:
    """Student's t interval of a mean at 95 %; a single value is its own interval."""
    mean = float(values.mean())
    if len(values) < 2:
        return [mean, mean]
    half = float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values))
    return [mean - half, mean + half]
