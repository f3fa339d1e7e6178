"""The abstraction: axis-aligned boxes, the regions, that cover the abstract state space exactly.

Regions live in arrays of static capacity R with a mask, so that a split changes values and never shapes.
Boxes are half-open, [lower, upper), except that the upper faces of the space belong to it. Splitting one box
in two keeps two invariants that every other module relies on: the active boxes cover the space, and no two
of them overlap. Both hold exactly in floating point, because neighbours share the very same number.

Source: the set-based abstraction N of Zadem, Mover and Nguyen, ICLR 2024, section 3.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Shaped
from numpy.typing import ArrayLike

from envs.common import modes

_CENTRES = 1e-3  # weight of the way between centres against the gap between boxes


class Abstraction(struct.PyTreeNode):
    """All regions of a run. R is the capacity, d the number of abstract dimensions."""

    lower: Float[Array, "R d"]
    upper: Float[Array, "R d"]
    count: Int[Array, ""]
    space: Float[Array, "2 d"]

    @property
    def capacity(self) -> int:
        """R, the largest possible number of regions."""
        return self.lower.shape[0]

    @property
    def active(self) -> Bool[Array, "R"]:
        """Mask of the regions in use; they are the first `count`."""
        return jnp.arange(self.capacity) < self.count


class Cut(NamedTuple):
    """The plane `state[dimension] == position` through one region."""

    region: Int[Array, ""]
    dimension: Int[Array, ""]
    position: Float[Array, ""]


class Split(struct.PyTreeNode):
    """A cut that was made (`done`) or not, and the region that is new by it."""

    done: Bool[Array, "*splits"]
    cut: Cut
    child: Int[Array, "*splits"]

    @property
    def parent(self) -> Int[Array, "*splits"]:
        """The region that was cut."""
        return self.cut.region


class Change(struct.PyTreeNode):
    """The change of the regions between two episodes: all that has a table of them follows it."""

    before: Abstraction
    after: Abstraction
    splits: Split
    """In the order in which they were made."""
    origin: Int[Array, "R"]
    """The region of `before` that each region of `after` is, or was cut from; of those not in use their own index."""

    @classmethod
    def of(cls, before: Abstraction, after: Abstraction, splits: Split) -> Change:
        """The change that `splits` [N] made."""

        def follow(origin: Array, split: Split) -> tuple[Array, None]:
            return jnp.where(split.done, origin.at[split.child].set(origin[split.parent]), origin), None

        origin = jax.lax.scan(follow, jnp.arange(after.capacity), splits)[0]
        return cls(before=before, after=after, splits=splits, origin=origin)


class Box(struct.PyTreeNode):
    """Boxes in the abstract dimensions, lower and upper corners [..., d]."""

    lower: Float[Array, "*batch d"]
    upper: Float[Array, "*batch d"]

    @classmethod
    def around(cls, point: Float[Array, "*batch d"], margin: float | Array) -> Box:
        """The box of half-width `margin` with `point` at its centre."""
        return cls(lower=point - margin, upper=point + margin)

    @property
    def centre(self) -> Float[Array, "*batch d"]:
        """The point in the middle."""
        return (self.lower + self.upper) / 2

    @property
    def corners(self) -> Float[Array, "*batch m"]:
        """Both corners as one vector."""
        return jnp.concatenate([self.lower, self.upper], axis=-1)

    def distance(self, point: Float[Array, "*batch d"], scale: Float[Array, "d"]) -> Float[Array, "*batch"]:
        """The distance of each `point` from its box, in units of `scale`; 0 within."""
        gap = jnp.maximum(jnp.maximum(self.lower - point, point - self.upper), 0.0)
        return jnp.linalg.norm(gap / scale, axis=-1)

    def seen_from(self, origin: Float[Array, "*batch d"]) -> Box:
        """The box relative to `origin`."""
        return Box(lower=self.lower - origin, upper=self.upper - origin)


class Near(struct.PyTreeNode):
    """The S regions near each one, itself included: tables of pairs have a place for each of them, and no others."""

    region: Int[Array, "R S"]
    """In ascending order."""
    place: Int[Array, "R R"]
    """Of each region (column) in the list of another (row); S, which is beyond a table, where it is not near."""

    @classmethod
    def of(cls, region: Int[Array, "R S"]) -> Near:
        """With these lists."""
        capacity, size = region.shape
        rows = jnp.arange(capacity)
        places = jnp.full((capacity, capacity), size, jnp.int32)
        return cls(region=region, place=places.at[rows[:, None], region].set(jnp.arange(size)))

    @classmethod
    def every(cls, capacity: int) -> Near:
        """All regions are near each other."""
        return cls.of(jnp.broadcast_to(jnp.arange(capacity), (capacity, capacity)))

    @property
    def own(self) -> Int[Array, "R"]:
        """The place of each region in its own list."""
        return jnp.diagonal(self.place)

    @property
    def home(self) -> Bool[Array, "R S"]:
        """Mask of the own place."""
        return self.region == jnp.arange(len(self.region))[:, None]

    def pairs(self, table: Shaped[Array, "R R"]) -> Shaped[Array, "R S"]:
        """The entries of a table of all pairs for those that are near."""
        return jnp.take_along_axis(table, self.region, axis=1)


class Places(NamedTuple):
    """The places of tables before and after cuts: regions were near `then` and are `now`, each a part of `origin`."""

    origin: Int[Array, "R"]
    then: Near
    now: Near

    @classmethod
    def of(cls, change: Change, number: int | None) -> Places:
        """Those of a change of the regions, of which so many are near (None: all)."""
        return cls(change.origin, near(change.before, number), near(change.after, number))

    @property
    def parts(self) -> Int[Array, "R S"]:
        """For each place of today, the earlier one of what was cut; S where that was not near."""
        return self.then.place[self.origin[:, None], self.origin[self.now.region]]


def near(abstraction: Abstraction, number: int | None) -> Near:
    """So many nearest regions (None: all), by the gap between boxes, then between centres, in units of the space."""
    capacity = abstraction.capacity
    if number is None or number >= capacity:
        return Near.every(capacity)
    size = abstraction.space[1] - abstraction.space[0]
    lower, upper = abstraction.lower / size, abstraction.upper / size
    gap = jnp.maximum(lower[:, None] - upper, lower - upper[:, None])
    between = (lower[:, None] + upper[:, None] - lower - upper) / 2
    length = partial(jnp.linalg.norm, axis=-1)
    away = length(jnp.maximum(gap, 0.0)) + _CENTRES * length(between)
    away = jnp.where(jnp.eye(capacity, dtype=bool), -1.0, jnp.where(abstraction.active, away, jnp.inf))
    return Near.of(jnp.sort(jax.lax.top_k(-away, number)[1], axis=1))


def create(space: tuple[ArrayLike, ArrayLike], cuts: Sequence[Sequence[float]], *, max_regions: int) -> Abstraction:
    """The grid of boxes between the cut positions `cuts[dimension]` of `space` (lower and upper corner, [d]).

    Raises:
      ValueError: if the cuts are not increasing inside the space, or there are more boxes than `max_regions`.
      UserError: if JAX is in a mode that nothing here runs in.

    """
    modes.check()
    low, high = (np.asarray(corner, np.float32) for corner in space)
    if len(cuts) != len(low):
        raise ValueError(f"{len(cuts)} lists of cuts for {len(low)} abstract dimensions")
    count = math.prod(len(positions) + 1 for positions in cuts)
    if count > max_regions:
        raise ValueError(f"{count} initial regions exceed abstraction.max_regions {max_regions}")
    intervals = []
    for dimension, positions in enumerate(cuts):
        with np.errstate(over="ignore"):  # what is too large becomes infinite, which is outside of the space
            edges = np.asarray([low[dimension], *positions, high[dimension]], np.float32)
        if not np.all(np.diff(edges) > 0):
            raise ValueError(
                f"{list(positions)} do not increase between {low[dimension]:g} and {high[dimension]:g} "
                f"in abstract dimension {dimension}"
            )
        intervals.append(list(itertools.pairwise(edges)))
    boxes = np.asarray(list(itertools.product(*intervals)), np.float32)
    lower, upper = np.zeros((2, max_regions, len(low)), np.float32)
    lower[:count], upper[:count] = boxes[..., 0], boxes[..., 1]
    return Abstraction(
        lower=jnp.asarray(lower),
        upper=jnp.asarray(upper),
        count=jnp.asarray(count, jnp.int32),
        space=jnp.asarray(np.stack([low, high])),
    )


def locate(abstraction: Abstraction, point: Float[Array, "*batch d"]) -> Int[Array, "*batch"]:
    """Index of the active region that holds each `point`.

    Boxes cover the space without overlap, so the answer is unique; a point outside the space goes to the region
    nearest to it.
    """
    low, high = abstraction.space
    inside = jnp.clip(point, low, high)[..., None, :]
    below_upper = (inside < abstraction.upper) | (abstraction.upper >= high)
    holds = jnp.all((abstraction.lower <= inside) & below_upper, axis=-1)
    return jnp.argmax(holds & abstraction.active, axis=-1)


def split(abstraction: Abstraction, cut: Cut, *, min_width: float | Array) -> tuple[Abstraction, Bool[Array, ""]]:
    """Cut one region in two: it keeps the part below the cut, the new region `count` gets the part above.

    Returns the abstraction unchanged, and False, if the table is full or a part would be narrower than `min_width`.
    """
    parent = cut.region
    below, above = abstraction.lower[parent, cut.dimension], abstraction.upper[parent, cut.dimension]
    wide_enough = (cut.position - below >= min_width) & (above - cut.position >= min_width)
    strictly_inside = (below < cut.position) & (cut.position < above)
    done = (abstraction.count < abstraction.capacity) & (parent < abstraction.count) & wide_enough & strictly_inside
    child = jnp.minimum(abstraction.count, abstraction.capacity - 1)
    lower = abstraction.lower.at[child].set(abstraction.lower[parent]).at[child, cut.dimension].set(cut.position)
    upper = abstraction.upper.at[child].set(abstraction.upper[parent]).at[parent, cut.dimension].set(cut.position)
    return (
        abstraction.replace(
            lower=jnp.where(done, lower, abstraction.lower),
            upper=jnp.where(done, upper, abstraction.upper),
            count=abstraction.count + done.astype(jnp.int32),
        ),
        done,
    )


def adjacent(abstraction: Abstraction) -> Bool[Array, "R R"]:
    """Mask of active regions that share a face; none is its own neighbour."""
    lower = jnp.maximum(abstraction.lower[:, None], abstraction.lower[None])
    upper = jnp.minimum(abstraction.upper[:, None], abstraction.upper[None])
    faces = jnp.all(lower <= upper, axis=-1) & (jnp.sum(lower < upper, axis=-1) == lower.shape[-1] - 1)
    return faces & abstraction.active[:, None] & abstraction.active[None]


def over_parts(table: Float[Array, "*R"], origin: Int[Array, "R"]) -> Float[Array, "*R"]:
    """Sums of `table` along all its axes, each of regions, over the parts of what a region was cut from (`origin`)."""
    cell = jnp.ix_(*[origin] * table.ndim)
    return jnp.zeros_like(table).at[cell].add(table)[cell]


def moved(table: Array, places: Int[Array, "R S"], *, axis: int, rows: int = 0) -> Array:
    """The `table` with the entries at these `places` of each row along `axis`, and 0 where they are beyond it.

    `rows` is the axis of what the rows of `places` are about.
    """
    shape = [1] * table.ndim
    shape[rows], shape[axis] = places.shape
    return jnp.take_along_axis(table, places.reshape(shape), axis=axis, mode="fill", fill_value=0)


def inherit(table: Array, origin: Int[Array, "R"], *, axes: Sequence[int] | None = None) -> Array:
    """The `table` of regions of which j was cut from `origin` [j], along its `axes` of regions (None: all)."""
    for axis in range(table.ndim) if axes is None else axes:
        table = jnp.take(table, origin, axis=axis, mode="clip")
    return table
