"""Plans through nested models: what has to be so first, and the actions that bring about both.

A goal is a place of one observable. If another observable controls the model of that one, its change has the effect
only where both are in the right places: for a push, on the side away from the goal. Memory tells these places. So
the plan has levels, from the goal down to the observable that the action controls.

    levels    of remembered changes of the outcome the one that fits what is needed; the control has to go where it was
              then, and once it is there, to change as it did: its goal, one level below
    imagine   all models together, from what is seen now: what the action changes, then what that changes, ...
    plan      actions by the cross-entropy method: a few of one kind, some of another, more of a third

Source: CHIME (Manoury, Nguyen, Buche, arXiv 2009.10968) plans through nested models; how is ours.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import room as rooms
from envs.worlds.room import Room
from star.saht.chime import memory as memories
from star.saht.chime import models
from star.saht.chime.candidates import Population
from star.saht.chime.memory import Memory

SEGMENTS = np.array([2, 4, 8])
"""A plan is so many actions of one kind, then so many of another, and so on."""
TRIED, ELITES, CYCLES = 32, 6, 3
DEPTH = 3
"""Of nested models: action, robot, object, object by object."""
ROWS = 64
CLOSE = 10.0  # units of the room
FIRST = 0.3
"""A condition counts so much beside the goal."""


class Level(NamedTuple):
    """A condition that has to hold first."""

    control: Int[Array, ""]
    goal: Float[Array, "2"]
    """Of the control."""
    used: Bool[Array, ""]
    """True if there is such a level: the action is no control, and something is remembered."""


class Aim(NamedTuple):
    """A place for the outcome of a slot."""

    slot: Int[Array, ""]
    goal: Float[Array, "2"]


def best_slot(population: Population, outcome: Int[Array, ""], slots: int) -> Int[Array, ""]:
    """The most competent slot of an outcome that is on; any, if there is none."""
    mine = population.enabled[:slots] & (population.models.outcome[:slots] == outcome)
    return jnp.argmax(jnp.where(mine, population.competence[:slots], -1.0))


def levels(
    room: Room, population: Population, memory: Memory, values: Float[Array, "B 2"], aim: Aim, *, slots: int, key: Array
) -> Level:
    """[DEPTH]: what has to be so first, from the aim down."""
    pairs, now = np.array(room.pairs), rooms.apart(room, values)

    def level(known: tuple[Aim, Array], dice: Array) -> tuple[tuple[Aim, Array], Level]:
        aim, used = known
        outcome, control, context = (leaf[aim.slot] for leaf in population.models[:3])
        used &= control != models.ACTION
        need = aim.goal - values[outcome]
        length = jnp.sqrt(jnp.square(need).sum() + 1e-6)
        there = memory.moved[:, outcome] & memory.moved[:, control]
        rows = jnp.minimum(memories.draw(there, dice), len(there) - 1)
        effect = memory.rows.change[rows, outcome] * room.units[outcome]
        along = effect @ need / length
        aside = jnp.sqrt(jnp.maximum(jnp.square(effect).sum(axis=-1) - along**2, 0.0))
        apart = rooms.apart(room, memory.values[rows])  # [R, P, 2]
        wanted = context[len(room.names) :] & (pairs == outcome).any(axis=-1) & (pairs == control).any(axis=-1)
        used &= there.any()
        way = jnp.sqrt(jnp.square((apart - now) * wanted[:, None]).sum(axis=(-1, -2)))
        best = jnp.argmax(jnp.minimum(along, length) - aside - 0.05 * way)
        sign = jnp.where(pairs[:, 0] == control, -1.0, 1.0)
        move = ((apart[best] - now) * (sign * wanted)[:, None]).sum(axis=0)
        then = memory.rows.change[rows[best], control] * room.units[control]
        goal = values[control] + jnp.where(jnp.square(move).sum() < CLOSE**2, then, move)
        return (Aim(best_slot(population, control, slots), goal), used), Level(control, goal, used)

    return jax.lax.scan(level, (aim, jnp.ones((), bool)), jax.random.uniform(key, (DEPTH, ROWS)))[1]


def imagine(
    room: Room, population: Population, values: Float[Array, "B 2"], actions: Float[Array, "T 2"], *, slots: int
) -> Float[Array, "T B 2"]:
    """Observables after each action, as the slots that are on predict them.

    Of several models of one outcome the largest change counts. Relative places follow from places.
    """
    outcome, control, context, weights = jax.tree.map(lambda leaf: leaf[:slots], population.models)
    inputs = weights.context * jnp.repeat(context, 2, axis=-1)[..., None]
    flat = jnp.moveaxis(inputs, 0, 1).reshape(inputs.shape[1], -1)  # [I, M H]: one product for all slots
    names = len(room.names)
    of = (outcome == jnp.arange(names)[:, None]) & population.enabled[:slots]  # [B, M]

    def step(values: Array, action: Array) -> tuple[Array, Array]:
        hidden = (rooms.see(room, values).ravel() @ flat).reshape(weights.bias.shape) + weights.bias

        def follow(_: Array, change: Array) -> Array:
            effects = jax.vmap(models.effect)(weights, hidden, change[control])
            largest = jnp.argmax(jnp.where(of, jnp.square(effects).sum(axis=-1), -1.0), axis=1)
            return change.at[:-1].set(jnp.where(of.any(axis=1)[:, None], effects[largest], 0.0))

        change = jax.lax.fori_loop(0, DEPTH, follow, jnp.zeros((names + 1, 2)).at[models.ACTION].set(action))
        values = jnp.clip(values + change[:-1] * room.units[:, None], room.lower, room.upper)
        return values, values

    return jax.lax.scan(step, values, actions)[1]


def cost(
    first: Level, outcome: Int[Array, ""], goal: Float[Array, "2"], path: Float[Array, "T B 2"]
) -> Float[Array, ""]:
    """The distance of a path from the goal, on the way and in the end, and from the conditions `first` [DEPTH]."""
    off = jnp.sqrt(jnp.square(path[:, outcome] - goal).sum(axis=-1))
    away = jnp.sqrt(jnp.square(path[:, first.control] - first.goal).sum(axis=-1)) * first.used  # [T, DEPTH]
    return off.mean() + off[-1] + FIRST * away.sum(axis=-1).mean()


def plan(
    room: Room,
    population: Population,
    memory: Memory,
    values: Float[Array, "B 2"],
    aim: Aim,
    before: Float[Array, "3 2"],
    *,
    slots: int,
    key: Array,
) -> Float[Array, "3 2"]:
    """The actions of each segment, from what is left of the plan before, whose first segment is done."""
    row_key, even_key, key = jax.random.split(key, 3)
    first = levels(room, population, memory, values, aim, slots=slots, key=row_key)
    outcome = population.models.outcome[aim.slot]

    def value(parts: Array) -> Array:
        actions = jnp.repeat(parts, SEGMENTS, axis=0, total_repeat_length=int(SEGMENTS.sum()))
        return cost(first, outcome, aim.goal, imagine(room, population, values, actions, slots=slots))

    def cycle(known: Any, given: tuple[Array, Array]) -> tuple[Any, None]:
        best, mean, deviation = known
        noise, fixed = given
        tried = jnp.where(jnp.isnan(fixed), mean + deviation * noise, fixed)
        tried = jnp.clip(jnp.concatenate([best[None], tried]), -1.0, 1.0)
        elite = tried[jax.lax.top_k(-jax.vmap(value)(tried), ELITES)[1]]
        return (elite[0], elite.mean(axis=0), elite.std(axis=0) + 0.02), None

    # at first anything, what is left of the plan before in two ways, and nothing
    shape = (TRIED, *before.shape)
    even = jax.random.uniform(even_key, shape, minval=-1.0, maxval=1.0)
    left = jnp.stack([before[jnp.array([1, 1, 2])], jnp.zeros_like(before)])
    fixed = jnp.full((CYCLES, *shape), jnp.nan).at[0].set(even).at[0, : len(left)].set(left)
    start = before[jnp.array([1, 2, 2])]
    noise = jax.random.normal(key, (CYCLES, *shape))
    (best, *_), _ = jax.lax.scan(cycle, (start, start, jnp.ones_like(start)), (noise, fixed))
    return best
