"""DAgger: the teacher says what he would have done wherever the learner has acted, and all of it is learnt from.

    for each goal    the learner acts by its policy; in the first generation the teacher acts
                     the teacher shows what he does for the same goal

So half of all iterations are the teacher's: beta_i is 1 for i = 1, and then 0. Source: Ross, Gordon and Bagnell, A
Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning (AISTATS 2011, arXiv 1011.0686),
Algorithm 3.1. It visits states, here goals. Its policy knows the teacher's actions only, here also the outcomes of its
own.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from star.saht import imitators
from star.saht.memory import Memory
from star.saht.proposals import Dice, Order, Proposals, Setting, plain


def propose(setting: Setting, memory: Memory, rows: Array, order: Order, dice: Dice) -> Proposals:
    """Pairs of iterations, each for a goal of the task."""
    wanted = imitators.goals(setting, order, dice)
    wanted = wanted[jnp.arange(setting.generation) // 2 * 2]
    own, own_lengths, _ = imitators.policy(setting, memory, rows, order.task, wanted, dice)
    shown, shown_lengths = imitators.shown(setting, order.task, wanted)
    asked = imitators.odd(setting) | (rows == 0)
    sequences = jnp.where(asked[:, None, None], shown, own)
    return plain((sequences, jnp.where(asked, shown_lengths, own_lengths)), asked)
