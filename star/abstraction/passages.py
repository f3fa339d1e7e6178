"""The place at which a region falls apart: a plane through it that agents do not pass.

A wall through a region makes two places of it that look like one. Plans then go in at the one and come out at the
other. It shows in two ways.

Its sides lead to different places. Of the remembered periods in which agents moved, those that began in the region say
where each side leads: into other regions, or to either side of the plane. With shares P of the places where periods
end,

    overlap = sum over places of min(P(place | began below), P(place | began above))

is next to nothing, and enough periods began on either side.

Goals beyond it are not reached. Of the periods in which agents were sent to a goal in their own region, next to none
whose goal was on the other side of the plane ended there. Most goals on the agents' own side were reached, though, or
in all regions if hardly any goal lies on their side. Nobody has to have been beyond. Few agents get there in an epoch,
so these periods are counted over epochs, and fade.

Of several planes the one with most evidence is a cut, and of these the one that is farthest from where agents were and
goals are: in the middle of the wall.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Abstraction, Cut

PLANES = 32  # equal parts of a region along each dimension; planes lie between them
OVERLAP = 0.2  # the most that the two sides of a wall have in common: some agents find a way around it in one period
LEAST = 5  # periods on either side: the far side of a wall is rarely visited
TRIES = 10  # periods towards goals on the other side
PASSED = 0.1  # the most of them that end there: regions are large, and a period may end before a plane that is far
ABLE = 0.5  # the least of the goals on their own side that agents reach: who cannot walk yet reaches none
KEPT = 0.9  # of what was counted, for the next epoch

Planes = Float[Array, "R d planes"]


class Tries(struct.PyTreeNode):
    """Fading counts, for each plane through a region, of periods of agents there towards a goal in the region."""

    beyond: Planes
    """Those whose goal was on the other side of the plane."""
    passed: Planes
    """Those of them that ended there."""
    beside: Planes
    """Those whose goal was on the agent's own side."""
    met: Planes
    """Those of them that reached it."""


class Ways(NamedTuple):
    """The ways of N agents, each told by K points."""

    point: Float[Array, "K N d"]
    region: Int[Array, "K N"]
    part: Int[Array, "K N d"]
    """Of the PLANES parts of the region of the first point, along each dimension, the one with each point."""
    weight: Float[Array, "N"]


def untried(*, capacity: int, dimensions: int) -> Tries:
    """Nothing counted."""
    return Tries(*[jnp.zeros((capacity, dimensions, PLANES - 1))] * 4)


def cuts(
    abstraction: Abstraction,
    periods: Outcome,
    goals: Outcome,
    reached: Bool[Array, "M"],
    earlier: Tries,
    *,
    min_width: float | Array,
) -> tuple[Cut, Float[Array, "R"], Tries]:
    """The cut of each region [R], the periods that speak for it, 0 where there is none, and what is counted by now.

    `periods` [N] are remembered ones; who has not moved by `min_width` along any dimension tells nothing. `goals` [M]
    are those of an epoch in which agents were given a goal, and whether it was `reached`; those of `earlier` epochs
    count as well. Both sides of a cut are `min_width` wide or more.
    """
    corner, sides = abstraction.lower, abstraction.upper - abstraction.lower
    inside = jnp.arange(1, PLANES) / PLANES * sides[..., None]
    wide = (inside >= min_width) & (sides[..., None] - inside >= min_width) & abstraction.active[:, None, None]
    walked = _ways(abstraction, [periods.start, periods.end], periods.weight)
    tried = _ways(abstraction, [goals.start, (goals.lower + goals.upper) / 2, goals.end], goals.weight)
    moved = jnp.abs(periods.end - periods.start).max(axis=-1) >= min_width
    own = tried._replace(weight=tried.weight * (tried.region[0] == tried.region[1]))
    tries = jax.tree.map(lambda old, new: KEPT * old + new, earlier, _tries(abstraction, own, reached))
    able = jnp.sum(own.weight * reached) >= ABLE * jnp.maximum(own.weight.sum(), 1.0)
    evidence = jnp.maximum(
        _leading_apart(abstraction, walked._replace(weight=walked.weight * moved)), _not_passed(tries, able)
    )
    room = _room(_free(abstraction, walked, tried))
    score = jnp.where(wide & (evidence > 0), evidence + room / PLANES, 0.0)
    return _best(score, corner[..., None] + inside), jnp.floor(score.max(axis=(1, 2))), tries


def _leading_apart(abstraction: Abstraction, walked: Ways) -> Planes:
    """The periods on the emptier side of each plane whose sides lead to different places; 0 at all others."""
    region, there = walked.region
    began, ended = walked.part
    stays = region == there
    capacity, d = abstraction.lower.shape
    led = jnp.zeros((capacity, d, PLANES, capacity))
    led = led.at[region[:, None], jnp.arange(d), began, there[:, None]].add((walked.weight * ~stays)[:, None])
    out_below = jnp.cumsum(led, axis=2)[:, :, :-1]
    out_above = led.sum(axis=2, keepdims=True) - out_below

    parts = jnp.stack([began, ended, jnp.maximum(began, ended), jnp.minimum(began, ended)])
    below, total = _below(abstraction, region, parts, jnp.broadcast_to(walked.weight * stays, parts.shape[:2]))
    from_below, to_below, both_below, either_below = below
    both_above = total[0] - either_below
    up, down = from_below - both_below, to_below - both_below

    number_below, number_above = (
        jnp.maximum(one, 1e-6)
        for one in (out_below.sum(axis=-1) + from_below, out_above.sum(axis=-1) + total[0] - from_below)
    )
    common = lambda low, high: jnp.minimum(low / number_below, high / number_above)  # noqa: E731
    overlap = jnp.minimum(out_below / number_below[..., None], out_above / number_above[..., None]).sum(axis=-1)
    overlap += common(both_below, down) + common(up, both_above)
    fewer = jnp.minimum(number_below, number_above)
    return jnp.where((fewer >= LEAST) & (overlap <= OVERLAP), fewer, 0.0)


def _tries(abstraction: Abstraction, own: Ways, reached: Bool[Array, "M"]) -> Tries:
    """Count what agents did towards goals in their `own` region, and whether they `reached` them."""
    (region, _, there), (began, wanted, ended) = own.region, own.part
    low, high = jnp.minimum(began, wanted), jnp.maximum(began, wanted)
    got = jnp.clip(jnp.where((there == region)[:, None], ended, began), low, high)  # so far on the way to the goal
    parts = jnp.stack([low, high, jnp.minimum(began, got), jnp.maximum(began, got), low, high])
    below, total = _below(abstraction, region, parts, jnp.stack([own.weight] * 4 + [own.weight * reached] * 2))
    return Tries(
        beyond=below[0] - below[1],
        passed=below[2] - below[3],
        beside=below[1] + total[1] - below[0],
        met=below[5] + total[5] - below[4],
    )


def _not_passed(tries: Tries, able: Bool[Array, ""]) -> Planes:
    """The periods towards goals beyond each plane that agents do not pass; 0 at all others.

    `able` says whether agents mostly reach goals in their own region, wherever that is.
    """
    can = jnp.where(tries.beside < TRIES, able, tries.met >= ABLE * tries.beside)
    blocked = (tries.beyond >= TRIES) & (tries.passed <= PASSED * tries.beyond)
    return jnp.where(blocked & can, jnp.floor(tries.beyond), 0.0)


def _ways(abstraction: Abstraction, points: list[Float[Array, "N d"]], weight: Float[Array, "N"]) -> Ways:
    """Find the points in the table of regions."""
    point = jnp.stack(points)
    region = regions.locate(abstraction, point)
    return Ways(point, region, _part(abstraction, region[0], point), weight)


def _part(
    abstraction: Abstraction, region: Int[Array, "*N"], point: Float[Array, "*batch d"]
) -> Int[Array, "*batch d"]:
    """In which of the PLANES parts of its `region` each point is, along each dimension."""
    lower, upper = abstraction.lower[region], abstraction.upper[region]
    share = (point - lower) / (upper - lower)
    return jnp.clip(jnp.floor(PLANES * share), 0, PLANES - 1).astype(jnp.int32)


def _count(
    abstraction: Abstraction, region: Int[Array, "N"], part: Int[Array, "N d"], weight: Float[Array, "N"]
) -> Float[Array, "R d parts"]:
    """Count in each part."""
    capacity, d = abstraction.lower.shape
    return jnp.zeros((capacity, d, PLANES)).at[region[:, None], jnp.arange(d), part].add(weight[:, None])


def _below(
    abstraction: Abstraction, region: Int[Array, "N"], part: Int[Array, "K N d"], weight: Float[Array, "K N"]
) -> tuple[Float[Array, "K R d planes"], Float[Array, "K R d 1"]]:
    """Counts in the parts below each plane, and in all."""
    count = jax.vmap(partial(_count, abstraction, region))(part, weight)
    upto = jnp.cumsum(count, axis=-1)
    return upto[..., :-1], upto[..., -1:]


def _best(score: Planes, position: Planes) -> Cut:
    """The plane of each region that has the largest score."""
    each = jnp.arange(len(score))
    along, plane = jnp.unravel_index(jnp.argmax(score.reshape(len(score), -1), axis=1), score.shape[1:])
    return Cut(region=each, dimension=along, position=position[each, along, plane])


def _free(abstraction: Abstraction, walked: Ways, tried: Ways) -> Bool[Array, "R d parts"]:
    """The parts of each region that are free somewhere: periods began or ended there, or a goal lies there."""
    point = jnp.concatenate([*walked.point, tried.point[1]])
    region = jnp.concatenate([*walked.region, tried.region[1]])
    weight = jnp.concatenate([walked.weight, walked.weight, tried.weight])
    return _count(abstraction, region, _part(abstraction, region, point), weight) > 0


def _room(free: Bool[Array, "R d parts"]) -> Int[Array, "R d planes"]:
    """Number of parts from each plane to the nearest `free` one, below PLANES / 2."""
    index = jnp.arange(PLANES)
    under = jax.lax.cummax(jnp.where(free, index, -1), axis=2)[..., :-1]
    over = jax.lax.cummin(jnp.where(free, index, PLANES), axis=2, reverse=True)[..., 1:]
    return jnp.minimum(index[:-1] - under, over - index[1:])
