"""The Commander's table of values over regions, and how a target is chosen by it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.abstraction.regions import Near, Places
from star.agent.decisions import Decision, Successors
from star.agent.sections import CommanderConfig


class Model(struct.PyTreeNode):
    """Fading counts of where commands led, and of the rewards on the way, by regions that are near each other."""

    led: Float[Array, "2 R S S"]
    """Decisions by aim (0: the target region, 1: the goal in it), region, target and next region."""
    rewards: Float[Array, "R S S"]
    """Sums of rewards by region, goal region and target, of those that ended an episode too."""
    visits: Float[Array, "R S S"]
    """Decisions by region, goal region and target, with those that ended an episode."""
    lost: Float[Array, "2 R S"]
    """Decisions by aim, region and target during which the episode was terminated."""


class CommanderState(struct.PyTreeNode):
    """Q over (region, goal region, target near the region), how often each was a target of late, and any `model`."""

    q: Float[Array, "R R S"]
    chosen: Float[Array, "R"]
    model: Model | None = None


def choose(
    state: CommanderState,
    allowed: Successors,
    region: Int[Array, "B"],
    goal_region: Int[Array, "B"],
    *,
    attraction: Float[Array, "R"] | None = None,
    vain: Int[Array, "B"] | None = None,
    epsilon: Float[Array, "B"] | float,
    key: Array,
) -> Int[Array, "B"]:
    """Target regions: with probability `epsilon` any allowed one, else the best, ties broken at random.

    Random ones are drawn evenly, or in proportion to `attraction`. A target in `vain` (-1: none) is not the best one if
    there is another.
    """
    explore_key, random_key, tie_key = jax.random.split(key, 3)
    near = allowed.near.region[region]
    best_values = _greedy(state, allowed, region, goal_region)
    if vain is not None:
        others = jnp.where(near == vain[:, None], -jnp.inf, best_values)
        best_values = jnp.where(others.max(axis=-1, keepdims=True) > -jnp.inf, others, best_values)
    ties = best_values >= best_values.max(axis=-1, keepdims=True)
    greedy = jnp.argmax(jnp.where(ties, jax.random.uniform(tie_key, best_values.shape), -1.0), axis=-1)
    luck = jax.random.gumbel(random_key, best_values.shape)
    if attraction is not None:
        luck += jnp.log(jnp.maximum(attraction, 1e-6))[near]
    anything = jnp.where(targets(allowed.near, allowed.explore, region, goal_region), luck, -jnp.inf)
    exploring = jax.random.uniform(explore_key, region.shape) < epsilon
    place = jnp.where(exploring, jnp.argmax(anything, axis=-1), greedy)
    return jnp.take_along_axis(near, place[:, None], axis=1)[:, 0]


def worth(
    state: CommanderState, allowed: Successors, region: Int[Array, "B"], goal_region: Int[Array, "B"]
) -> Float[Array, "B"]:
    """The value of being in each `region` with a goal in `goal_region`, by greedy choices."""
    return _greedy(state, allowed, region, goal_region).max(axis=-1)


def _greedy(
    state: CommanderState, allowed: Successors, region: Int[Array, "B"], goal_region: Int[Array, "B"]
) -> Float[Array, "B S"]:
    """The values of the regions near each `region`, -inf where they are no greedy targets."""
    possible = targets(allowed.near, allowed.greedy, region, goal_region)
    return jnp.where(possible, state.q[region, goal_region], -jnp.inf)


def towards(
    state: CommanderState, allowed: Successors, goal_region: Int[Array, ""]
) -> tuple[Float[Array, "R"], Int[Array, "R"]]:
    """For g* in `goal_region`: the value of every region, and the target that is best there, the first of equals."""
    near, every = allowed.near, jnp.arange(state.chosen.shape[0])
    possible = targets(near, allowed.greedy, every, goal_region)
    values = jnp.where(possible, state.q[:, goal_region], -jnp.inf)
    return best(state.q, allowed)[:, goal_region], near.region[every, jnp.argmax(values, axis=-1)]


def best(q: Float[Array, "R G S"], allowed: Successors, goals: Int[Array, "G"] | None = None) -> Float[Array, "R G"]:
    """Value of every region and goal region, all (None) or `goals`, by greedy choices; 0 for regions not in use."""
    goals, greedy = jnp.arange(q.shape[0]) if goals is None else goals, allowed.greedy
    values, own = jnp.where(greedy[:, None], q, -jnp.inf).max(axis=-1), (goals, jnp.arange(len(goals)))
    values = values.at[own].max(q[*own, allowed.near.own[goals]])
    return jnp.where(greedy.any(axis=1)[:, None], values, 0.0)


def inherited(q: Float[Array, "R R S"], places: Places) -> Float[Array, "R R S"]:
    """The values of regions that were cut: their parts inherit them."""
    return regions.moved(regions.inherit(q, places.origin, axes=(0, 1)), places.parts, axis=2)


def td_error(
    section: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision
) -> Float[Array, "N"]:
    """R + gamma max Q' - Q, and R - Q where the task was terminated; time limits are not seen here."""
    future = (1 - batch.lost) * best(state.q, allowed)[batch.next_region, batch.goal_region]
    cell = entries(allowed.near, batch)
    return batch.reward + section.discount * future - state.q.at[cell].get(mode="fill", fill_value=0)


def entries(near: Near, batch: Decision) -> tuple[Int[Array, "N"], Int[Array, "N"], Int[Array, "N"]]:
    """Indices into Q of what was decided; the last is beyond its axis where the target is not near."""
    return batch.region, batch.goal_region, near.place[batch.region, batch.target]


def targets(
    near: Near, allowed: Bool[Array, "R S"], region: Int[Array, "n"], goal_region: Int[Array, "*n"]
) -> Bool[Array, "n S"]:
    """Mask of the regions near each `region` that may follow it, if the goal is in `goal_region`."""
    return allowed[region] | (near.home[region] & (region == goal_region)[:, None])
