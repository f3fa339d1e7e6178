"""The shortest ways through a maze: `routes` from the centre of one cell to those of others, `distances` of any points.

A route goes from a cell to one of its four neighbours that is free. If there is no other, it goes through a gate,
which the body opens by going to its switch first, or pushes a block, which slides a cell ahead of the body along its
axes and bridges the gap that it falls into. No route moves more than one block.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import shortest_path

from envs.arena import BLOCK, CHASM, FREE, GATE, GOAL, ROBOT, WALL, Arena, Cell
from envs.tasks import Switch

Point = tuple[float, float]

MAX_CORNERS = 256  # of a maze in which `distances` are told
_PINCH = 1e-3  # share of a cell that is closed where two of them touch with their corners
_EDGE = 1e-6  # m of a wall's side that count as outside
_AT_ONCE = 20_000  # segments looked at together
_HEADINGS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # one cell along +x, +y, -x, -y


class _Situation(NamedTuple):
    """Place of the body, the way it came along, from where to where it pushed a block, and whether gates are open."""

    cell: Cell
    heading: int
    block: tuple[Cell, ...]
    open: bool


def routes(arena: Arena, start: Cell, goals: Collection[Cell], switch: Switch | None = None) -> dict[Cell, list[Point]]:
    """A shortest way to each of `goals` that can be reached from `start`: where it turns, and its end, in m.

    Of several ways it is the one with the fewest pushes, then steps, then turns. The start is not part of it; the
    point where the `switch` opens the gates is, if the way goes through one.
    """
    switches = dict(_switches(arena, switch)) if switch else {}
    found: dict[Cell, _Situation] = {}
    first = _Situation(start, -1, (), start in switches)
    before: dict[_Situation, _Situation | None] = {first: None}
    costs = {first: (0, 0, 0)}
    waiting = [(costs[first], first)]
    while waiting and len(found) < len(goals):
        cost, here = heappop(waiting)
        if cost > costs[here]:
            continue
        if here.cell in goals:
            found.setdefault(here.cell, here)
        for there in _moves(arena, here, switches):
            pushes, steps, turns = cost
            new = (pushes + (there.block != here.block), steps + 1, turns + (there.heading != here.heading))
            if there not in costs or new < costs[there]:
                costs[there], before[there] = new, here
                heappush(waiting, (new, there))
    return {goal: _turns(arena, _way(before, end), switches) for goal, end in found.items()}


def distances(arena: Arena, starts: np.ndarray, ends: np.ndarray) -> np.ndarray | None:
    """Lengths [n], in m, of the shortest ways from `starts` [n, 2] to `ends` [n, 2] around walls and gaps.

    They are ways of a point, straight from corner to corner, so no body goes a shorter one; infinite where there is
    none. None if the arena has blocks or gates, which ways depend on, or more than `MAX_CORNERS` corners.
    """
    corners = _corners(arena)
    if any(arena.cells(BLOCK + GATE)) or len(corners) > MAX_CORNERS:
        return None
    runs = _runs(arena)
    between = shortest_path(_straight(corners, corners, runs))
    from_start, to_end = (_straight(points, corners, runs) for points in (starts, ends))
    blocked = _blocked(starts, ends, runs)
    found = np.where(blocked, np.inf, np.linalg.norm(ends - starts, axis=1))
    for n, (first, last) in enumerate(zip(from_start, to_end, strict=True)):
        around = first[:, None] + between + last
        found[n] = min(found[n], around.min(initial=np.inf))
    return found


def hidden(arena: Arena, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """True if walls or gaps stand straight between `starts` and `ends` [n, 2] (bool [n]); blocks and gates do not."""
    return _blocked(starts, ends, _runs(arena))


def _corners(arena: Arena) -> np.ndarray:
    """The points [n, 2] where a way can turn: the corners of walls and gaps that stick out."""
    solid = _solid(arena)
    around = solid[:-1, :-1] + 0 + solid[1:, :-1] + solid[:-1, 1:] + solid[1:, 1:]
    row, column = arena.origin
    where = np.argwhere(around == 1)[:, ::-1] + 0.5 - (column, row)
    return where * arena.cell


def _solid(arena: Arena) -> np.ndarray:
    """Mask of the cells nobody walks through (bool)."""
    return np.array([[symbol in WALL + CHASM for symbol in line] for line in arena.rows])


def _runs(arena: Arena) -> np.ndarray:
    """Rectangles [n, 4] of solid cells that follow one another, along rows and along columns.

    Both, so that a segment along the seam of two rectangles is inside of another one. Where two solid cells touch with
    their corners only, which lets nobody through, there is a tiny one.
    """
    solid = _solid(arena)
    row, column = arena.origin
    crossed = (
        (solid[:-1, :-1] == solid[1:, 1:]) & (solid[1:, :-1] == solid[:-1, 1:]) & (solid[:-1, :-1] != solid[1:, :-1])
    )
    found: list[tuple[float, ...]] = [
        (c - _PINCH, r - _PINCH, c + _PINCH, r + _PINCH) for r, c in np.argwhere(crossed) + 1
    ]
    for along, lines in ((0, solid), (1, solid.T)):
        for n, line in enumerate(lines):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
            for begin, end in edges.reshape(-1, 2):
                found.append((begin, n, end, n + 1) if along == 0 else (n, begin, n + 1, end))
    return (np.array(found) - (column, row, column, row) - 0.5) * arena.cell


def _straight(points: np.ndarray, corners: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Distances [n, c] from `points` to `corners`, infinite where something is in between."""
    starts, ends = (np.broadcast_to(x, (len(points), len(corners), 2)) for x in (points[:, None], corners))
    length = np.linalg.norm(ends - starts, axis=-1)
    blocked = _blocked(starts.reshape(-1, 2), ends.reshape(-1, 2), runs)
    return np.where(blocked.reshape(length.shape), np.inf, length)


def _blocked(starts: np.ndarray, ends: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """True if the segments from `starts` to `ends` [n, 2] go through the inside of one of `runs` (bool [n])."""
    found = []
    for i in range(0, len(starts), _AT_ONCE):
        begin, way = starts[i : i + _AT_ONCE, None], (ends - starts)[i : i + _AT_ONCE, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (runs[:, :2] + _EDGE - begin) / way, (runs[:, 2:] - _EDGE - begin) / way
        inside = (begin > runs[:, :2] + _EDGE) & (begin < runs[:, 2:] - _EDGE)
        enter = np.where(way == 0, np.where(inside, -np.inf, np.inf), np.minimum(*sides)).max(axis=-1)
        leave = np.where(way == 0, np.where(inside, np.inf, -np.inf), np.maximum(*sides)).min(axis=-1)
        found.append((np.maximum(enter, 0) < np.minimum(leave, 1)).any(axis=-1))
    return np.concatenate(found) if found else np.zeros(0, bool)


def _moves(arena: Arena, here: _Situation, switches: Collection[Cell]) -> Iterator[_Situation]:
    """States that one step can lead to."""
    for heading, step in enumerate(_HEADINGS):
        cell, block = _next(here.cell, step), here.block
        if _holds_block(arena, cell, block):
            beyond = _next(cell, step)
            another = bool(block) and cell != block[1]
            stuck = _symbol(arena, beyond) in WALL + GATE or _holds_block(arena, beyond, block)
            if another or stuck or "xy"[heading % 2] not in arena.block:
                continue
            block = (block[0] if block else cell, beyond)
        symbol = _symbol(arena, cell)
        bridged = _fell(arena, block) and cell == block[1]
        if symbol != WALL and (symbol != GATE or here.open) and (symbol != CHASM or bridged):
            yield _Situation(cell, heading, block, here.open or cell in switches)


def _holds_block(arena: Arena, cell: Cell, block: tuple[Cell, ...]) -> bool:
    """True if a block stands in `cell` after `block` has been pushed from its first to its second cell."""
    if block and cell == block[1]:
        return not _fell(arena, block)
    return _symbol(arena, cell) == BLOCK and cell not in block


def _fell(arena: Arena, block: tuple[Cell, ...]) -> bool:
    return bool(block) and "z" in arena.block and _symbol(arena, block[1]) == CHASM


def _way(before: dict[_Situation, _Situation | None], end: _Situation) -> list[_Situation]:
    way: list[_Situation] = []
    here: _Situation | None = end
    while here is not None:
        way.append(here)
        here = before[here]
    return way[::-1]


def _turns(arena: Arena, way: list[_Situation], switches: dict[Cell, Point]) -> list[Point]:
    """Points where `way` turns, where it opens the gates that it goes through, and its end."""
    last = way[-1]
    gated = any(_symbol(arena, here.cell) == GATE for here in way)
    points: list[Point] = []
    opened = False
    for here, there in zip(way, [*way[1:], last], strict=True):
        if gated and here.open and not opened:
            points.append(switches[here.cell])
            opened = True
        elif here is last or (here is not way[0] and here.heading != there.heading):
            points.append(arena.centre(here.cell))
    return points


def _switches(arena: Arena, switch: Switch) -> Iterator[tuple[Cell, Point]]:
    """The free cells from which `switch` opens the gates, and where in them: the middle of what they share with it."""
    for cell in arena.cells(FREE + ROBOT + GOAL):
        centre, half = np.array(arena.centre(cell)), arena.cell / 2
        lower, upper = np.maximum(centre - half, switch.lower), np.minimum(centre + half, switch.upper)
        if (lower < upper).all():
            x, y = ((lower + upper) / 2).tolist()
            yield cell, (x, y)


def _next(cell: Cell, step: Cell) -> Cell:
    return cell[0] + step[0], cell[1] + step[1]


def _symbol(arena: Arena, cell: Cell) -> str:
    return arena.rows[cell[0]][cell[1]]
