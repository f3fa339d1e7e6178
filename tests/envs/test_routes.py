"""Ways through mazes: as short as any, never through walls, past gates, blocks and gaps where these can be passed."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from envs.arena import CHASM, FREE, GOAL, ROBOT, WALL, Arena
from envs.routes import distances, hidden, routes
from envs.tasks import TASKS, Switch

EVERYWHERE = FREE + ROBOT + GOAL
STEPS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def ends(arena):
    return set(arena.cells(EVERYWHERE))


def all_routes(arena, switch=None):
    """Every way between free cells, by (start, end)."""
    found = {start: routes(arena, start, ends(arena), switch) for start in ends(arena)}
    return {(start, end): way for start, ways in found.items() for end, way in ways.items()}


def legs(arena, start, way):
    return itertools.pairwise([arena.centre(start), *way])


def cells_on(arena, start, way):
    """The cells under a way, in order, each once."""
    row, column = arena.origin
    under = []
    for (x0, y0), (x1, y1) in legs(arena, start, way):
        for share in np.linspace(0, 1, 1 + 4 * round((abs(x1 - x0) + abs(y1 - y0)) / arena.cell)):
            x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
            cell = row + math.floor(y / arena.cell + 0.5), column + math.floor(x / arena.cell + 0.5)
            if not under or under[-1] != cell:
                under.append(cell)
    return under or [start]


def slow(arena, start):
    """(steps, legs) of the best way to every cell that can be walked to, by relaxation until nothing changes."""
    best = {(start, heading): (0, 1) for heading in STEPS}
    changed = True
    while changed:
        changed = False
        for ((r, c), heading), (steps, turns) in list(best.items()):
            for step in STEPS:
                cell = (r + step[0], c + step[1])
                if arena.rows[cell[0]][cell[1]] == WALL:
                    continue
                new = (steps + 1, turns + (step != heading))
                if new < best.get((cell, step), (math.inf, 0)):
                    best[cell, step], changed = new, True
    ways = {}
    for (cell, _), cost in best.items():
        ways[cell] = min(ways.get(cell, (math.inf, 0)), cost)
    return ways


@st.composite
def mazes(draw):
    """A small map of walls and free cells, and the robot in one of these."""
    height, width = draw(st.integers(1, 5)), draw(st.integers(2, 5))
    inner = draw(st.lists(st.sampled_from("0001"), min_size=height * width, max_size=height * width))
    inner[draw(st.integers(0, len(inner) - 1))] = ROBOT
    rows = ["1" + "".join(inner[i * width : (i + 1) * width]) + "1" for i in range(height)]
    outline = "1" * (width + 2)
    return Arena(rows=(outline, *rows, outline), cell=draw(st.sampled_from([1.5, 4.0, 8.0])))


@settings(max_examples=60)
@given(mazes())
def test_ways_are_as_short_as_any_and_turn_as_little(arena):
    start = arena.origin
    ways, expected = routes(arena, start, ends(arena)), slow(arena, start)
    assert set(ways) == set(expected)
    for end, way in ways.items():
        length = sum(abs(a - b) for leg in legs(arena, start, way) for a, b in zip(*leg, strict=True))
        steps, turns = expected[end]
        assert length == pytest.approx(steps * arena.cell) and len(way) == turns and way[-1] == arena.centre(end)


@pytest.mark.parametrize(
    "name", {(task.arena, task.switch): name for name, task in TASKS.items() if not task.pairs}.values()
)
def test_no_way_of_any_task_cuts_through_a_wall_or_falls(name):
    arena, switch = TASKS[name].arena, TASKS[name].switch
    ways = all_routes(arena, switch)
    assert {(cell, cell) for cell in ends(arena)} <= set(ways)
    for (start, end), way in ways.items():
        under = cells_on(arena, start, way)
        assert (under[0], under[-1]) == (start, end)
        assert WALL not in (symbols := "".join(arena.rows[r][c] for r, c in under))
        assert symbols.count(CHASM) <= (name == "ant_fall")
        for (x0, y0), (x1, y1) in legs(arena, start, way):
            assert x0 == x1 or y0 == y1 or switch  # only to and from a switch a leg may be askew


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("ant_maze", [(16.0, 0.0), (16.0, 16.0), (0.0, 16.0)]),
        # Through the switch, to the right of its cell's centre, then down through the gate.
        ("ant_maze_cam", [(18.0, 0.0), (16.0, 16.0), (0.0, 16.0)]),
        # Push the block into the gap, cross over it.
        ("ant_fall", [(8.0, 0.0), (8.0, 24.0), (0.0, 24.0)]),
        # Go left around the block, push it right, pass: pushed down it would block the passage.
        ("ant_push", [(-8.0, 0.0), (-8.0, 8.0), (0.0, 8.0), (0.0, 16.0)]),
        # The block could be pushed aside, but there is a way around it.
        ("ant_maze_stochastic", [(-8.0, 0.0), (-8.0, 16.0), (0.0, 16.0)]),
    ],
)
def test_the_way_to_the_test_goal(name, way):
    arena = TASKS[name].arena
    column = arena.origin[1] + round(way[-1][0] / arena.cell)
    end = arena.origin[0] + round(way[-1][1] / arena.cell), column
    assert routes(arena, arena.origin, [end], TASKS[name].switch) == {end: way}


def test_a_gate_is_closed_to_those_who_cannot_reach_its_switch():
    task = TASKS["point_maze_cam"]
    beyond = (3, 3)
    assert set(routes(task.arena, beyond, ends(task.arena), task.switch)) == {(3, 1), (3, 2), (3, 3)}
    assert set(routes(task.arena, task.arena.origin, ends(task.arena))) == {(1, 1), (1, 2), (1, 3)}


def test_who_passes_the_switch_without_need_does_not_go_out_of_the_way():
    arena = Arena(rows=("111111", "1r00D1", "111111"), cell=2.0)
    switch = Switch(lower=(2.0, -1.0), upper=(3.0, 1.0), yaw=(0.0, 0.0))
    assert routes(arena, (1, 1), [(1, 3)], switch) == {(1, 3): [(4.0, 0.0)]}
    assert routes(arena, (1, 1), [(1, 4)], switch) == {(1, 4): [(2.5, 0.0), (6.0, 0.0)]}


@pytest.mark.parametrize(
    ("row", "block", "passes"),
    [
        ("1rB#01", "xz", True),
        ("1rB#01", "yz", False),  # it does not slide this way
        ("1rB#01", "xy", False),  # it does not fall
        ("1rB0#01", "xz", True),  # pushed twice
        ("1rB##01", "xz", False),  # one block fills one gap
        ("1rBB#01", "xz", False),  # two blocks at once
        ("1rB#B#01", "xz", False),  # one way moves one block
        ("1rB001", "x", False),  # in front of the body for ever
        ("1r0#01", "xz", False),  # nothing to fill the gap with
    ],
)
def test_a_block_bridges_a_gap_that_it_falls_into(row, block, passes):
    arena = Arena(rows=("1" * len(row), row, "1" * len(row)), cell=2.0, block=block)
    end = (1, len(row) - 2)
    assert (end in routes(arena, (1, 1), [end])) == passes


@st.composite
def walled(draw):
    """Small mazes with cells of 1 m, with an outline of walls."""
    inside = draw(st.lists(st.sampled_from("0001"), min_size=12, max_size=12))
    inside[draw(st.integers(0, 11))] = "r"
    rows = ("".join(inside[i : i + 4]) for i in (0, 4, 8))
    return Arena(rows=("111111", *(f"1{row}1" for row in rows), "111111"), cell=1.0)


def seen(arena, points, others):
    """Which of `others` are in sight of each of `points`: nowhere in between are all cells that touch it walls."""
    row, column = arena.origin
    walls = np.array([[symbol == WALL for symbol in line] for line in arena.rows])
    between = points[:, None] + np.linspace(0, 1, 90)[1:-1, None, None, None] * (others - points[:, None])
    cells = [np.floor(between + by + 0.5).astype(int) for by in itertools.product((-1e-6, 1e-6), repeat=2)]
    return ~np.all([walls[cell[..., 1] + row, cell[..., 0] + column] for cell in cells], axis=0).any(axis=0)


@settings(max_examples=20)
@given(walled())
def test_distances_are_those_of_the_shortest_ways_by_way_of_any_corners_of_cells(arena):
    row, column = arena.origin
    joints = [arena.rows[r][c] + arena.rows[r][c + 1] + arena.rows[r + 1][c] + arena.rows[r + 1][c + 1]
              for r in range(4) for c in range(5)]  # fmt: skip
    assume(not any(("1" + a + b + "1") in joints or (a + "11" + b) in joints for a in "0r" for b in "0r"))
    centres = arena.centres(EVERYWHERE)
    corners = np.array([(c - column - 0.5, r - row - 0.5) for r in range(1, 5) for c in range(1, 6)])
    points = np.concatenate([centres, corners])
    lengths = np.linalg.norm(points[:, None] - points, axis=-1)
    sight = seen(arena, points, points)
    shortest = np.where(sight, lengths, np.inf)
    for by in range(len(centres), len(points)):
        shortest = np.minimum(shortest, shortest[:, by, None] + shortest[by])
    pairs = np.array(list(itertools.product(range(len(centres)), repeat=2)))
    ends = [centres[pairs[:, i]] for i in (0, 1)]
    np.testing.assert_allclose(distances(arena, *ends), shortest[pairs[:, 0], pairs[:, 1]], atol=1e-4)
    np.testing.assert_array_equal(hidden(arena, *ends), ~sight[pairs[:, 0], pairs[:, 1]])


def test_no_way_leads_between_two_walls_that_touch_with_their_corners():
    arena = Arena(rows=("1111", "1r11", "1101", "1111"), cell=2.0)
    assert np.isinf(distances(arena, np.zeros((1, 2)), np.full((1, 2), 2.0)))


def test_the_distance_around_the_wall_of_the_u_goes_by_its_two_corners():
    found = distances(TASKS["point_maze"].arena, np.zeros((2, 2)), np.array([[0.0, 16.0], [8.0, 8.0]]))
    assert found[0] == pytest.approx(2 * math.hypot(12, 4) + 8)
    assert np.isinf(found[1])  # that is inside the wall


@pytest.mark.parametrize("task", ["ant_fall", "ant_push", "ant_maze_cam"])
def test_where_blocks_and_gates_decide_no_distance_is_told(task):
    assert distances(TASKS[task].arena, np.zeros((1, 2)), np.ones((1, 2))) is None
