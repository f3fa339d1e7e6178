"""Reachability by abstract interpretation: the part of a box that F_k carries into the target region.

A box is pushed through the forward model as a zonotope {c + sum_i e_i G_i : e in [-1, 1]^m}. Affine layers are
exact; a ReLU whose input may have either sign is relaxed as in DeepZ (Singh et al. 2018):

    y = lambda x + mu +- mu,   lambda = u / (u - l),   mu = -lambda l / 2        for l < 0 < u

The box hull R of the image gives two shares (STAR, ICLR 2024, section 4.3, after AI2, Gehr et al. 2018):
c1 = vol(R n G) / vol(R) and c2 = vol(R n G) / vol(G). With c1 >= `reach_share` the box REACHES, with
c2 <= `miss_share` it MISSES, otherwise it is halved along the dimension of largest smear and each half is judged,
down to 2^-depth of the start. Boxes that agents hardly visited are not looked into, and where there is not room for
all parts, each round of halving has its share of it and begins with those visited most: precision goes where the
agents are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

UNKNOWN, REACHES, MISSES, MIXED = 0, 1, 2, 3

ROUNDING = 2.0**-23  # twice the largest relative error of a float32 operation


class Network(struct.PyTreeNode):
    """x -> f(x), or x + f(x) if `residual`; f is made of `layers` (weight [out, in], bias [out]) with ReLU between.

    Where the biases were computed themselves, `doubt` has for each layer a bound on their errors [out].
    """

    layers: Sequence[tuple[Float[Array, "out in"], Float[Array, "out"]]]
    residual: bool = struct.field(pytree_node=False, default=False)
    doubt: Sequence[Float[Array, "out"]] = ()

    def affine(self, i: int, z: Zonotope) -> Zonotope:
        """Image under layer `i`."""
        image = affine(z, *self.layers[i])
        return image.replace(slack=image.slack + self.doubt[i]) if self.doubt else image


class Zonotope(struct.PyTreeNode):
    """Centre, generators (one a row) and `slack`: a bound on what float32 rounding may have moved each coordinate."""

    centre: Float[Array, "n"]
    generators: Float[Array, "m n"]
    slack: Float[Array, "n"]

    @property
    def radius(self) -> Float[Array, "n"]:
        """Half-widths of the box hull."""
        return jnp.abs(self.generators).sum(axis=0) + self.slack


class Leaves(struct.PyTreeNode):
    """The parts [P] of an examined box, whether each was shown to reach the target, and whether agents were there.

    Places not `used` hold no part: they have no volume, do not reach and were not visited.
    """

    lower: Float[Array, "P d"]
    upper: Float[Array, "P d"]
    reaches: Bool[Array, "P"]
    visited: Bool[Array, "P"]
    used: Bool[Array, "P"]


class Parts(NamedTuple):
    """The parts of a box on the way to its `Leaves`, in the first `number` of P places."""

    lower: Float[Array, "P d"]
    upper: Float[Array, "P d"]
    number: Int[Array, ""]
    part: Int[Array, "N"]
    """Of each start state the part that it lies in."""
    looked: tuple[Int[Array, "P"], Int[Array, "P"], Float[Array, "P"]]
    """Verdict of each part, and dimension and position of the plane that would halve it."""
    visits: Float[Array, "P"]


def from_box(lower: Float[Array, "n"], upper: Float[Array, "n"]) -> Zonotope:
    """The box [lower, upper] as a zonotope with one generator per dimension."""
    centre = (lower + upper) / 2
    slack = ROUNDING * (jnp.abs(lower) + jnp.abs(upper))
    return Zonotope(centre=centre, generators=jnp.diag((upper - lower) / 2), slack=slack)


def affine(z: Zonotope, weight: Float[Array, "out n"], bias: Float[Array, "out"]) -> Zonotope:
    """Image under x -> W x + b, exact but for rounding, which is bounded."""
    dot = lambda a, b: jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)  # noqa: E731
    magnitude = dot(jnp.abs(weight), jnp.abs(z.centre) + z.radius) + jnp.abs(bias)
    return Zonotope(
        centre=dot(weight, z.centre) + bias,
        generators=dot(z.generators, weight.T),
        slack=dot(jnp.abs(weight), z.slack) + (weight.shape[1] + z.generators.shape[0] + 4) * ROUNDING * magnitude,
    )


def _add_input(z: Zonotope, box: Zonotope) -> Zonotope:
    """X + f(x) for the image `z` of `box` under f: they share the first generators, so x does not count twice."""
    n = box.centre.shape[0]
    return Zonotope(
        centre=box.centre + z.centre,
        generators=z.generators.at[:n].add(box.generators),
        slack=box.slack + z.slack + 4 * ROUNDING * (jnp.abs(box.centre) + box.radius + jnp.abs(z.centre) + z.radius),
    )


def relu(z: Zonotope) -> Zonotope:
    """Smallest-area DeepZ relaxation of max(x, 0); adds one generator per coordinate."""
    low, high = z.centre - z.radius, z.centre + z.radius
    crossing = (low < 0) & (high > 0)
    slope = jnp.where(crossing, high / jnp.where(crossing, high - low, 1.0), (low >= 0).astype(low.dtype))
    offset = jnp.where(crossing, -slope * low / 2, 0.0)
    return Zonotope(
        centre=slope * z.centre + offset,
        generators=jnp.concatenate([z.generators * slope, jnp.diag(offset)]),
        slack=slope * z.slack + 4 * ROUNDING * (jnp.abs(z.centre) + z.radius),
    )


def hull(network: Network, lower: Float[Array, "n"], upper: Float[Array, "n"]) -> tuple[Array, Array]:
    """Box that contains the image of the box [lower, upper] under `network`."""
    return pushed(network, lower, upper)[0]


def smear(network: Network, lower: Float[Array, "n"], upper: Float[Array, "n"]) -> Float[Array, "n"]:
    """Per input: the sum over outputs of the largest |derivative| in the box, times the box's half-width there."""
    return pushed(network, lower, upper)[1]


def pushed(
    network: Network, lower: Float[Array, "n"], upper: Float[Array, "n"]
) -> tuple[tuple[Array, Array], Float[Array, "n"]]:
    """`hull` and `smear` of the box [lower, upper], by one way through `network`."""
    layers, box = network.layers, from_box(lower, upper)
    z = network.affine(0, box)
    low, high = layers[0][0], layers[0][0]
    for i, (weight, _) in enumerate(layers[1:], 1):
        off = (z.centre + z.radius <= 0)[:, None]
        surely_on = (z.centre - z.radius >= 0)[:, None]
        low = jnp.where(surely_on, low, jnp.where(off, 0.0, jnp.minimum(low, 0.0)))
        high = jnp.where(surely_on, high, jnp.where(off, 0.0, jnp.maximum(high, 0.0)))
        positive, negative = jnp.maximum(weight, 0.0), jnp.minimum(weight, 0.0)
        low, high = positive @ low + negative @ high, positive @ high + negative @ low
        z = network.affine(i, relu(z))
    if network.residual:
        low, high = low + jnp.eye(low.shape[0]), high + jnp.eye(low.shape[0])
        z = _add_input(z, box)
    steepest = jnp.maximum(jnp.abs(low), jnp.abs(high)).sum(axis=0)
    return (z.centre - z.radius, z.centre + z.radius), steepest * (upper - lower) / 2


def shares(
    lower: Float[Array, "d"], upper: Float[Array, "d"], target: tuple[Float[Array, "d"], Float[Array, "d"]]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(c1, c2): the shares of the hull and of the target that lie in both.

    Dimensions in which the hull is flat have no volume; there it lies in the target or it does not.
    """
    width, target_width = upper - lower, target[1] - target[0]
    overlap = jnp.maximum(jnp.minimum(upper, target[1]) - jnp.maximum(lower, target[0]), 0.0)
    flat = width <= 1e-6 * target_width
    inside = ((target[0] <= lower) & (upper <= target[1])).astype(width.dtype)
    c1 = jnp.prod(jnp.where(flat, inside, overlap / jnp.where(flat, 1.0, width)))
    c2 = jnp.prod(jnp.where(flat, inside, overlap / target_width))
    return c1, c2


def judge(
    lower: Float[Array, "d"],
    upper: Float[Array, "d"],
    target: tuple[Float[Array, "d"], Float[Array, "d"]],
    *,
    reach_share: float | Array,
    miss_share: float | Array,
) -> Int[Array, ""]:
    """REACHES, MISSES or UNKNOWN for a hull against a target."""
    c1, c2 = shares(lower, upper, target)
    return jnp.where(c1 >= reach_share, REACHES, jnp.where(c2 <= miss_share, MISSES, UNKNOWN))


def examine(
    network: Network,
    box: tuple[Float[Array, "d"], Float[Array, "d"]],
    target: tuple[Float[Array, "d"], Float[Array, "d"]],
    starts: Float[Array, "N d"],
    seen: Float[Array, "N"],
    *,
    depth: int,
    parts: int,
    reach_share: float | Array,
    miss_share: float | Array,
    min_visits: int,
) -> Leaves:
    """Judge `box` against `target`, halving what is undecided `depth` times, into `parts` parts at most.

    `network` maps an abstract state [d] to the abstract state k steps after commanding `target`. A part reaches only
    if at least `min_visits` of the start states `starts` with mask `seen` lie in it. What stays undecided does not.
    """

    @jax.vmap
    def look(lower: Array, upper: Array) -> tuple[Array, Array, Array]:
        """The verdict, and the plane that would halve the part: its dimension of largest smear, and the middle."""
        image, smears = pushed(network, lower, upper)
        dimension = jnp.argmax(smears)
        verdict = judge(*image, target, reach_share=reach_share, miss_share=miss_share)
        return verdict, dimension, (lower[dimension] + upper[dimension]) / 2

    place = jnp.arange(parts)
    inside = jnp.all((box[0] <= starts) & (starts < box[1]), axis=-1) * seen

    def is_open(now: Parts) -> Bool[Array, "P"]:
        return (now.looked[0] == UNKNOWN) & (now.visits >= min_visits) & (place < now.number)

    def goes_on(carry: tuple[Array, Parts]) -> Array:
        rounds_left, now = carry
        return (rounds_left > 0) & (now.number < parts) & is_open(now).any()

    def halve_open(carry: tuple[Array, Parts]) -> tuple[Array, Parts]:
        rounds_left, now = carry
        room = (parts - now.number + rounds_left - 1) // rounds_left
        lower, upper, number, part = _halved(now, is_open(now), starts, most=room)
        return rounds_left - 1, Parts(lower, upper, number, part, look(lower, upper), _visits(part, inside, parts))

    empty = jnp.broadcast_to(box[1], (parts, len(box[1])))
    lower, part = empty.at[0].set(box[0]), jnp.zeros(starts.shape[0], jnp.int32)
    whole = Parts(lower, empty, jnp.ones((), jnp.int32), part, look(lower, empty), _visits(part, inside, parts))
    _, (lower, upper, count, _, (found, *_), visits) = jax.lax.while_loop(
        goes_on, halve_open, (jnp.asarray(depth), whole)
    )
    used, enough = place < count, visits >= min_visits
    return Leaves(
        lower=lower, upper=upper, reaches=used & enough & (found == REACHES), visited=used & enough, used=used
    )


def summary(leaves: Leaves) -> Int[Array, ""]:
    """REACHES if all leaves reach, MISSES if none does, else MIXED."""
    some, every = leaves.reaches.any(), (leaves.reaches | ~leaves.used).all()
    return jnp.where(every, REACHES, jnp.where(some, MIXED, MISSES))


def reaches_where_visited(leaves: Leaves) -> Bool[Array, ""]:
    """True if there are visited leaves and all of them reach."""
    return leaves.visited.any() & (leaves.reaches | ~leaves.visited).all()


def _halved(
    now: Parts, open_: Bool[Array, "P"], starts: Float[Array, "N d"], *, most: Int[Array, ""]
) -> tuple[Float[Array, "P d"], Float[Array, "P d"], Int[Array, ""], Int[Array, "N"]]:
    """Corners, number and `part` after halving `open_` parts, at `most` so many, those with most visits first."""
    lower, upper, number, part, (_, dimension, middle), visits = now
    places, d = lower.shape
    rank = jnp.argsort(jnp.argsort(jnp.where(open_, -visits, 1.0)))  # closed ones last
    halved = open_ & (rank < most)
    twin = jnp.where(halved, number + rank, places)  # where the upper half goes
    at_middle = halved[:, None] & (jnp.arange(d) == dimension[:, None])
    moved = halved[part] & (starts[jnp.arange(len(starts)), dimension[part]] >= middle[part])
    part = jnp.where(moved, twin[part], part)
    lower = lower.at[twin].set(jnp.where(at_middle, middle[:, None], lower), mode="drop")
    upper = jnp.where(at_middle, middle[:, None], upper).at[twin].set(upper, mode="drop")
    return lower, upper, number + halved.sum(), part


def _visits(part: Int[Array, "N"], counted: Float[Array, "N"], parts: int) -> Float[Array, "P"]:
    """Sums of `counted` in each part. Most starts lie elsewhere: left out, they do not wait for one another."""
    return jnp.zeros(parts).at[jnp.where(counted > 0, part, parts)].add(counted, mode="drop")
