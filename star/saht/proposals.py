"""Sequences for a goal: the needs of strategies, and what these make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import World
from star.saht.memory import Scale
from star.saht.teachers import Shown


class Way(NamedTuple):
    """A strategy as a learner knows it."""

    name: str
    kind: str
    task: int = 0
    """The task of its teacher, if it has one."""
    teacher: int = 0
    """The number of its teacher in `Shown`."""
    recorded: bool = False
    """True if its teacher's demonstrations come from a file."""


class Setting(NamedTuple):
    """The needs of strategies besides the memory."""

    world: World
    scale: Scale
    ways: tuple[Way, ...]
    shown: Shown
    generation: int
    """G."""

    def of_way(self, way: Array, name: str) -> Array:
        """The notes on a strategy, by its number."""
        return jnp.array([getattr(one, name) for one in self.ways])[way]


class Order(NamedTuple):
    """The exercise: a scaled goal of a task, by the strategy number `way`."""

    task: Int[Array, ""]
    goal: Float[Array, "4"]
    way: Int[Array, ""]
    first: Bool[Array, ""]
    """True if a block begins with it: then the first sequence is as a teacher shows it."""


class Proposals(struct.PyTreeNode):
    """A generation of sequences."""

    sequences: Float[Array, "G L p"]
    lengths: Int[Array, "G"]
    pair: Int[Array, "G"]
    """Of the procedure that each is made of, as in `Memory`."""
    subgoals: Float[Array, "G 2 4"]
    asked: Bool[Array, "G"]
    """True if a teacher was asked for it."""


class Dice(NamedTuple):
    """Random numbers of a generation. Kinds of strategies share them: of all that is made one kind is executed.

    Few calls for many numbers: each takes as long to compile as all that a strategy does.
    """

    anywhere: Float[Array, "G L p"]
    """Even in [-1, 1]; all others in [0, 1), or normal."""
    varied: Float[Array, "G L p"]
    normal: Float[Array, "G L p"]
    goals: Float[Array, "G 2 4"]
    normal_goals: Float[Array, "G 2 4"]
    length: Float[Array, "G"]
    local: Float[Array, "G"]
    model: Float[Array, "G"]
    once: Float[Array, "8"]

    @classmethod
    def thrown(cls, world: World, g: int, *, key: Array) -> Dice:
        """For G sequences in a world."""
        even_key, normal_key = jax.random.split(key)
        sequences, two, one = (g, world.longest, world.primitive), (g, 2, 4), (g,)
        even = _parts(jax.random.uniform, even_key, [sequences, sequences, two, one, one, one, (8,)])
        normal = _parts(jax.random.normal, normal_key, [sequences, two])
        anywhere, varied, goals, length, local, model, once = even
        return cls(2 * anywhere - 1, varied, normal[0], goals, normal[1], length, local, model, once)


def _parts(draw: Any, key: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """The draws of one call, in these shapes."""
    sizes = np.array([math.prod(shape) for shape in shapes])
    parts = jnp.split(draw(key, (int(sizes.sum()),)), np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def anywhere(setting: Setting, dice: Dice) -> tuple[Float[Array, "G L p"], Int[Array, "G"]]:
    """Random sequences, each primitive more half as likely."""
    weights = 0.5 ** np.arange(setting.world.longest)
    below = np.cumsum(weights)[:-1] / weights.sum()
    return dice.anywhere, 1 + jnp.sum(dice.length[:, None] >= below, axis=1, dtype=jnp.int32)


def plain(made: tuple[Array, Array], asked: Array | bool = False) -> Proposals:
    """Sequences [G, L, p] with their lengths that are no procedures."""
    g = len(made[1])
    none = jnp.full(g, -1, jnp.int32)
    return Proposals(*made, pair=none, subgoals=jnp.zeros((g, 2, 4)), asked=jnp.broadcast_to(asked, (g,)))
