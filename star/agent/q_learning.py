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
from jaxtyping import Array, Bool, Float

from star.abstraction.regions import Change
from star.agent.decisions import Decision, Roadmap
from star.agent.sections import CommanderConfig
from star.agent.values import CommanderState, td_error, towards_goals


def init(*, regions: int) -> None:
    """It has no model."""


def observe(
    section: CommanderConfig, state: CommanderState, roadmap: Roadmap, batch: Decision, *, margin: Array | float = 0.0
) -> CommanderState:
    """A step on what the streams decided at one instant; what a teacher chose rises to `margin` above all else."""
    error = td_error(section, state, roadmap.allowed, batch)
    state = _step(section, state, batch, error, weight=jnp.maximum(batch.weight, batch.lost) * towards_goals(batch))
    return state if batch.shown is None else _follow_teacher(section, state, batch, batch.shown, margin)


def plan(
    section: CommanderConfig, state: CommanderState, roadmap: Roadmap, *, due: Bool[Array, ""] | None = None
) -> CommanderState:
    """Nothing is planned: values come from decisions alone."""
    return state


def settle(section: CommanderConfig, state: CommanderState, roadmap: Roadmap, *, periods: int) -> CommanderState:
    """Greedy episodes follow the same values."""
    return state


def follow(section: CommanderConfig, state: CommanderState, change: Change, *_: Any) -> None:
    """There is no model that could follow."""


def fade(section: CommanderConfig, state: CommanderState) -> None:
    """There is no model that could fade."""


def _follow_teacher(
    section: CommanderConfig,
    state: CommanderState,
    batch: Decision,
    shown: Float[Array, "N"],
    margin: Float[Array, ""] | float,
) -> CommanderState:
    """A step of the large-margin loss of DQfD on the decisions that were shown."""
    row = state.q[batch.region, batch.goal_region]
    chosen = jax.nn.one_hot(batch.target, row.shape[-1])
    lacking = jnp.max(row + margin * (1 - chosen), axis=-1) - jnp.sum(row * chosen, axis=-1)
    return _step(section, state, batch, lacking, weight=batch.weight * shown)


def _step(
    section: CommanderConfig,
    state: CommanderState,
    batch: Decision,
    error: Float[Array, "N"],
    *,
    weight: Float[Array, "N"],
) -> CommanderState:
    """Q after as many updates of each visited cell as its `weight` makes, all towards their mean `error`."""
    cell = (batch.region, batch.goal_region, batch.target)
    visits = jnp.zeros_like(state.q).at[cell].add(weight)
    total = jnp.zeros_like(state.q).at[cell].add(weight * error)
    alpha = 1 - (1 - section.learning_rate) ** visits
    return state.replace(q=state.q + alpha * total / jnp.maximum(visits, 1.0))
