"""Maze maps: rows of text, the rectangles they stand for, and the MuJoCo model of a body among them.

A map has a row of characters for each row of cells: `1` wall, `0` free, `r` free and the robot's cell. The centre
of the robot's cell is the origin, +x runs right along a row, +y runs down the rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

WALL = "1"
ROBOT = "r"
FLOOR_COLOUR = (0.8, 0.8, 0.8, 1.0)
WALL_COLOUR = (0.4, 0.5, 0.6, 1.0)


@dataclass(frozen=True)
class Arena:
    """A maze. `rows` are strings of equal length, `cell` is the side of a cell and `wall_height` a height, in m."""

    rows: tuple[str, ...]
    cell: float
    wall_height: float

    @cached_property
    def origin(self) -> tuple[int, int]:
        """(row, column) of the robot's cell."""
        return next((r, row.index(ROBOT)) for r, row in enumerate(self.rows) if ROBOT in row)

    @cached_property
    def bounds(self) -> np.ndarray:
        """The outline of the whole map, walls included: (x_lo, y_lo, x_hi, y_hi)."""
        return self._rectangle(0, 0, len(self.rows), len(self.rows[0]))

    def walls(self) -> np.ndarray:
        """Merged wall rectangles [n, 4] as (x_lo, y_lo, x_hi, y_hi); they cover the wall cells without overlap."""
        return self._merged(lambda cell: cell == WALL)

    def free(self) -> np.ndarray:
        """Merged rectangles of the cells without a wall [n, 4], as (x_lo, y_lo, x_hi, y_hi)."""
        return self._merged(lambda cell: cell != WALL)

    def _merged(self, wanted: Callable[[str], bool]) -> np.ndarray:
        left = {(r, c) for r, row in enumerate(self.rows) for c, cell in enumerate(row) if wanted(cell)}
        rectangles = []
        while left:
            top, begin = min(left)
            end = begin
            while (top, end) in left:
                end += 1
            bottom = top
            while all((bottom, c) in left for c in range(begin, end)):
                bottom += 1
            left -= {(r, c) for r in range(top, bottom) for c in range(begin, end)}
            rectangles.append(self._rectangle(top, begin, bottom, end))
        return np.array(rectangles)

    def _rectangle(self, top: int, left: int, bottom: int, right: int) -> np.ndarray:
        row, column = self.origin
        corners = np.array([left - column, top - row, right - column, bottom - row], np.float64)
        return (corners - 0.5) * self.cell


def build_model(arena: Arena, body_xml: str, options: Mapping[str, Any]) -> mujoco.MjModel:
    """The MuJoCo model of a body in an arena: floor at z = 0, one box for each merged wall.

    Floor and walls take the contact parameters of the body's default class. They have contype 0 and conaffinity 1,
    so that they never meet each other, and no margin of their own, so that contacts begin at the body's margin:
    MuJoCo adds the margins of two geoms. `options` are attributes of `MjSpec.option`.
    """
    spec = mujoco.MjSpec.from_string(body_xml)
    for name, value in options.items():
        setattr(spec.option, name, value)
    static: dict[str, Any] = {"contype": 0, "conaffinity": 1, "margin": 0.0}
    x_lo, y_lo, x_hi, y_hi = arena.bounds
    middle, half = [(x_lo + x_hi) / 2, (y_lo + y_hi) / 2], [(x_hi - x_lo) / 2, (y_hi - y_lo) / 2]
    world = spec.worldbody
    world.add_light(pos=[*middle, 40.0], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[*middle, 0.0],
        size=[*half, 0.1],
        rgba=FLOOR_COLOUR,
        **static,
    )
    for i, wall in enumerate(arena.walls()):
        world.add_geom(
            name=f"wall_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*(wall[:2] + wall[2:]) / 2, arena.wall_height / 2],
            size=[*(wall[2:] - wall[:2]) / 2, arena.wall_height / 2],
            rgba=WALL_COLOUR,
            **static,
        )
    return spec.compile()
