#!/usr/bin/env python
"""Measure how often the 95 % intervals of `star.report.statistics` hold the truth: the table of docs/evaluation.md.

    python scripts/checks/intervals.py [--draws 4000]

Seeds have a success of their own, measured on 200 episodes. Three populations: normal about .6; learnt (about .93) but
for one seed in five at 0; the same with one in twenty.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from star.report import statistics

EPISODES = 200
SEEDS = (3, 5, 10, 20)


def normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Success of seeds, about .6."""
    return np.clip(rng.normal(0.6, 0.1, shape), 0, 1)


def failing(share: float) -> Callable[..., np.ndarray]:
    """Success of seeds of which so large a share is at 0."""

    def draw(rng: np.random.Generator, *shape: int) -> np.ndarray:
        return np.clip(rng.normal(0.93, 0.02, shape), 0, 1) * (rng.random(shape) >= share)

    return draw


POPULATIONS = {"normal": normal, "one in five at 0": failing(0.2), "one in twenty at 0": failing(0.05)}


def holds(low: np.ndarray, truth: float, high: np.ndarray) -> float:
    """The share of intervals with the truth in them."""
    return float(np.mean((np.asarray(low) <= truth + 1e-12) & (truth - 1e-12 <= np.asarray(high))))


def coverage(draw: Callable[..., np.ndarray], n: int, *, draws: int) -> dict[str, float | None]:
    """The coverage of each kind of interval with `n` seeds."""
    rng = np.random.default_rng(n)
    many = draw(rng, 400_000)
    measured = rng.binomial(EPISODES, many) / EPISODES
    scores = rng.binomial(EPISODES, draw(rng, n, draws)) / EPISODES
    others = rng.binomial(EPISODES, draw(rng, n, draws)) / EPISODES
    few = min(draws, 400)
    _, low, high = statistics.over_seeds(scores, episodes=EPISODES)
    apart = [
        statistics.difference({"task": scores[:, i]}, {"task": others[:, i]}, episodes=EPISODES) for i in range(few)
    ]
    learnt = [statistics.above(scores[:, i])["interval"] for i in range(few)]
    profile = [statistics.exact_interval((scores[:, i] > 0.6).sum(), n) for i in range(few)]
    found: dict[str, float | None] = {
        "mean over seeds": holds(low, measured.mean(), high),
        "difference (Welch)": holds([x[1] for x in apart if x], 0.0, [x[2] for x in apart if x]),
        "share above .9": holds(*_around(learnt, (measured > statistics.ABOVE).mean())),
        "profile at .6": holds(*_around(profile, (measured > 0.6).mean())),
        "interquartile mean": None,
    }
    if n >= statistics.MANY:
        ends = [statistics.pooled({"task": scores[:, i]}, statistics.interquartile_mean)[1:] for i in range(few // 4)]
        middle = statistics.interquartile_mean(measured)
        found["interquartile mean"] = holds(*_around(ends, middle))
    return found


def of_episodes(*, draws: int) -> dict[str, float]:
    """The coverage of the intervals over the episodes of one seed: a share of .93, and a mean of normal values."""
    rng = np.random.default_rng(0)
    shares = [statistics.proportion_interval(int(k), EPISODES) for k in rng.binomial(EPISODES, 0.93, draws)]
    means = [statistics.mean_interval(rng.normal(size=EPISODES)) for _ in range(draws)]
    share, mean = holds(*_around(shares, 0.93)), holds(*_around(means, 0.0))
    return {"share of episodes (Wilson)": share, "mean of episodes": mean}


def _around(intervals: list, truth: float) -> tuple[np.ndarray, float, np.ndarray]:
    low, high = np.transpose(intervals)
    return low, truth, high


def table(*, draws: int) -> str:
    """The table as Markdown."""
    lines = [f"| interval | seeds | {' | '.join(POPULATIONS)} |", "|---|---|---|---|---|"]
    found = {n: {name: coverage(draw, n, draws=draws) for name, draw in POPULATIONS.items()} for n in SEEDS}
    for kind in found[SEEDS[0]]["normal"]:
        for n in SEEDS:
            cells = [found[n][name][kind] for name in POPULATIONS]
            if cells[0] is not None:
                lines.append(f"| {kind} | {n} | {' | '.join(f'{cell:.2f}' for cell in cells if cell is not None)} |")
    for kind, share in of_episodes(draws=draws).items():
        lines.append(f"| {kind} | 1 | {share:.2f} | | |")
    return "\n".join(lines)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=4000)
    print(table(draws=parser.parse_args().draws))


if __name__ == "__main__":
    main()
