"""Make a maze with loops from a seed, as a map for `--env.options.map`.

    python scripts/results/mazes.py --seed 0 --out maze.yaml
    star train configs/ant_labyrinth.yaml --env.options.map maze.yaml

Corridors of one cell run through walls of one cell. A depth-first walk makes a maze without loops; then `--loops` walls
between neighbouring corridors are opened. The start is a corner, the goal the free cell that is the longest walk away.
Of the mazes that the seed gives one after another, the first is taken whose shortest way from start to goal lies in
`--way`; that way, in m, stands in the map's first line.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from envs import arena, routes
from envs.common.errors import UserError

TRIES = 1_000
Grid = list[list[str]]


def maze(chance: random.Random, *, rows: int, columns: int, loops: int) -> Grid:
    """Walls `1` and corridors `0` around `rows` x `columns` rooms, with so many walls opened besides."""
    grid = [["1"] * (2 * columns + 1) for _ in range(2 * rows + 1)]
    grid[1][1] = "0"
    way = [(1, 1)]
    while way:
        row, column = way[-1]
        ahead = [(r, c) for r, c in _rooms_beside(grid, row, column) if grid[r][c] == "1"]
        if not ahead:
            way.pop()
            continue
        r, c = chance.choice(ahead)
        grid[(row + r) // 2][(column + c) // 2] = grid[r][c] = "0"
        way.append((r, c))
    closed = [(r, c) for r in range(1, 2 * rows) for c in range(1, 2 * columns) if (r + c) % 2 and grid[r][c] == "1"]
    for r, c in chance.sample(closed, min(loops, len(closed))):
        grid[r][c] = "0"
    return grid


def _rooms_beside(grid: Grid, row: int, column: int) -> Iterator[tuple[int, int]]:
    for r, c in ((row - 2, column), (row + 2, column), (row, column - 2), (row, column + 2)):
        if 0 < r < len(grid) and 0 < c < len(grid[0]):
            yield r, c


def with_ends(grid: Grid, *, cell: float) -> tuple[str, float]:
    """The map with its start and goal, and the length of the shortest way between them, in m."""
    started = [row[:] for row in grid]
    started[1][1] = "r"
    found = arena.Arena(tuple(map("".join, started)), cell)
    goal = np.array([arena.farthest(found)])
    row, column = found.cell_at(goal[0])
    started[row][column] = "g"
    start = np.array([found.centre((1, 1))])
    (way,) = np.ravel(routes.distances(found, start, goal))
    return "\n".join(map("".join, started[::-1])), float(way)


def made(seed: int, *, rows: int, columns: int, loops: int, cell: float, way: tuple[float, float]) -> str:
    """The file of the map of `seed`; raises `UserError` if no way is as long as it should be."""
    chance = random.Random(seed)
    for _ in range(TRIES):
        text, length = with_ends(maze(chance, rows=rows, columns=columns, loops=loops), cell=cell)
        if way[0] <= length <= way[1]:
            head = f"# {length:.1f} m from the start to the goal; seed {seed}, {loops} loops\ncell: {cell:g}\nmap: |\n"
            return head + "".join(f"  {row}\n" for row in text.split("\n"))
    raise UserError(f"--way: no maze of {rows} x {columns} rooms has one of {way[0]:g} to {way[1]:g} m")


def main(arguments: list[str] | None = None) -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--rows", type=int, default=5, help="rooms from top to bottom (default: 5)")
    parser.add_argument("--columns", type=int, default=5, help="rooms from left to right (default: 5)")
    parser.add_argument("--loops", type=int, default=3, help="walls opened besides (default: 3)")
    parser.add_argument("--cell", type=float, default=4.0, help="side of a cell in m (default: 4)")
    parser.add_argument("--way", type=float, nargs=2, default=(90.0, 115.0), metavar="M", help="least and most m")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    options = parser.parse_args(arguments)
    try:
        text = made(
            options.seed,
            rows=options.rows,
            columns=options.columns,
            loops=options.loops,
            cell=options.cell,
            way=tuple(options.way),
        )
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
