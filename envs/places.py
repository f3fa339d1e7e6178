"""Places of things: distributions of points, such as starts and goals. Nothing here needs JAX or MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass

from envs.arena import FREE, GOAL, ROBOT, Arena

Point = tuple[float, ...]


@dataclass(frozen=True)
class Places:
    """A distribution of points: uniform over a union of boxes, or over their corners if all are points.

    `lower` and `upper` are corners of the boxes, in m. A box is chosen by its volume, each with the same probability
    if none has any.
    """

    lower: tuple[Point, ...]
    upper: tuple[Point, ...]

    def resized(self, ratio: float) -> Places:
        """All places `ratio` times as far from the origin in x and y."""
        return Places(
            tuple(scaled(corner, ratio) for corner in self.lower),
            tuple(scaled(corner, ratio) for corner in self.upper),
        )


def scaled(point: Point, ratio: float) -> Point:
    """`point` with x and y, its first two coordinates, `ratio` times as large."""
    return (ratio * point[0], ratio * point[1], *point[2:])


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


def anywhere(arena: Arena, *, clearance: float) -> Places:
    """Anywhere in the free cells, `clearance` m from their sides."""
    return around(arena, FREE + ROBOT + GOAL, clearance=clearance)
