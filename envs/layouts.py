"""The maps of the tasks, from the lowest y up, in m at their own size of cells. Nothing here needs JAX or MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping

from envs.arena import Arena, Cell

Pairs = tuple[tuple[Cell, Cell], ...]

# The published tasks: 8 m cells.

MAZE = Arena(rows=("11111", "1r001", "11101", "10001", "11111"), cell=8.0)
CAM = Arena(rows=("11111", "1r001", "111D1", "10001", "11111"), cell=8.0)
PUSH = Arena(rows=("11111", "10r11", "10B01", "11011", "11111"), cell=8.0, block="xy")
FALL = Arena(rows=("1111", "1r01", "10B1", "1##1", "1001", "1111"), cell=8.0, block="yz")
STOCHASTIC = Arena(rows=("11111", "10r01", "10B01", "10001", "11111"), cell=8.0, block="x")
SPARSE = Arena(
    rows=(
        "1111111111",
        "1rrrrrrrr1",
        "1rrrrrrrr1",
        "1111111rr1",
        "10rrrrrrr1",
        "10rrrrrrr1",
        "1111111rr1",
        "1rrrrrrrr1",
        "1rrrrrrrr1",
        "1111111111",
    ),
    cell=2.0,
)

# The reference names rooms of 4 m cells without showing them. These are ours.

ROOMS_2 = Arena(rows=("111111111", "100010001", "1r0000001", "100010001", "111111111"), cell=4.0)
ROOMS_3 = Arena(rows=("1111111111111", "1r00100000001", "1000100010001", "10000000100g1", "1111111111111"), cell=4.0)
ROOMS_4 = Arena(
    rows=(
        "111111111",
        "1r0010001",
        "100000001",
        "100010001",
        "110111011",
        "100010001",
        "100000001",
        "1000100g1",
        "111111111",
    ),
    cell=4.0,
)


def _transposed(*rows: str) -> tuple[str, ...]:
    return tuple("".join(column) for column in zip(*rows, strict=True))


# JaxGCRL's `ant` has no walls at all. These are out of the way, 28 m from the start.
OPEN = Arena(rows=("1" * 9, *["100000001"] * 3, "1000r0001", *["100000001"] * 3, "1" * 9), cell=8.0)

# JaxGCRL's mazes, whose first index is x: 4 m cells, success within .5 m, goals at the centres of the cells `g`.
# U4 and U5 are of a later paper with its environments (Wang et al. 2025).

U_MAZE = Arena(_transposed("11111", "1rgg1", "111g1", "1ggg1", "11111"), cell=4.0)
U_MAZE_TEST = Arena(_transposed("11111", "1r001", "11101", "1ggg1", "11111"), cell=4.0)
U4_MAZE = Arena(_transposed("11111", "1ggg1", "1r1g1", "111g1", "1g1g1", "1ggg1", "11111"), cell=4.0)
U4_MAZE_TEST = Arena(_transposed("11111", "10001", "1r101", "11101", "1g101", "1ggg1", "11111"), cell=4.0)
U5_MAZE = Arena(
    _transposed("11111111", "1gggggg1", "1r1111g1", "111111g1", "1g1111g1", "1gggggg1", "11111111"), cell=4.0
)
U5_MAZE_TEST = Arena(
    _transposed("11111111", "10000001", "1r111101", "11111101", "1g1111g1", "1gggggg1", "11111111"), cell=4.0
)
BIG_MAZE = Arena(
    _transposed("11111111", "1rg11gg1", "1gg1ggg1", "11ggg111", "1gg1ggg1", "1g1gg1g1", "1ggg1gg1", "11111111"),
    cell=4.0,
)
BIG_MAZE_TEST = Arena(
    _transposed("11111111", "1r011gg1", "10010gg1", "11000111", "10010001", "101g01g1", "10gg1gg1", "11111111"),
    cell=4.0,
)
HARDEST_MAZE = Arena(
    _transposed(
        "111111111111",
        "1rggg1ggggg1",
        "1g11g1g1g1g1",
        "1gggggg1ggg1",
        "1g1111g111g1",
        "1gg1g1ggggg1",
        "11g1g1g1g111",
        "1gg1ggg1ggg1",
        "111111111111",
    ),
    cell=4.0,
)

# OGBench's locomotion mazes (Park et al. 2025): 4 m cells, walls of 2 m. Pairs are the cells (row, column) of a start
# and its goal; the open `arena` has one.

ARENA = Arena(("11111111", "1r000001", *5 * ("10000001",), "11111111"), cell=4.0, wall_height=2.0)
MEDIUM = Arena(
    ("11111111", "1r011001", "10010001", "11000111", "10010001", "10100101", "10001001", "11111111"),
    cell=4.0,
    wall_height=2.0,
)
LARGE = Arena(
    (
        "111111111111",
        "1r0001000001",
        "101101010101",
        "100000010001",
        "101111011101",
        "100101000001",
        "110101010111",
        "100100010001",
        "111111111111",
    ),
    cell=4.0,
    wall_height=2.0,
)
GIANT = Arena(
    (
        "1111111111111111",
        "1r10000001100001",
        "1010110101001101",
        "1000100100010001",
        "1011101111110101",
        "1000100010000101",
        "1110101001010111",
        "1000100100010001",
        "1010101111110101",
        "1011100010001101",
        "1000001000100001",
        "1111111111111111",
    ),
    cell=4.0,
    wall_height=2.0,
)
OGBENCH: Mapping[str, tuple[Arena, Pairs]] = {
    "arena": (ARENA, (((1, 1), (6, 6)),)),
    "medium": (
        MEDIUM,
        (((1, 1), (6, 6)), ((6, 1), (1, 6)), ((5, 3), (4, 2)), ((6, 5), (6, 1)), ((2, 6), (1, 1))),
    ),
    "large": (
        LARGE,
        (((1, 1), (7, 10)), ((5, 4), (7, 1)), ((7, 4), (1, 10)), ((3, 8), (5, 4)), ((1, 1), (5, 4))),
    ),
    "giant": (
        GIANT,
        (((1, 1), (10, 14)), ((1, 14), (10, 1)), ((8, 14), (1, 1)), ((8, 3), (5, 12)), ((5, 9), (3, 8))),
    ),
}

# Gymnasium-Robotics' mazes, whose rows run up along y: cells of 4 m and walls of 2 m for the ant, of 1 m and .4 m for
# the point.

GYMNASIUM: Mapping[str, tuple[str, ...]] = {
    "UMaze": ("11111", "10001", "11101", "1r001", "11111"),
    "Medium": MEDIUM.rows[::-1],
    "Large": LARGE.rows[::-1],
}
