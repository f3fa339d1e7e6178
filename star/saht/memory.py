"""Episodic memory: every sequence that was executed, with its outcomes, in arrays that never change their shape.

Distances are Euclidean over *scaled* outcomes: each dimension over its extent, and all over the root of the number of
dimensions, so 1 is the diagonal of an outcome space. The nearest rows are found exactly. A loop over chunks of rows
ends with the rows written so far: the work grows with what is remembered, in one compiled program. For the k best,
groups of rows are compared first, then the members of the k best groups.

N is the capacity, S the number of tasks, L the longest sequence, p the numbers of a primitive. All functions are of one
learner; vmap over learners that have written as many rows.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import World

CHUNK, GROUP = 1024, 8  # rows
FAR = 1e3
"""Distance of what was not reached: no two outcomes within their bounds are farther apart than 1."""
NEIGHBOURS = 10
"""The number of best rows that a learner looks at."""
GAMMA = 1.2
"""The factor on a rank for one primitive more."""
OFFSET = 0.01  # of a distance in ranks: an exact outcome of a long sequence still has a rank above 0


class Memory(struct.PyTreeNode):
    """Rows of one learner; those not yet written have reached nothing."""

    sequences: Float[Array, "N L p"]
    lengths: Int[Array, "N"]
    outcomes: Float[Array, "S 4 N"]
    """Scaled; `FAR` away where a task has no outcome."""
    pair: Int[Array, "N"]
    """The tasks i and j of the procedure that was executed, as i S + j; -1 if it was none."""
    subgoals: Float[Array, "N 2 4"]
    """The scaled outcomes that made up the procedure."""
    reached: Int[Array, "S"]
    """Rows that have an outcome in each task."""


class Scale(NamedTuple):
    """The scale of outcomes: (value - `lower`) / `width`; 1 in dimensions that a task has not."""

    lower: Float[np.ndarray, "S 4"]
    width: Float[np.ndarray, "S 4"]
    used: Bool[np.ndarray, "S 4"]

    def scaled(self, value: Float[Array, "*batch S 4"]) -> Float[Array, "*batch S 4"]:
        """Outcomes of all tasks, scaled."""
        return (value - self.lower) / self.width

    def unit(self, task: Array, point: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
        """A point in [0, 1] of each dimension of a task, scaled."""
        return point * jnp.asarray(self.top)[task]

    def value(self, task: Array | int, point: Float[Array, "4"]) -> Float[Array, "4"]:
        """A scaled goal of a task as the world has it."""
        return point * jnp.asarray(self.width)[task] + jnp.asarray(self.lower)[task]

    @property
    def top(self) -> Float[np.ndarray, "S 4"]:
        """The largest scaled outcome of each task."""
        return (self.used / np.sqrt(self.used.sum(axis=1, keepdims=True))).astype(np.float32)


def scale_of(world: World) -> Scale:
    """That of a world's outcome spaces."""
    lower, upper = np.asarray(world.lower), np.asarray(world.upper)
    used = np.arange(lower.shape[1]) < np.asarray(world.dims)[:, None]
    width = np.where(used, (upper - lower) * np.sqrt(used.sum(axis=1, keepdims=True)), 1.0)
    return Scale(lower, width.astype(np.float32), used)


def capacity(rows: int) -> int:
    """The capacity that holds so many rows: whole chunks."""
    return -(-rows // CHUNK) * CHUNK


def empty(world: World, rows: int) -> Memory:
    """Nothing done yet, and room for so many rows."""
    n, tasks = capacity(rows), len(world.tasks)
    return Memory(
        sequences=jnp.zeros((n, world.longest, world.primitive)),
        lengths=jnp.ones(n, jnp.int32),
        outcomes=jnp.full((tasks, 4, n), FAR, jnp.float32),
        pair=jnp.full(n, -1, jnp.int32),
        subgoals=jnp.zeros((n, 2, 4)),
        reached=jnp.zeros(tasks, jnp.int32),
    )


def write(memory: Memory, row: Array, new: Memory) -> Memory:
    """`memory` with the rows of `new` from `row` on."""

    def put(old: Array, new: Array, axis: int) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(old, new, row, axis)

    return Memory(
        sequences=put(memory.sequences, new.sequences, 0),
        lengths=put(memory.lengths, new.lengths, 0),
        outcomes=put(memory.outcomes, new.outcomes, 2),
        pair=put(memory.pair, new.pair, 0),
        subgoals=put(memory.subgoals, new.subgoals, 0),
        reached=memory.reached + new.reached,
    )


class Piece(NamedTuple):
    """A task's part of some of the rows."""

    outcomes: Float[Array, "4 *n"]
    lengths: Int[Array, "*n"]
    pair: Int[Array, "*n"]


def piece(memory: Memory, task: Array | int, number: Array) -> Piece:
    """A chunk of rows."""
    start = number * CHUNK
    outcomes = jax.lax.dynamic_slice(memory.outcomes, (task, 0, start), (1, 4, CHUNK))[0]
    return Piece(outcomes, *(jax.lax.dynamic_slice_in_dim(x, start, CHUNK) for x in (memory.lengths, memory.pair)))


def sweep(rows: Array | int, fold: Callable[[Any, Array], Any], start: Any) -> Any:
    """`fold(carry, number)` over the numbers of the chunks that hold the first `rows` rows."""
    return jax.lax.fori_loop(0, (rows + CHUNK - 1) // CHUNK, lambda number, carry: fold(carry, number), start)


def squared(outcomes: Float[Array, "4 *n"], goal: Float[Array, "*m 4"]) -> Float[Array, "*m *n"]:
    """Squared distances, one dimension after another: no larger array is made."""
    flat = goal.reshape(-1, 4)
    apart = [jnp.square(outcomes[k] - flat[:, k].reshape((-1,) + (1,) * (outcomes.ndim - 1))) for k in range(4)]
    return sum(apart[1:], apart[0]).reshape(goal.shape[:-1] + outcomes.shape[1:])


def rank(square: Array, lengths: Array) -> Array:
    """The best is near and short: (distance + `OFFSET`) `GAMMA`^length, from squared distances."""
    return (jnp.sqrt(square) + OFFSET) * jnp.exp(np.log(GAMMA) * lengths)


def least(
    memory: Memory, rows: Array | int, task: Array, value: Callable[[Piece], Array], shape: tuple[int, ...]
) -> tuple[Float[Array, "*shape"], Int[Array, "*shape"]]:
    """The smallest of what `value` [*shape, n] says of n rows, of all rows, and its row; of equal ones any."""

    def fold(carry: tuple[Array, Array], number: Array) -> tuple[Array, Array]:
        best, at = carry
        now = value(piece(memory, task, number))
        return jnp.minimum(best, now), jnp.where(now < best, number, at)

    start = jnp.full((*shape, CHUNK), jnp.inf), jnp.zeros((*shape, CHUNK), jnp.int32)
    best, at = sweep(rows, fold, start)
    lane = jnp.argmin(best, axis=-1)
    return best.min(axis=-1), jnp.take_along_axis(at, lane[..., None], axis=-1)[..., 0] * CHUNK + lane


def distances(memory: Memory, rows: Array | int, found: Float[Array, "K S 4"]) -> Float[Array, "K S"]:
    """Distance of the nearest of the first `rows` rows from each of K outcomes in each task."""

    def nearer(best: Array, number: Array, task: int) -> Array:
        # part by part: on a CPU a minimum over an axis takes eight times as long
        parts = jnp.split(piece(memory, task, number).outcomes, GROUP, axis=1)
        return functools.reduce(jnp.minimum, [squared(part, found[:, task]) for part in parts], best)

    def fold(carry: list[Array], number: Array) -> list[Array]:
        return [nearer(best, number, task) for task, best in enumerate(carry)]

    start = [jnp.full((len(found), CHUNK // GROUP), FAR**2)] * found.shape[1]
    return jnp.sqrt(jnp.stack([best.min(axis=-1) for best in sweep(rows, fold, start)], axis=1))


class Neighbours(NamedTuple):
    """The k best rows for a goal, the best first; where there are fewer, the others are `FAR`."""

    rows: Int[Array, "k"]
    outcomes: Float[Array, "k 4"]
    distances: Float[Array, "k"]

    @property
    def known(self) -> Bool[Array, "k"]:
        """Mask of those that exist."""
        return self.distances < FAR / 2


def neighbours(
    memory: Memory, rows: Array, task: Array, goal: Float[Array, "4"], *, k: int, procedures: bool = False
) -> Neighbours:
    """The k rows of the smallest `rank` for a goal; with `procedures` of those that a procedure reached."""

    def ranks(outcomes: Array, lengths: Array, pair: Array) -> tuple[Array, Array]:
        square = squared(outcomes, goal)
        square = jnp.where(pair >= 0, square, FAR**2) if procedures else square
        return square, rank(square, lengths)

    def fold(found: Array, number: Array) -> Array:
        ranked = ranks(*piece(memory, task, number))[1]
        return jax.lax.dynamic_update_slice_in_dim(found, ranked, number * CHUNK, axis=0)

    found = sweep(rows, fold, jnp.full(memory.lengths.shape[0], jnp.inf)).reshape(GROUP, -1)
    _, groups = jax.lax.top_k(-functools.reduce(jnp.minimum, found), k)
    inside = (groups[:, None] + found.shape[1] * jnp.arange(GROUP)).ravel()
    outcomes = memory.outcomes[task, :, inside].T
    square, order = ranks(outcomes, memory.lengths[inside], memory.pair[inside])
    _, best = jax.lax.top_k(-order, k)
    return Neighbours(inside[best], outcomes.T[best], jnp.sqrt(square[best]))


def nearest(memory: Memory, rows: Array | int, task: Array, goal: Float[Array, "4"]) -> Float[Array, ""]:
    """The distance of the outcome nearest to a goal; `FAR` or more if there is none."""
    found, _ = least(memory, rows, task, lambda part: squared(part.outcomes, goal), ())
    return jnp.minimum(jnp.sqrt(found), FAR)
