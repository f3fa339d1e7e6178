"""The maps of the tasks, from the lowest y up, in m at their own size of cells. Nothing here needs JAX or MuJoCo."""

from __future__ import annotations

from envs.arena import Arena

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
