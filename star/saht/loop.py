"""The loop of a learner: choose, execute, remember, and learn what was worth it.

    block   choose task, strategy and goal by progress over cost
            for each generation: propose sequences, execute them, remember them with their outcomes
            tell how the competence of the goal, and of what was reached on the way, has grown
    epoch   blocks, and now and then a cut of a region of goals

Source: Algorithm 1 of S. M. Nguyen's habilitation thesis (arXiv 2412.20573).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import World
from star.saht import choose, memory, strategies
from star.saht.choose import Choice, Progress, Tables
from star.saht.memory import FAR, Memory
from star.saht.proposals import Order, Proposals, Setting
from star.saht.sections import ChoiceConfig, SahtConfig

SPLIT_EVERY = 25  # blocks


class Tallies(struct.PyTreeNode):
    """Iterations since the beginning, by what they were for."""

    chosen: Int[Array, "S M"]
    """By task and strategy."""
    played: Int[Array, "S L"]
    """By task and length of the sequence."""
    pairs: Int[Array, "S S S"]
    """Procedures of the learner's own, by the task that they were for, and their own two tasks."""


class State(struct.PyTreeNode):
    """A learner."""

    memory: Memory
    tables: Tables
    tallies: Tallies
    epoch: Int[Array, ""]
    key: Array


class Seen(NamedTuple):
    """The metrics of a block."""

    choice: Choice
    grown: Float[Array, ""]
    length: Float[Array, ""]
    reached: Int[Array, "S"]
    refused: Int[Array, ""]
    asked: Int[Array, ""]


def init(config: ChoiceConfig, world: World, ways: int, rows: int, *, key: Array) -> State:
    """A learner with so many strategies that has done nothing, with room for so many iterations."""
    tasks = len(world.tasks)
    return State(
        memory=memory.empty(world, rows),
        tables=choose.init(config, tasks, [1.0] * ways),
        tallies=Tallies(
            chosen=jnp.zeros((tasks, ways), jnp.int32),
            played=jnp.zeros((tasks, world.longest), jnp.int32),
            pairs=jnp.zeros((tasks, tasks, tasks), jnp.int32),
        ),
        epoch=jnp.zeros((), jnp.int32),
        key=key,
    )


def block(
    config: SahtConfig, setting: Setting, state: State, available: Bool[Array, "M"], *, number: Array
) -> tuple[State, Seen]:
    """The state after the block of that number, of which all learners side by side have had as many."""
    choose_key, *keys = jax.random.split(jax.random.fold_in(state.key, number), 1 + config.block // config.generation)
    choice = choose.draw(config.choice, state.tables, available, jnp.asarray(setting.scale.used), key=choose_key)
    goal = setting.scale.unit(choice.task, choice.goal)
    row = number * config.block
    before = memory.nearest(state.memory, row, choice.task, goal)

    def generation(known: Memory, step: tuple[Array, Array]) -> tuple[Memory, Any]:
        part, key = step
        propose_key, execute_key = jax.random.split(key)
        rows = row + part * config.generation
        order = Order(choice.task, goal, choice.strategy, part == 0)
        made = strategies.propose(setting, known, rows, order, key=propose_key)
        found, refused = execute(setting, made, key=execute_key)
        new = memory.distances(known, rows, found.outcomes.transpose(2, 0, 1))
        return memory.write(known, rows, found), (
            found.outcomes,
            new,
            found.lengths,
            found.pair,
            refused,
            made.asked.sum(),
        )

    parts = jnp.arange(config.block // config.generation)
    known, out = jax.lax.scan(generation, state.memory, (parts, jnp.stack(keys)))
    outcomes, new, lengths, pair, refused, asked = out
    outcomes = jnp.moveaxis(outcomes, -1, 1).reshape(config.block, *outcomes.shape[1:3])  # [K, S, 4]
    reached = outcomes[..., 0] < FAR / 2
    after = jnp.sqrt(memory.squared(outcomes[:, choice.task].T, goal).min())
    seen = Progress(before, jnp.minimum(before, after), new.reshape(reached.shape), reached)
    return state.replace(
        memory=known,
        tables=choose.told(config.choice, state.tables, choice, seen),
        tallies=counted(setting, state.tallies, choice, lengths.ravel(), pair.ravel()),
    ), Seen(
        choice,
        choose.competence(seen.after) - choose.competence(before),
        lengths.mean(dtype=jnp.float32),
        reached.sum(axis=0),
        refused.sum(),
        asked.sum(),
    )


def execute(setting: Setting, made: Proposals, *, key: Array) -> tuple[Memory, Array]:
    """Rows of a memory: what was executed, and what came of it. And how many outcomes were refused: not finite."""
    found = setting.world.execute(made.sequences, made.lengths, key=key)
    finite = jnp.isfinite(found.value).all(axis=-1)
    there = found.reached & finite
    scaled = jnp.where(there[..., None], setting.scale.scaled(found.value), FAR)
    rows = Memory(
        sequences=made.sequences,
        lengths=made.lengths,
        outcomes=scaled.transpose(1, 2, 0),
        pair=made.pair,
        subgoals=made.subgoals,
        reached=there.sum(axis=0, dtype=jnp.int32),
    )
    return rows, jnp.sum(found.reached & ~finite)


def counted(
    setting: Setting, tallies: Tallies, choice: Choice, lengths: Int[Array, "K"], pair: Int[Array, "K"]
) -> Tallies:
    """`tallies` with the iterations of a block."""
    tasks = len(setting.world.tasks)
    own = jnp.array([way.kind == "procedures" for way in setting.ways])[choice.strategy] & (pair >= 0)
    return Tallies(
        chosen=tallies.chosen.at[choice.task, choice.strategy].add(len(pair)),
        played=tallies.played.at[choice.task, lengths - 1].add(1),
        pairs=tallies.pairs.at[choice.task, pair // tasks, pair % tasks].add(own.astype(jnp.int32)),
    )
