"""Where a region falls apart: a plane through it from whose two sides agents get to different places.

A wall through a region makes two places of it that look like one. Plans then go in at the one and come out at the
other. Of the remembered periods in which agents moved, those that began in the region say where each side leads: into
other regions, or to either side of the plane. With shares P of the places where periods end,

    overlap = sum over places of min(P(place | began below), P(place | began above))

The plane is a cut where that is next to nothing and enough periods began on either side. Of several it is the one whose
emptier side has most, and of these the one that is farthest from where agents were: in the middle of the wall.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Abstraction, Cut

PLANES = 32  # equal parts of a region along each dimension; planes lie between them
OVERLAP = 0.2  # the most that the two sides of a wall have in common: some agents find a way around it in one period
LEAST = 5  # periods on either side: the far side of a wall is rarely visited


def cuts(
    abstraction: Abstraction,
    periods: Outcome,
    *,
    min_width: float | Array,
) -> tuple[Cut, Float[Array, "R"]]:
    """The cut of each region [R], and the periods that began on its emptier side; 0 where there is none.

    `periods` [N] are remembered ones; who has not moved by `min_width` along any dimension tells nothing. At least
    `LEAST` begin on either side, which is `min_width` wide or more.
    """
    region, there = (regions.locate(abstraction, point) for point in (periods.start, periods.end))
    moved = jnp.abs(periods.end - periods.start).max(axis=-1) >= min_width
    counted, stays = periods.weight * moved, region == there
    corner, sides = abstraction.lower, abstraction.upper - abstraction.lower
    dimension = jnp.arange(sides.shape[1])

    def part(point: Float[Array, "N d"]) -> Array:
        share = (point - corner[region]) / sides[region]
        return jnp.clip(jnp.floor(PLANES * share), 0, PLANES - 1).astype(jnp.int32)

    def count(parts: Array, weight: Float[Array, "N"]) -> Float[Array, "R d parts"]:
        """How many are in each part."""
        return jnp.zeros((*sides.shape, PLANES)).at[region[:, None], dimension, parts].add(weight[:, None])

    def below(parts: Array, weight: Float[Array, "N"]) -> Float[Array, "R d planes"]:
        """How many are in parts below each plane."""
        return jnp.cumsum(count(parts, weight), axis=-1)[..., :-1]

    began, ended = part(periods.start), part(periods.end)
    led = jnp.zeros((*sides.shape, PLANES, len(sides)))
    led = led.at[region[:, None], dimension, began, there[:, None]].add((counted * ~stays)[:, None])
    out_below = jnp.cumsum(led, axis=2)[:, :, :-1]
    out_above = led.sum(axis=2, keepdims=True) - out_below

    staying = counted * stays
    total = jnp.zeros(len(sides)).at[region].add(staying)[:, None, None]
    from_below, to_below = below(began, staying), below(ended, staying)
    both_below = below(jnp.maximum(began, ended), staying)
    both_above = total - below(jnp.minimum(began, ended), staying)
    up, down = from_below - both_below, to_below - both_below

    number_below, number_above = (
        jnp.maximum(one, 1e-6)
        for one in (out_below.sum(axis=-1) + from_below, out_above.sum(axis=-1) + total - from_below)
    )
    common = lambda low, high: jnp.minimum(low / number_below, high / number_above)  # noqa: E731
    overlap = jnp.minimum(out_below / number_below[..., None], out_above / number_above[..., None]).sum(axis=-1)
    overlap += common(both_below, down) + common(up, both_above)

    fewer = jnp.minimum(number_below, number_above)
    inside = jnp.arange(1, PLANES) / PLANES * sides[..., None]
    wide = (inside >= min_width) & (sides[..., None] - inside >= min_width)
    sound = wide & (fewer >= LEAST) & (overlap <= OVERLAP) & abstraction.active[:, None, None]
    entered = count(began, periods.weight) + count(ended, periods.weight * stays) > 0
    score = jnp.where(sound, fewer + _room(entered) / PLANES, 0.0)
    return _best(score, corner[..., None] + inside), jnp.floor(score.max(axis=(1, 2)))


def _best(score: Float[Array, "R d planes"], position: Float[Array, "R d planes"]) -> Cut:
    """The plane of each region that has the largest score."""
    each = jnp.arange(len(score))
    along, plane = jnp.unravel_index(jnp.argmax(score.reshape(len(score), -1), axis=1), score.shape[1:])
    return Cut(region=each, dimension=along, position=position[each, along, plane])


def _room(entered: Bool[Array, "R d parts"]) -> Int[Array, "R d planes"]:
    """How many parts on the nearer side of each plane nobody has `entered`, below PLANES / 2."""
    index = jnp.arange(PLANES)
    under = jax.lax.cummax(jnp.where(entered, index, -1), axis=2)[..., :-1]
    over = jax.lax.cummin(jnp.where(entered, index, PLANES), axis=2, reverse=True)[..., 1:]
    return jnp.minimum(index[:-1] - under, over - index[1:])
