"""Parts that strategies of imitation learning share: teachers to ask about any goal, and a policy that learns of them.

Their papers have states, actions and a classifier or regressor; a learner here has goals, sequences and the inverse
model over its memory. A demonstration is executed, which is an iteration, and so remembered.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from envs.common.batching import where
from star.saht import inverse
from star.saht.memory import NEIGHBOURS, Memory, Neighbours, neighbours
from star.saht.proposals import Dice, Order, Setting


def goals(setting: Setting, order: Order, dice: Dice) -> Float[Array, "G 4"]:
    """Scaled goals of the task: that of the block, and others drawn evenly."""
    return setting.scale.unit(order.task, dice.goals[:, 0]).at[0].set(order.goal)


def policy(
    setting: Setting, memory: Memory, rows: Array, task: Array, wanted: Float[Array, "G 4"], dice: Dice
) -> tuple[Float[Array, "G L p"], Int[Array, "G"], Neighbours]:
    """Sequences for each goal by the inverse model, anything where nothing is known; and the neighbours."""
    dims = jnp.array(setting.world.dims)[task]

    def one(goal: Array) -> tuple[Array, Array, Neighbours]:
        near = neighbours(memory, rows, task, goal, k=NEIGHBOURS)
        return inverse.action(memory, near, goal, dims), memory.lengths[near.rows[0]], near

    sequences, lengths, near = jax.vmap(one)(wanted)
    known = near.known[:, 0]
    return jnp.where(known[:, None, None], sequences, dice.anywhere), jnp.where(known, lengths, 1), near


def shown(setting: Setting, task: Array, wanted: Float[Array, "G 4"]) -> tuple[Float[Array, "G L p"], Int[Array, "G"]]:
    """Demonstrations of the world's teacher of the task for each goal."""
    found = setting.world.demonstrate(0, setting.scale.value(0, wanted))
    for number in range(1, len(setting.world.tasks)):
        one = setting.world.demonstrate(number, setting.scale.value(number, wanted))
        found = where(task == number, one, found)
    return found


def odd(setting: Setting) -> Bool[Array, "G"]:
    """Every second iteration of a generation."""
    return jnp.arange(setting.generation) % 2 == 1
