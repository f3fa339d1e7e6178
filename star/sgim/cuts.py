"""SGIM follows cuts of its regions, and makes one itself if nobody else does.

Source of its own cuts: SAGG-RIAC (Baranes and Oudeyer 2013).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from envs.common.batching import where
from star.abstraction import regions
from star.abstraction.regions import Abstraction, Change, Cut, Split
from star.sgim.sections import CuttingConfig
from star.sgim.selection import SgimState, mean_where, newest_first

QUANTILES = 9  # places where a cut is tried along each dimension


def on_split(state: SgimState, abstraction: Abstraction, split: Split) -> SgimState:
    """Follow a cut of one region, if it was made: `abstraction` are the regions after it, or after later ones too.

    Each remembered goal goes to the part it lies in, in the order in which it was practised. What strategies add holds
    for both parts. Their first blocks credit nobody: a part that is harder than the whole has not been forgotten.
    """
    parent, child, cut = split.parent, split.child, split.cut
    order, known = newest_first(state)
    order, known = order[parent, ::-1], known[parent, ::-1]  # oldest first
    goals, competences = state.goals[parent, order], state.competences[parent, order]
    above = goals[:, cut.dimension] >= cut.position
    origin = jnp.arange(abstraction.capacity).at[child].set(parent)
    inherit = partial(regions.inherit, origin=origin, axes=(0,))
    parts = state.replace(
        abstraction=abstraction,
        mean=state.mean.at[jnp.array([parent, child])].set(jnp.inf),
        shares=inherit(state.shares),
        gains=inherit(state.gains),
        doubt=inherit(state.doubt),
        episodes=inherit(state.episodes.at[parent].multiply(0.5)),
    )
    for part, mine in ((parent, known & ~above), (child, known & above)):
        front = jnp.argsort(~mine, stable=True)
        parts = parts.replace(
            goals=parts.goals.at[part].set(goals[front]),
            competences=parts.competences.at[part].set(competences[front]),
            written=parts.written.at[part].set(mine.sum()),
        )
    return where(split.done, parts, state)


def follow(state: SgimState, change: Change) -> SgimState:
    """The state in the regions of another owner, who has cut them."""
    return jax.lax.scan(lambda known, split: (on_split(known, change.after, split), None), state, change.splits)[0]


def split(config: CuttingConfig, state: SgimState) -> tuple[SgimState, Bool[Array, ""]]:
    """Make the cut between whose two sides progress differs most, and say whether there was one.

    For use without another owner of the regions. Of the cuts through regions with a full window, at quantiles of their
    goals along each dimension, with at least `min_side` goals and `min_width` on each side, the one with the largest
    n1 n2 |P1 - P2| is made (SAGG-RIAC); a side's progress is that between its own older and newer half.
    """
    slots, known = (x[:, ::-1] for x in newest_first(state))  # oldest first
    goals = jnp.take_along_axis(state.goals, slots[..., None], axis=1)
    competences = jnp.take_along_axis(state.competences, slots, axis=1)
    full = state.abstraction.active & (state.written >= config.window)

    def grown(values: Array, side: Array) -> Float[Array, ""]:
        rank, half = jnp.cumsum(side), side.sum() // 2
        return mean_where(values, side & (rank > side.sum() - half)) - mean_where(values, side & (rank <= half))

    def score(region: Array, dimension: Array, position: Array) -> Float[Array, ""]:
        above = goals[region, :, dimension] >= position
        sides = [known[region] & side for side in (above, ~above)]
        sizes = jnp.stack([side.sum() for side in sides])
        differ = jnp.abs(grown(competences[region], sides[0]) - grown(competences[region], sides[1]))
        lower, upper = state.abstraction.lower[region, dimension], state.abstraction.upper[region, dimension]
        wide = jnp.minimum(position - lower, upper - position) >= config.min_width
        allowed = full[region] & wide & (sizes.min() >= config.min_side) & (differ > 1e-6)  # more than rounding
        return jnp.where(allowed, sizes.prod() * differ, 0.0)

    shares = jnp.arange(1, QUANTILES + 1) / (QUANTILES + 1)
    positions = jnp.moveaxis(jnp.quantile(goals, shares, axis=1), 0, -1)  # [R, d, QUANTILES]
    capacity, d, _ = positions.shape
    over_positions = jax.vmap(score, in_axes=(None, None, 0))
    over_dimensions = jax.vmap(over_positions, in_axes=(None, 0, 0))
    scores = jax.vmap(over_dimensions, in_axes=(0, None, 0))(jnp.arange(capacity), jnp.arange(d), positions)
    best = jnp.unravel_index(jnp.argmax(scores), scores.shape)
    cut = Cut(region=best[0], dimension=best[1], position=positions[best])
    after, possible = regions.split(state.abstraction, cut, min_width=config.min_width)
    done = possible & (scores[best] > 0)
    return on_split(state, after, Split(done=done, cut=cut, child=state.abstraction.count)), done
