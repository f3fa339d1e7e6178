"""Statistics of greedy episodes of one seed, and of the way to their goals. The equations are in docs/evaluation.md."""

from __future__ import annotations

from typing import Any

import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from star.agent.play import MISHAPS, Episode
from star.report import statistics

MEASURES = ("success_any", "success_final")
FAILURES = (*MISHAPS, "stuck", "out_of_time")
"""Why an episode never reached its goal: the first that holds."""


class Trials(struct.PyTreeNode):
    """Greedy episodes and what it took to reach their goals, leading axes [E] or [S, E].

    `steps` and `path` count env steps and m of the abstract position until the goal is first reached, or those of the
    whole episode where it is not. `start` is the abstract position at the start. `failure` is the number in `FAILURES`,
    or -1 where the goal is reached.
    """

    episode: Episode
    steps: Float[Array, "*E"]
    path: Float[Array, "*E"]
    start: Float[Array, "*E d"]
    goal: Float[Array, "*E k"]
    failure: Int[Array, "*E"]


def summarise(episode: Episode) -> dict[str, Any]:
    """Statistics of the episodes of one seed (arrays [E]).

    `success_any` and `success_final` come with Wilson score intervals, `distance` (units of the state, at the end of
    the episode), `return` (sum of the task's rewards) and `time_at_goal` (env steps) with Student's t intervals.
    `flipped` is the share that ends with the body on its back. Keys ending in `_interval` hold [low, high] at 95 %.
    """
    any_, final, distance, total, flipped, there = (
        np.asarray(getattr(episode, name), np.float64).ravel()
        for name in ("success_any", "success_final", "distance", "total", "flipped", "time_at_goal")
    )
    return {
        "episodes": len(any_),
        "success_any": float(any_.mean()),
        "success_any_interval": statistics.proportion_interval(int(any_.sum()), len(any_)),
        "success_final": float(final.mean()),
        "success_final_interval": statistics.proportion_interval(int(final.sum()), len(final)),
        "distance": float(distance.mean()),
        "distance_interval": statistics.mean_interval(distance),
        "return": float(total.mean()),
        "return_interval": statistics.mean_interval(total),
        "time_at_goal": float(there.mean()),
        "time_at_goal_interval": statistics.mean_interval(there),
        "flipped": float(flipped.mean()),
    }


def summarise_way(trials: Trials, shortest: np.ndarray | None, *, dt: float, length: int) -> dict[str, Any]:
    """The cost of reaching the goal: `steps_to_goal`, `seconds_to_goal`, `path_length` (m), `stayed` and `spl`.

    `stayed` is the share of the env steps from the first arrival on that are at the goal, in episodes of `length` env
    steps. All but `spl` are means over the episodes that reach it, with Student's t intervals, None if none does.
    `shortest` are the lengths of the shortest ways (m, infinite where there is none), like `trials.path`; without them
    `spl` is None. `dt` is the length of an env step (s).
    """
    reached, there, steps, path = (
        np.asarray(x, np.float64).ravel()
        for x in (trials.episode.success_any, trials.episode.time_at_goal, trials.steps, trials.path)
    )
    found: dict[str, Any] = {}
    ways = {"steps_to_goal": steps, "seconds_to_goal": steps * dt, "path_length": path}
    for name, values in (ways | {"stayed": there / (length - steps + 1)}).items():
        values = values[reached > 0]
        found |= {
            name: float(values.mean()) if len(values) else None,
            f"{name}_interval": statistics.mean_interval(values) if len(values) else None,
        }
    weighted = np.empty(0) if shortest is None else weighted_success(reached, path, np.ravel(shortest))
    return found | {
        "spl": float(weighted.mean()) if len(weighted) else None,
        "spl_interval": statistics.mean_interval(weighted) if len(weighted) else None,
    }


def failures(trials: Trials) -> dict[str, int]:
    """Count of episodes that never reached their goal, by the reason in `FAILURES`."""
    failure = np.ravel(trials.failure)
    return {name: int((failure == number).sum()) for number, name in enumerate(FAILURES)}


def success_behind(episode: Episode, behind: np.ndarray | None) -> dict[str, Any]:
    """`success_behind_walls`: success_any of the episodes `behind` (bool), and how many these are; None without any."""
    chosen = np.asarray(episode.success_any, np.float64)[behind] if behind is not None else np.empty(0)
    return {
        "episodes_behind_walls": len(chosen),
        "success_behind_walls": float(chosen.mean()) if len(chosen) else None,
    }


def weighted_success(reached: np.ndarray, path: np.ndarray, shortest: np.ndarray) -> np.ndarray:
    """Success weighted by path length (Anderson et al. 2018) of every episode that has a shortest way at all.

    1 for who goes the shortest way, 0 for who does not arrive. Who begins at the goal has nowhere to go: 1.
    """
    there = np.isfinite(shortest)
    reached, path, shortest = reached[there], path[there], shortest[there]
    longer = np.maximum(path, shortest)
    return reached * np.divide(shortest, longer, out=np.ones_like(longer), where=shortest > 0)
