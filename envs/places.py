"""Places of things: distributions of points, such as starts and goals. Nothing here needs JAX or MuJoCo."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from envs.arena import FREE, GOAL, ROBOT, Arena, Cell

Point = tuple[float, ...]


@dataclass(frozen=True)
class Places:
    """A distribution of points: uniform over a union of boxes, or over their corners if all are points.

    `lower` and `upper` are corners of the boxes, in m. A box is chosen by its volume, each with the same probability
    if none has any.
    """

    lower: tuple[Point, ...]
    upper: tuple[Point, ...]

    def resized(self, ratio: float, *, dims: int = 2) -> Places:
        """All places `ratio` times as far from the origin in their first `dims` coordinates; a pair has 4."""
        return Places(
            tuple(scaled(corner, ratio, dims=dims) for corner in self.lower),
            tuple(scaled(corner, ratio, dims=dims) for corner in self.upper),
        )


def scaled(point: Point, ratio: float, *, dims: int = 2) -> Point:
    """`point` with its first `dims` coordinates, by default x and y, `ratio` times as large."""
    return (*(ratio * x for x in point[:dims]), *point[dims:])


def box(lower: Point, upper: Point) -> Places:
    """Uniform in one box."""
    return Places((lower,), (upper,))


def point(*coordinates: float) -> Places:
    """Always the same point."""
    return box(coordinates, coordinates)


def circle(radius: float, *, parts: int) -> Places:
    """So many points on the circle of `radius` m around the origin, equally far apart, all alike."""
    angles = (2 * math.pi * part / parts for part in range(parts))
    found = tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)
    return Places(found, found)


def centres(arena: Arena, symbols: str) -> Places:
    """The centres of the cells that hold one of `symbols`, all alike."""
    found = tuple(tuple(map(float, centre)) for centre in arena.centres(symbols))
    return Places(found, found)


def around(arena: Arena, symbols: str, *, clearance: float, height: Point = ()) -> Places:
    """Anywhere in the cells that hold one of `symbols`, `clearance` m from their sides; `height` is appended."""
    half = max(arena.cell / 2 - clearance, 0.0)
    found = [tuple(map(float, centre)) for centre in arena.centres(symbols)]
    return Places(
        tuple((x - half, y - half, *height) for x, y in found), tuple((x + half, y + half, *height) for x, y in found)
    )


def pairs(arena: Arena, cells: Iterable[tuple[Cell, Cell]], *, noise: float) -> Places:
    """Starts and their goals (x, y, x, y) from pairs of cells, all alike.

    Each lies within `noise` m of the centre of its cell, along x and along y.
    """
    centres = [(*arena.centre(start), *arena.centre(goal)) for start, goal in cells]
    return Places(*(tuple(tuple(x + side for x in centre) for centre in centres) for side in (-noise, noise)))


def anywhere(arena: Arena, *, clearance: float) -> Places:
    """Anywhere in the free cells, `clearance` m from their sides."""
    return around(arena, FREE + ROBOT + GOAL, clearance=clearance)
