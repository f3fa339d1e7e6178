"""Statistics of what is measured: of one agent, over its seeds, and between groups of runs, with 95 % intervals.

The equations are in docs/evaluation.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import scipy

TAUS = np.linspace(0.0, 1.0, 101)  # where performance profiles are taken
ABOVE = 0.9  # seeds that succeed more often than this have learnt the task
MANY = 20  # scores from which on drawing them anew tells how they differ

Scores = Mapping[str, Sequence[float]]  # of a group of runs: for each task the score of every seed of every run


def proportion_interval(successes: int, trials: int) -> list[float]:
    """Wilson score interval of a proportion at 95 %."""
    return _proportion(successes, trials, "wilson")


def over_seeds(scores: np.ndarray, *, episodes: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(mean, low, high), each [...], of the scores [n, ...] of n seeds, with Student's t intervals.

    Where scores are shares of so many `episodes`, the interval lies in [0, 1], and is no narrower than chance in the
    episodes alone makes it: it has a width where all seeds agree. With one seed `low` and `high` are NaN.
    """
    mean, n = scores.mean(axis=0), len(scores)
    if n < 2:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    low, high = _student(mean, [(_variance(scores, episodes), n - 1)])
    return (mean, low, high) if episodes is None else (mean, np.clip(low, 0, 1), np.clip(high, 0, 1))


def over_tasks(scores: Scores, *, episodes: int | None = None) -> tuple[float, float, float]:
    """(mean, low, high) of the scores of all tasks together, with the interval of `over_seeds` for strata.

    A task with one seed tells nothing of how seeds differ: then `low` and `high` are NaN.
    """
    samples = [np.asarray(sample, float) for sample in scores.values()]
    total = sum(map(len, samples))
    mean = float(np.concatenate(samples).mean())
    if min(map(len, samples)) < 2:
        return mean, np.nan, np.nan
    terms = [((len(x) / total) ** 2 * _variance(x, episodes), len(x) - 1) for x in samples]
    low, high = _student(mean, terms)
    return (mean, low, high) if episodes is None else (mean, max(float(low), 0.0), min(float(high), 1.0))


def difference(better: Scores, than: Scores, *, episodes: int | None = None) -> tuple[float, float, float] | None:
    """(difference, low, high) of the means of two groups, averaged over the tasks that both have: Welch's interval.

    None if they have no task in common; NaN for `low` and `high` where either has only one seed of one.
    """
    pairs = _on_common_tasks(better, than)
    if not pairs:
        return None
    mean = float(np.mean([x.mean() - y.mean() for x, y in pairs]))
    samples = [x for pair in pairs for x in pair]
    if min(map(len, samples)) < 2:
        return mean, np.nan, np.nan
    low, high = _student(mean, [(_variance(x, episodes) / len(pairs) ** 2, len(x) - 1) for x in samples])
    return mean, float(low), float(high)


def _on_common_tasks(better: Scores, than: Scores) -> list[tuple[np.ndarray, np.ndarray]]:
    """The scores of both groups on each task that both have."""
    return [(np.asarray(better[task], float), np.asarray(than[task], float)) for task in better if task in than]


def _variance(scores: np.ndarray, episodes: int | None) -> np.ndarray:
    """Variance of the mean of `scores` [n, ...], no less than that of as many binomial episodes (Agresti-Coull)."""
    n = len(scores)
    spread = scores.var(axis=0, ddof=1) / n
    if episodes is None:
        return spread
    share = (scores.mean(axis=0) * n * episodes + 2) / (n * episodes + 4)
    return np.maximum(spread, share * (1 - share) / (n * episodes))


def _student(middle: Any, terms: Sequence[tuple[Any, int]]) -> tuple[Any, Any]:
    """Student's t interval at 95 % from the variances of independent terms and their degrees of freedom.

    The degrees of freedom of the sum are those of Welch and Satterthwaite.
    """
    variance = sum(term for term, _ in terms)
    freedom = variance**2 / np.maximum(sum(term**2 / df for term, df in terms), np.finfo(float).tiny)
    quantile = scipy.special.stdtrit(np.maximum(freedom, 1.0), 0.975)  # scipy.stats, which calls it, is slow to import
    half = quantile * np.sqrt(variance)
    return middle - half, middle + half


def exact_interval(successes: int, trials: int) -> list[float]:
    """Clopper-Pearson interval of a proportion at 95 %: right also for the few seeds of a table."""
    return _proportion(successes, trials, "exact")


def _proportion(successes: int, trials: int, method: Literal["wilson", "exact"]) -> list[float]:
    interval = scipy.stats.binomtest(int(successes), trials).proportion_ci(0.95, method=method)
    return [float(interval.low), float(interval.high)]


def above(scores: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """Number of `seeds` that score above `ABOVE`, of all (`of`), and the `interval` of that share (Clopper-Pearson)."""
    count = int((np.asarray(scores) > ABOVE).sum())
    return {"seeds": count, "of": len(scores), "interval": exact_interval(count, len(scores))}


def mean_interval(values: np.ndarray) -> list[float]:
    """Student's t interval of a mean at 95 %; a single value is its own interval."""
    mean = float(values.mean())
    if len(values) < 2:
        return [mean, mean]
    half = float(scipy.stats.t.ppf(0.975, len(values) - 1) * scipy.stats.sem(values))
    return [mean - half, mean + half]


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half: a quarter of the values, rounded down, is left out at either end."""
    cut = len(values) // 4
    return float(np.sort(values)[cut : len(values) - cut].mean())


def stratified(samples: Sequence[Sequence[float]], statistic: Callable[..., Any]) -> tuple[Any, Any, Any]:
    """`statistic(*samples)`, a number or an array, with its 95 % percentile bootstrap interval.

    Each sample is drawn anew from itself alone, so that every stratum (task, group) keeps its size.
    """
    data = [np.asarray(sample, float) for sample in samples]
    middle = statistic(*data)
    varying = [i for i, sample in enumerate(data) if len(sample) > 1 and np.ptp(sample) > 0]
    if not varying:
        return middle, middle, middle

    def redrawn(*samples: np.ndarray) -> Any:
        new = dict(zip(varying, samples, strict=True))
        return statistic(*(new.get(i, old) for i, old in enumerate(data)))

    of_draws = statistic if len(varying) == len(data) else redrawn
    found = scipy.stats.bootstrap(
        [data[i] for i in varying], of_draws, method="percentile", vectorized=False, rng=0, n_resamples=4999
    )
    return middle, found.confidence_interval.low, found.confidence_interval.high


def pooled(scores: Scores, statistic: Callable[[np.ndarray], Any]) -> tuple[Any, Any, Any]:
    """A statistic of the scores of all tasks together, with its interval from draws within each task.

    With fewer scores than `MANY`, `low` and `high` are NaN: draws from a few seeds show too little of how seeds differ.
    """
    samples = list(scores.values())
    if sum(map(len, samples)) < MANY:
        return statistic(np.concatenate(samples)), np.nan, np.nan
    return stratified(samples, lambda *tasks: statistic(np.concatenate(tasks)))


def profile(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(share, low, high), each [101]: the share of `values` above each of `TAUS`, with Clopper-Pearson intervals.

    A performance profile (Agarwal et al. 2021).
    """
    counts = (values[:, None] > TAUS).sum(axis=0)
    low, high = np.transpose([exact_interval(count, len(values)) for count in counts])
    return counts / len(values), low, high


def improvement(better: Scores, than: Scores) -> float | None:
    """Probability that a run of one group scores higher than one of another on a task that both have; ties count half.

    None if they have no task in common.
    """
    pairs = _on_common_tasks(better, than)
    if not pairs:
        return None
    return float(np.mean([(np.sign(x[:, None] - y).mean() + 1) / 2 for x, y in pairs]))
