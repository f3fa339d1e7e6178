"""The loop of a learner.

block   discs are put anywhere; choose a task, and random actions or goal babbling, by progress
        the goal is a place where the task's observable has been seen; act for an episode; remember
epoch   some blocks; models evolve; each task is told what its competence has gained
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import room as rooms
from envs.worlds.room import Room, RoomState
from star.abstraction import regions
from star.saht.chime import candidates, evolution, planner
from star.saht.chime import memory as memories
from star.saht.chime.candidates import NOBODY, Population
from star.saht.chime.memory import Memory
from star.saht.chime.models import ACTION, Rows
from star.saht.chime.planner import SEGMENTS, Aim
from star.saht.chime.sections import ChimeConfig
from star.saht.choose import drawn
from star.sgim import selection
from star.sgim.selection import SgimState

KEPT = int(SEGMENTS[0])
"""Actions of a plan that are done before the next plan is made."""
WAYS = ("random", "babbling")


class State(struct.PyTreeNode):
    """A learner."""

    memory: Memory
    population: Population
    births: Int[Array, "B B+1"]
    """The first action at which a model of each outcome by each control got a slot; the last control is the action."""
    choice: SgimState
    """Regions are slots."""
    epoch: Int[Array, ""]
    key: Array


class Seen(NamedTuple):
    """The report on an epoch."""

    spent: Float[Array, "M 2"]
    """Blocks for each slot, with random actions and with goal babbling."""
    moved: Float[Array, "B"]
    """Share of actions in which each observable has moved."""


def init(config: ChimeConfig, room: Room, *, key: Array) -> State:
    """A learner that has done nothing, and has no tasks unless they are given."""
    net_key, key = jax.random.split(key)
    names, inputs, slots = len(room.names), len(room.contexts), config.models
    borders = [float(slot) for slot in range(1, slots)]
    space = regions.create(([0.0], [float(slots)]), [borders], max_regions=slots)
    population = candidates.empty(config, inputs, key=net_key)
    births = jnp.full((names, names + 1), NOBODY, jnp.int32)
    if config.tasks == "given":
        population, births = _given(room, population, births)
    return State(
        memory=memories.empty(config.memory, names, inputs),
        population=population,
        births=births,
        choice=selection.init(config.choice.selection, space, [1.0] * len(WAYS)),
        epoch=jnp.zeros((), jnp.int32),
        key=key,
    )


def _given(room: Room, population: Population, births: Array) -> tuple[Population, Array]:
    """All tasks that can be learnt, with inputs: the robot, each object by it, and each object by those before."""
    objects = range(1, 1 + room.movable)
    tasks = [(0, ACTION), *((i, 0) for i in objects), *((j, i) for i in objects for j in objects if i < j)]
    outcome, control = jnp.array(tasks, jnp.int32).T
    count = len(tasks)
    context = [
        [i >= len(room.names) and room.pairs[i - len(room.names)] == (c, o) for i in range(len(room.contexts))]
        for o, c in tasks
    ]
    model = population.models
    return population.replace(
        models=model._replace(
            outcome=model.outcome.at[:count].set(outcome),
            control=model.control.at[:count].set(control),
            context=model.context.at[:count].set(jnp.array(context)),
        ),
        active=population.active.at[:count].set(True),
        enabled=population.enabled.at[:count].set(True),
        born=population.born.at[:count].set(0),
    ), births.at[outcome, control].set(0)


def act(
    config: ChimeConfig,
    room: Room,
    state: State,
    world: RoomState,
    aim: Aim,
    planned: Bool[Array, ""],
    *,
    actions: int,
    key: Array,
) -> tuple[RoomState, Rows, Float[Array, "n B 2"]]:
    """The room after so many actions, planned or random; what was seen and done; and the observables before each."""

    def part(known: tuple[RoomState, Array], key: Array) -> tuple[tuple[RoomState, Array], Any]:
        world, before = known
        plan_key, key = jax.random.split(key)
        even = jax.random.uniform(key, (KEPT, 2), minval=-1.0, maxval=1.0)
        if config.tasks == "none":
            chosen = even
        else:
            before = planner.plan(
                room,
                state.population,
                state.memory,
                rooms.observe(world),
                aim,
                before,
                slots=config.models,
                key=plan_key,
            )
            chosen = jnp.where(planned, before[0], even)
        world, out = jax.lax.scan(one, world, chosen)
        return (world, before), out

    def one(world: RoomState, action: Array) -> tuple[RoomState, Any]:
        after, values = rooms.step(room, world, action), rooms.observe(world)
        change = (rooms.observe(after) - values) / room.units[:, None]
        return after, (Rows(rooms.see(room, values), action, change), values)

    start = world, jnp.zeros((len(SEGMENTS), 2))
    (world, _), out = jax.lax.scan(part, start, jax.random.split(key, actions // KEPT))
    rows, values = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), out)
    return world, rows, values


def block(config: ChimeConfig, room: Room, state: State, *, key: Array) -> tuple[State, Seen]:
    """An episode."""
    reset_key, dice_key, act_key = jax.random.split(key, 3)
    dice = jax.random.uniform(dice_key, (2,))
    enabled = state.population.enabled[: config.models]
    chances = selection.probabilities(config.choice.selection, state.choice, admissible=enabled)
    slot, way = jnp.divmod(drawn(chances.ravel(), dice[0]), len(WAYS))
    written = jnp.minimum(state.memory.written, len(state.memory.values))
    seen = (dice[1] * written).astype(jnp.int32)
    aim = Aim(slot, state.memory.values[seen, state.population.models.outcome[slot]])
    world = rooms.reset(room, key=reset_key)
    planned = enabled.any() & (way == WAYS.index("babbling"))
    _, rows, values = act(config, room, state, world, aim, planned, actions=config.episode, key=act_key)
    memory = memories.write(state.memory, rows, values)
    spent = jnp.zeros((config.models, len(WAYS))).at[slot, way].add(enabled.any())
    moved = (jnp.abs(rows.change).max(axis=-1) > memories.STILL).mean(axis=0)
    return state.replace(memory=memory), Seen(spent, moved)


def epoch(config: ChimeConfig, room: Room, state: State) -> tuple[State, Seen]:
    """Some episodes, and an evolution."""
    block_key, evolve_key = jax.random.split(jax.random.fold_in(state.key, state.epoch))
    keys = jax.random.split(block_key, config.blocks)
    state, blocks = jax.lax.scan(lambda state, key: block(config, room, state, key=key), state, keys)
    seen = Seen(blocks.spent.sum(axis=0), blocks.moved.mean(axis=0))
    if config.tasks != "none":
        before = state.population
        population, births = evolution.evolve(config, room, before, state.memory, state.births, key=evolve_key)
        choice = told(config, state.choice, before, population, seen.spent)
        state = state.replace(population=population, births=births, choice=choice)
    return state.replace(epoch=state.epoch + 1), seen


def told(
    config: ChimeConfig, choice: SgimState, before: Population, after: Population, spent: Float[Array, "M 2"]
) -> SgimState:
    """The table of progress after an epoch: a slot's gain of competence is due to the blocks that were spent on it.

    Nothing is known of a slot that holds another model than before.
    """
    slots = config.models
    same = ((before.born == after.born) & before.active)[:slots]
    gained = jnp.where(same, (after.competence - before.competence)[:slots], 0.0) / jnp.maximum(spent.sum(axis=1), 1.0)
    slot, way = (each.ravel() for each in jnp.indices(spent.shape))
    choice = selection.credit(config.choice.selection, choice, slot, way, gained[slot], spent.ravel())
    known = same[:, None]
    return choice.replace(gains=jnp.where(known, choice.gains, 0.0), doubt=jnp.where(known, choice.doubt, 1.0))
