"""The memory of a learner: its newest actions, in a ring, and draws of those in which something moved."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.saht.chime.models import Rows

STILL = 0.005
"""An observable has moved if it has changed by more, in its unit."""


class Memory(struct.PyTreeNode):
    """The actions of one learner."""

    rows: Rows
    """[N]"""
    values: Float[Array, "N B 2"]
    """Observables before each action."""
    moved: Bool[Array, "N B+1"]
    """True for observables that have moved; the last one is the action, which counts as moved once it is written."""
    written: Int[Array, ""]
    """Actions since the beginning."""


def empty(size: int, observables: int, inputs: int) -> Memory:
    """Room for so many actions, with so many observables and possible inputs."""
    return Memory(
        rows=Rows(jnp.zeros((size, inputs, 2)), jnp.zeros((size, 2)), jnp.zeros((size, observables, 2))),
        values=jnp.zeros((size, observables, 2)),
        moved=jnp.zeros((size, observables + 1), bool),
        written=jnp.zeros((), jnp.int32),
    )


def write(memory: Memory, rows: Rows, values: Float[Array, "n B 2"]) -> Memory:
    """The memory after n more actions, over the oldest ones; n divides its size."""
    n, moved = len(values), jnp.abs(rows.change).max(axis=-1) > STILL
    new = rows, values, jnp.pad(moved, ((0, 0), (0, 1)), constant_values=True)
    place = memory.written % len(memory.values)
    old = memory.rows, memory.values, memory.moved
    rows, values, moved = jax.tree.map(lambda x, y: jax.lax.dynamic_update_slice_in_dim(x, y, place, 0), old, new)
    return Memory(rows=rows, values=values, moved=moved, written=memory.written + n)


def parts(memory: Memory) -> tuple[Bool[Array, "N"], Bool[Array, "N"]]:
    """The actions that models learn from, and every fourth one, which is held out."""
    number = jnp.arange(len(memory.values))
    held = number % 4 == 0
    there = number < memory.written
    return there & ~held, there & held


def counts(memory: Memory, among: Bool[Array, "N"]) -> Int[Array, "B B+1"]:
    """In how many of these actions an observable has moved together with a control."""
    moved = (memory.moved & among[:, None]).astype(jnp.float32)
    return (moved[:, :-1].T @ moved).astype(jnp.int32)


def draw(among: Bool[Array, "N"], dice: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """One of these actions for each number in [0, 1), evenly; N if there are none."""
    heap = jnp.cumsum(among.astype(jnp.int32))
    return jnp.searchsorted(heap, (dice * heap[-1]).astype(jnp.int32), side="right").astype(jnp.int32)


def mixture(
    memory: Memory,
    among: Bool[Array, "N"],
    outcome: Int[Array, ""],
    control: Int[Array, ""],
    dice: Float[Array, "*n 2"],
) -> Int[Array, "*n"]:
    """Some of these actions in which the control has moved; in at least half of them so has the outcome.

    Where nothing has moved together yet, the answer means nothing.
    """
    there = among & memory.moved[:, control]
    moved, still = there & memory.moved[:, outcome], there & ~memory.moved[:, outcome]
    share = jnp.maximum(0.5, moved.sum() / jnp.maximum(there.sum(), 1)) * moved.any()
    both = draw(moved, dice[..., 1]), draw(still, dice[..., 1])
    chosen = jnp.where((dice[..., 0] < share) | ~still.any(), *both)
    return jnp.minimum(chosen, len(among) - 1)
