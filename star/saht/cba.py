"""Confidence-based autonomy: the learner acts where it is confident, else it asks; and its mistakes are corrected.

    confident    if the nearest outcome is at most three times as far as outcomes there are from one another, and enough
                 neighbours do it in the same way
    for each goal    confident execution: act by the policy if confident, else the teacher shows what to do
                     corrective demonstration: after a mistake, he shows it in the next iteration

Source: Chernova and Veloso, Interactive Policy Learning through Confidence-Based Autonomy (JAIR 34, 2009). There states
are classified, here goals are reached: confidence is not a classifier's, but that neighbours agree. The factor three is
from memory, and no published value.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from star.saht import imitators, inverse
from star.saht.memory import FAR, Memory, Neighbours
from star.saht.proposals import Dice, Order, Proposals, Setting, plain
from star.saht.teachers import SKILFUL

APART = 3.0  # times the mean distance of nearest neighbours


def propose(setting: Setting, memory: Memory, rows: Array, order: Order, dice: Dice, *, key: Array) -> Proposals:
    """Iterations, each for a goal of the task, or a correction of the one before."""
    task, dims = order.task, jnp.array(setting.world.dims)[order.task]
    wanted = imitators.goals(setting, order, dice)
    own, own_lengths, near = imitators.policy(setting, memory, rows, task, wanted, dice)
    shown, shown_lengths = imitators.shown(setting, task, wanted)
    alone = jax.vmap(lambda one: confident(memory, one, dims))(near)
    wrong = alone & ~imitators.odd(setting) & mistaken(setting, own, own_lengths, task, wanted, key=key)
    corrected = jnp.roll(wrong, 1) & imitators.odd(setting)
    shown = jnp.where(corrected[:, None, None], jnp.roll(shown, 1, axis=0), shown)
    shown_lengths = jnp.where(corrected, jnp.roll(shown_lengths, 1), shown_lengths)
    asked = ~alone | corrected
    sequences = jnp.where(asked[:, None, None], shown, own)
    return plain((sequences, jnp.where(asked, shown_lengths, own_lengths)), asked)


def confident(memory: Memory, near: Neighbours, dims: Array) -> Bool[Array, ""]:
    """True if the neighbours of a goal of so many dimensions are near enough and agree."""
    apart = jnp.linalg.norm(near.outcomes[:, None] - near.outcomes, axis=-1)
    apart = jnp.where(near.known & ~jnp.eye(len(apart), dtype=bool), apart, FAR).min(axis=1)
    several = near.known & (apart < FAR / 2)
    usual = jnp.where(several, apart, 0.0).sum() / jnp.maximum(several.sum(), 1)
    agree = inverse.same_way(memory, near).sum() > dims
    return agree & (near.distances[0] <= APART * usual)


def mistaken(
    setting: Setting, sequences: Array, lengths: Array, task: Array, wanted: Float[Array, "G 4"], *, key: Array
) -> Bool[Array, "G"]:
    """True for those that miss their goals, as the teacher sees when they are executed."""
    found = setting.world.execute(sequences, lengths, key=key)
    value = setting.scale.scaled(found.value)[:, task]
    return ~found.reached[:, task] | (jnp.linalg.norm(value - wanted, axis=-1) > SKILFUL)
