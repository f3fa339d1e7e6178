"""Tabular Q-learning over regions, the Commander's published learner.

    Q[i, g, j] <- Q + alpha_n (r + gamma max_j' Q[i', g, j'] - Q)           r = max over the period of -||g* - s||
                              (r - Q where the task was terminated          r = -||g* - s|| / (1 - gamma) then)

The B environments are B streams of one table: the errors of a cell are averaged over the n decisions of a batch that
visited it, and alpha_n = 1 - (1 - alpha)^n is the step that n updates in a row towards that average would make.

Source: STAR (ICLR 2024), section 4.1; what teachers choose: DQfD (Hester et al. 2018).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from star.abstraction.regions import Change
from star.agent.decisions import Decision, Roadmap
from star.agent.sections import CommanderConfig
from star.agent.values import CommanderState, entries, td_error


def init(*, regions: int, near: int) -> None:
    """It has no model."""


def observe(
    section: CommanderConfig, state: CommanderState, roadmap: Roadmap, batch: Decision, *, margin: Array | float = 0.0
) -> CommanderState:
    """A step on what the streams decided at one instant; what a teacher chose rises to `margin` above all else."""
    error = td_error(section, state, roadmap.allowed, batch)
    cell = entries(roadmap.allowed.near, batch)
    state = _step(section, state, cell, error, weight=jnp.maximum(batch.weight, batch.lost) * (1 - batch.aside))
    if batch.shown is None:
        return state
    lacking = _lacking(state.q[cell[:2]], cell[2], margin)
    return _step(section, state, cell, lacking, weight=batch.weight * batch.shown)


def plan(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, **_: Any) -> CommanderState:
    """Nothing is planned: values come from decisions alone."""
    return state


def settle(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, *, periods: int) -> CommanderState:
    """Greedy episodes follow the same values."""
    return state


def follow(section: CommanderConfig, state: CommanderState, change: Change, *_: Any) -> None:
    """There is no model that could follow."""


def fade(section: CommanderConfig, state: CommanderState) -> None:
    """There is no model that could fade."""


def _lacking(row: Float[Array, "N S"], shown: Int[Array, "N"], margin: Array | float) -> Float[Array, "N"]:
    """The large-margin loss of DQfD: how far the value of what was `shown` is from `margin` above the others'."""
    chosen = jax.nn.one_hot(shown, row.shape[-1])
    return jnp.max(row + margin * (1 - chosen), axis=-1) - jnp.sum(row * chosen, axis=-1)


def _step(
    section: CommanderConfig,
    state: CommanderState,
    cell: tuple[Int[Array, "N"], ...],
    error: Float[Array, "N"],
    *,
    weight: Float[Array, "N"],
) -> CommanderState:
    """Q after as many updates of each visited cell as its `weight` makes, all towards their mean `error`."""
    visits = jnp.zeros_like(state.q).at[cell].add(weight)
    total = jnp.zeros_like(state.q).at[cell].add(weight * error)
    alpha = 1 - (1 - section.learning_rate) ** visits
    return state.replace(q=state.q + alpha * total / jnp.maximum(visits, 1.0))
