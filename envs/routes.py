"""The shortest ways through a maze, from the centre of one cell to those of others.

A way goes from a cell to one of its four neighbours that is free. Where there is no other way it goes through a gate,
which the body opens by going to its switch first, or pushes a block, which slides a cell ahead of the body along its
axes and bridges the gap that it falls into. No way moves more than one block.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

from envs.arena import BLOCK, CHASM, FREE, GATE, GOAL, ROBOT, WALL, Arena, Cell
from envs.tasks import Switch

Point = tuple[float, float]

_HEADINGS = ((0, 1), (1, 0), (0, -1), (-1, 0))  # one cell along +x, +y, -x, -y


class _Situation(NamedTuple):
    """Where the body is, what it came along, from where to where it pushed a block, and whether gates are open."""

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


def _moves(arena: Arena, here: _Situation, switches: Collection[Cell]) -> Iterator[_Situation]:
    """What one step can lead to."""
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
    """Whether a block stands in `cell` after `block` has been pushed from its first to its second cell."""
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
    """Where `way` turns, where it opens the gates that it goes through, and its end."""
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
