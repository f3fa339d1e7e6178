"""The regions of every seed as plain values: the rows of `regions.jsonl`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from star.abstraction.regions import locate
from star.agent import commander, values
from star.agent.decisions import Roadmap
from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.sgim import selection


def of(
    config: AgentConfig,
    state: TrainState,
    *,
    seeds: Sequence[int],
    goal: np.ndarray,
    episode_length: int,
) -> list[dict[str, Any]]:
    """The abstraction of every seed (leading axis of `state`) as plain values, a row of `regions.jsonl` each.

    `lower` and `upper` are the corners of the regions in use, `chosen` how often the Commander chose each of late,
    `visited` how many of its decisions of late began there (of a learned model only). `value` is the Commander's value
    of each for `goal` [d], a test goal, `target` the index of the region it would choose there, both as in greedy
    episodes of `episode_length` env steps. `reaches` and `misses` are pairs of indices: the edges of the graph, and
    what was shown unreachable. With SGIM there are its `competence` in each region, and `drawn`, the share of its
    choices that fall there.
    """
    tables = _tables(config, jax.numpy.asarray(goal), state, episode_length)
    verdicts = {"reaches": state.graph.reaches, "misses": state.graph.misses}
    found, pairs, count = jax.device_get((tables, verdicts, state.abstraction.count))

    def plain(table: np.ndarray, index: int) -> list[Any]:
        values = table[index, : count[index]]
        return (np.round(values.astype(float), 4) if values.dtype.kind == "f" else values).tolist()

    return [
        {"goal": np.round(goal.astype(float), 4).tolist()}
        | {name: plain(table, i) for name, table in found.items()}
        | {name: np.argwhere(table[i, : count[i], : count[i]]).tolist() for name, table in pairs.items()}
        for i in range(len(seeds))
    ]


@partial(jax.jit, static_argnames="episode_length")
def _tables(config: AgentConfig, goal: Array, states: TrainState, episode_length: int) -> dict[str, Array]:
    """Knowledge of each region of every seed, leading axes [seeds, R]."""
    return jax.vmap(partial(_table, config, goal, episode_length))(states)


def _table(config: AgentConfig, goal: Array, episode_length: int, state: TrainState) -> dict[str, Array]:
    goal_region = locate(state.abstraction, goal)
    roadmap = Roadmap.of(config.commander, state.abstraction, state.graph)
    settled = commander.settle(config.commander, state.commander, roadmap, episode_length=episode_length)
    value, target = values.towards(settled, roadmap.allowed, goal_region)
    tables = {
        "lower": state.abstraction.lower,
        "upper": state.abstraction.upper,
        "chosen": state.commander.chosen,
        "value": value,
        "target": target,
    }
    if state.commander.model is not None:
        tables["visited"] = (state.commander.model.led.sum(axis=-1) + state.commander.model.lost).sum(axis=(0, 2))
    if state.sgim is not None:
        tables["competence"] = selection.competence(state.sgim)
        tables["drawn"] = selection.probabilities(config.sgim.selection, state.sgim).sum(axis=-1)
    return tables


def flat(corners: Sequence[Sequence[float]], *, height: float = 0.0) -> np.ndarray:
    """Corners [N, d] in two dimensions or more; where there is but one, the second is `height`."""
    points = np.asarray(corners, float)
    return points if points.shape[1] > 1 else np.insert(points, 1, height, axis=1)
