"""Maze maps: rows of text, the rectangles they stand for, and where they come from.

A map has a row of characters for each row of cells:

    1  wall            0  free             r  free, and the robot starts here      g  free, and a goal
    #  no floor        B  movable block    D  gate (door)

A map of the user's own looks as it is written: +x runs right along a row, +y up from row to row. The centre of its
lowest robot's cell, of several the leftmost, is the origin. Walls, blocks and gates are 4 m high whatever the size of
the cells, so that no ant leaps over them, but for walls of tasks that say otherwise. If a map has cells without floor,
the floor of all others is raised by 4 m.
"""

from __future__ import annotations

import re
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from envs.common import reading
from envs.common.errors import Notice, shown
from envs.options import CELL_SIZES, EnvError

WALL, FREE, ROBOT, GOAL, CHASM, BLOCK, GATE = "10rg#BD"
SYMBOLS = (WALL, FREE, ROBOT, GOAL, CHASM, BLOCK, GATE)
HEIGHT = 4.0  # of walls, blocks, gates and the raised floor, in m
MAX_CELLS = 64  # along a side
BLOCK_AXES = ("x", "y", "xy", "yz", "xz", "xyz")

Cell = tuple[int, int]


@dataclass(frozen=True)
class Arena:
    """A maze. `rows` are strings of equal length, from the lowest y up, `cell` is the side of a cell in m.

    `block` names the axes along which the blocks `B` slide: some of x, y and z; along z they fall. `wall_height` is
    that of the walls above the floor, in m.
    """

    rows: tuple[str, ...]
    cell: float
    block: str = "xy"
    wall_height: float = HEIGHT

    @cached_property
    def origin(self) -> Cell:
        """(row, column) of the first robot's cell."""
        return next(self.cells(ROBOT))

    @cached_property
    def floor_height(self) -> float:
        """Height of the floor, in m: 0 unless there are cells without floor."""
        return HEIGHT if any(self.cells(CHASM)) else 0.0

    @cached_property
    def bounds(self) -> np.ndarray:
        """The outline of the whole map, walls included: (x_lo, y_lo, x_hi, y_hi)."""
        return self._rectangle(0, 0, len(self.rows), len(self.rows[0]))

    def cells(self, symbols: str) -> Iterator[Cell]:
        """(row, column) of the cells that hold one of `symbols`, row by row."""
        return ((r, c) for r, row in enumerate(self.rows) for c, symbol in enumerate(row) if symbol in symbols)

    def centres(self, symbols: str) -> np.ndarray:
        """Centres [n, 2] of the cells that hold one of `symbols`, in m."""
        return np.array([self.centre(cell) for cell in self.cells(symbols)])

    def centre(self, cell: Cell) -> tuple[float, float]:
        """Centre (x, y) of a cell, in m."""
        row, column = self.origin
        return ((cell[1] - column) * self.cell, (cell[0] - row) * self.cell)

    def walls(self) -> np.ndarray:
        """Merged wall rectangles [n, 4] as (x_lo, y_lo, x_hi, y_hi); they cover the wall cells without overlap."""
        return self._merged(lambda symbol: symbol == WALL)

    def free(self) -> np.ndarray:
        """Merged rectangles of the cells without a wall [n, 4], as (x_lo, y_lo, x_hi, y_hi)."""
        return self._merged(lambda symbol: symbol != WALL)

    def floors(self) -> np.ndarray:
        """Merged rectangles of the cells with a floor and without a wall [n, 4]."""
        return self._merged(lambda symbol: symbol not in (WALL, CHASM))

    def chasms(self) -> np.ndarray:
        """Merged rectangles of the cells without floor [n, 4]."""
        return self._merged(lambda symbol: symbol == CHASM)

    def gates(self) -> np.ndarray:
        """Merged rectangles of the gates [n, 4]."""
        return self._merged(lambda symbol: symbol == GATE)

    def cell_at(self, point: Any) -> Cell:
        """(row, column) of the cell that holds `point` (x, y), in m."""
        row, column = self.origin
        return row + floor(point[1] / self.cell + 0.5), column + floor(point[0] / self.cell + 0.5)

    def grid(self, parts: int) -> np.ndarray:
        """`parts` x `parts` equal rectangles over all free cells, row by row, without those nobody can go to: [n, 4].

        Kept are those whose middle is on a floor, neither in a wall nor in a block or gate, nor cut off from the start.
        """
        free, walked = self.free(), _walk(self)
        xs, ys = (np.linspace(free[:, i].min(), free[:, i + 2].max(), parts + 1) for i in (0, 1))
        whole = np.array([(xs[c], ys[r], xs[c + 1], ys[r + 1]) for r in range(parts) for c in range(parts)])
        cells = [self.cell_at(middle) for middle in (whole[:, :2] + whole[:, 2:]) / 2]
        return whole[[cell in walked and self.rows[cell[0]][cell[1]] in FREE + ROBOT + GOAL for cell in cells]]

    def _merged(self, wanted: Callable[[str], bool]) -> np.ndarray:
        left = {(r, c) for r, row in enumerate(self.rows) for c, symbol in enumerate(row) if wanted(symbol)}
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
        return np.array(rectangles).reshape(-1, 4)

    def _rectangle(self, top: int, left: int, bottom: int, right: int) -> np.ndarray:
        row, column = self.origin
        corners = np.array([left - column, top - row, right - column, bottom - row], np.float64)
        return (corners - 0.5) * self.cell


def read_arena(source: str, *, cell: float) -> Arena:
    """The arena of a user's map: the path of a file, or what would be in it if `source` has several lines.

    It is either the rows as plain text, the uppermost first, or YAML with the rows as a block of text under `map` and,
    if wanted, `cell` (m) and `block` (axes). `cell` is the size of cells that the map does not give. Free cells that
    cannot be reached become walls, which a `Notice` tells.

    Raises:
      EnvError: in one line that names the file, and the row and column counted from 1.
    """
    source = source.strip()
    name, text = "map" if "\n" in source else f"map {_short(source)}", load(source)
    yaml_map = re.search(r"^\s*\w+\s*:", text, re.M)
    arena = check(_from_yaml(text, cell, name=name) if yaml_map else Arena(_rows(text), _size(cell, name)), name=name)
    sealed = unreached(arena)
    if sealed:
        r, c = sealed[0]
        cells = "1 free cell" if len(sealed) == 1 else f"{len(sealed)} free cells"
        where = f'cannot be reached from "{ROBOT}", the first at row {r + 1}, column {c + 1}'
        warnings.warn(Notice(f"{name}: {cells} {where}: taken for walls, without goals or starts"), stacklevel=2)
    written = walled(arena, sealed)
    return replace(written, rows=written.rows[::-1])


def load(source: str) -> str:
    """The text of a map given as `read_arena` takes it; raises `EnvError` if there is no such file."""
    if "\n" in source.strip():
        return source
    try:
        return reading.text(Path(source))
    except OSError as error:
        raise EnvError(f"map {_short(source)}: cannot be read from {Path.cwd()}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise EnvError(f"map {_short(source)}: is not a text file") from None


def _short(path: str) -> str:
    return path if len(path) <= 200 else f"{path[:197]}..."


def _rows(text: str) -> tuple[str, ...]:
    return tuple(line.strip() for line in text.strip().splitlines())


def _size(cell: Any, name: str) -> float:
    """The size of cells in m; raises `EnvError` if it is none."""
    if type(cell) not in (int, float) or not CELL_SIZES[0] <= cell <= CELL_SIZES[1]:
        raise EnvError(f"{name}: cell is {shown(cell)}; allowed: {CELL_SIZES[0]} to {CELL_SIZES[1]} m")
    return float(cell)


def _from_yaml(text: str, cell: float, *, name: str) -> Arena:
    try:
        values = reading.plain(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise EnvError(f"{name}: is not YAML{where}: {reading.problem(error)}") from None
    if not isinstance(values, dict) or not isinstance(values.get("map"), str):
        raise EnvError(f'{name}: needs the rows as a block of text: "map: |", then one line for each row')
    given: dict[Any, Any] = {"cell": cell, "block": "xy"} | values
    for key in given:
        if key not in ("map", "cell", "block"):
            raise EnvError(f'{name}: key "{_short(str(key))}" is unknown; allowed: map, cell, block')
    if given["block"] not in BLOCK_AXES:
        raise EnvError(f"{name}: block is {shown(given['block'])}; allowed: {', '.join(BLOCK_AXES)}")
    return Arena(_rows(values["map"]), _size(given["cell"], name), given["block"])


def check(arena: Arena, *, name: str) -> Arena:
    """`arena` itself, if a body can live in it; raises `EnvError` in one line that begins with `name`.

    Rows are counted as they stand.
    """
    rows = arena.rows
    if not rows or not rows[0]:
        raise EnvError(f"{name}: is empty")
    if max(len(rows), len(rows[0])) > MAX_CELLS:
        raise EnvError(f"{name}: has {len(rows)} rows of {len(rows[0])} cells; allowed: up to {MAX_CELLS} of each")
    for r, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise EnvError(f"{name}: row {r + 1} has {len(row)} cells, row 1 has {len(rows[0])}")
        for c, symbol in enumerate(row):
            if symbol not in SYMBOLS:
                raise EnvError(f"{name}: row {r + 1}, column {c + 1} is {symbol!r}; allowed: {' '.join(SYMBOLS)}")
            if symbol != WALL and (r in (0, len(rows) - 1) or c in (0, len(row) - 1)):
                raise EnvError(f"{name}: row {r + 1}, column {c + 1} is {symbol!r}; the outline must be walls (1)")
    if not any(arena.cells(ROBOT)):
        raise EnvError(f'{name}: has no start; mark the cell of the robot with "{ROBOT}"')
    if any(arena.cells(BLOCK)) and "z" in arena.block and not arena.floor_height:
        raise EnvError(f"{name}: block is {arena.block!r}, but no cell is without floor ({CHASM}) to fall into")
    reached = _walk(arena).keys()
    for r, c in arena.cells(GOAL):
        if (r, c) not in reached:
            raise EnvError(f'{name}: the goal at row {r + 1}, column {c + 1} cannot be reached from "{ROBOT}"')
    if reached.isdisjoint(arena.cells(FREE + GOAL)):
        raise EnvError(f'{name}: has no free cell beside the start; mark free cells with "{FREE}"')
    return arena


def unreached(arena: Arena) -> list[Cell]:
    """The free cells (row, column) to which no way leads from the start, row by row."""
    reached = _walk(arena)
    return [cell for cell in arena.cells(FREE) if cell not in reached]


def walled(arena: Arena, cells: Iterable[Cell]) -> Arena:
    """`arena` with walls in place of `cells`."""
    filled = set(cells)
    rows = ("".join(WALL if (r, c) in filled else s for c, s in enumerate(row)) for r, row in enumerate(arena.rows))
    return replace(arena, rows=tuple(rows))


def farthest(arena: Arena) -> tuple[float, float]:
    """Centre (x, y) of the free cell that is the longest walk from the robot's, in m; of several, the last."""
    steps = _walk(arena)
    free = (cell for cell in steps if arena.rows[cell[0]][cell[1]] == FREE)
    return arena.centre(max(free, key=lambda cell: (steps[cell], cell)))


def _walk(arena: Arena) -> dict[Cell, int]:
    """Steps from the robot to each cell it can walk to. A gate can open; a block that falls may bridge a chasm."""
    bridged = any(arena.cells(BLOCK)) and "z" in arena.block
    barred = WALL if bridged else WALL + CHASM
    steps = {cell: 0 for cell in arena.cells(ROBOT)}
    waiting = deque(steps)
    while waiting:
        r, c = waiting.popleft()
        for near in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
            if near not in steps and arena.rows[near[0]][near[1]] not in barred:
                steps[near] = steps[r, c] + 1
                waiting.append(near)
    return steps


def resized(arena: Arena, cell: float) -> Arena:
    """The same map with cells of `cell` m."""
    return replace(arena, cell=cell)
