"""Test beds: learners with known laws, to measure how well a selector spends its episodes.

A bed is a pure function of its state, so that whole experiments are scanned and vmapped over seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

Select = Callable[..., tuple[Array, Array]]
"""(state, *, key) -> region, strategy"""
Update = Callable[..., Any]
"""(state, region, strategy, competences [n]) -> state"""


class Gains(NamedTuple):
    """Latent competences that practice raises: playing (r, s) once does C_r += gain[r, s] (1 - C_r).

    That holds if the latent competence of region `needs[r]` is above .7, or `needs[r]` is -1. What is observed is C_r
    plus noise; in the regions of `noisy`, .5 plus N(0, .3^2).
    """

    gain: np.ndarray
    """[R, S]"""
    needs: Sequence[int]
    noisy: Sequence[int]

    @property
    def learnable(self) -> np.ndarray:
        """Indices of the regions in which something can be learnt."""
        return np.flatnonzero(self.gain.max(axis=1) > 0)


SIX_REGIONS = Gains(
    gain=np.array(
        [
            [0.004, 0.001, 0.008, 0],  # autonomous, procedure, teacher, bad teacher
            [0.002, 0.006, 0.004, 0],
            [0.0002, 0.006, 0.001, 0],
            [0, 0, 0.010, 0],
            [0, 0, 0, 0],
            [0, 0, 0, 0],
        ]
    ),
    needs=(-1, 0, 1, -1, -1, -1),
    noisy=(5,),
)
"""Six regions and four strategies: a chain of three, one that only the teacher teaches, a silent one, a noisy one."""


class Course(struct.PyTreeNode):
    """What happened, block by block."""

    region: Int[Array, "blocks"]
    strategy: Int[Array, "blocks"]
    competence: Float[Array, "blocks"]
    """Mean latent competence over the learnable regions at the end of each block."""
    regions: Float[Array, "blocks R"]
    """Latent competence of each region at the end of each block."""


def run(
    bed: Gains,
    state: Any,
    select: Select,
    update: Update,
    *,
    noise: float = 0.0,
    blocks: int = 2400,
    episodes: int = 5,
    later: Gains | None = None,
    key: Array,
) -> Course:
    """Let a selector choose for `blocks` blocks of `episodes` each; half-way the gains become those of `later`.

    `noise` is the standard deviation of observed competences.
    """
    gains = jnp.stack([jnp.asarray(each.gain) for each in (bed, later or bed)])
    needs, noisy = np.asarray(bed.needs), np.isin(np.arange(len(bed.needs)), bed.noisy)

    def block(carry: tuple[Array, Any], inputs: tuple[Array, Array]) -> tuple[tuple[Array, Any], Course]:
        latent, state = carry
        number, key = inputs
        select_key, noise_key = jax.random.split(key)
        region, strategy = select(state, key=select_key)
        need = jnp.asarray(needs)[region]
        open_ = (need < 0) | (latent[need] > 0.7)
        gain = gains[(2 * number >= blocks).astype(int), region, strategy] * open_
        path = 1 - (1 - latent[region]) * (1 - gain) ** jnp.arange(1, episodes + 1)
        shaken = jax.random.normal(noise_key, (episodes,))
        seen = jnp.where(jnp.asarray(noisy)[region], 0.5 + 0.3 * shaken, path + noise * shaken)
        latent = latent.at[region].set(path[-1])
        state = update(state, region, strategy, seen)
        course = Course(region=region, strategy=strategy, competence=latent[bed.learnable].mean(), regions=latent)
        return (latent, state), course

    inputs = (jnp.arange(blocks), jax.random.split(key, blocks))
    return jax.lax.scan(block, (jnp.zeros(len(needs)), state), inputs)[1]


def until_mastered(course: Course, *, level: float = 0.9) -> Int[Array, ""]:
    """Blocks until the mean competence exceeds `level`; their number if it never does."""
    there = course.competence > level
    return jnp.where(there.any(), jnp.argmax(there), there.shape[0])
