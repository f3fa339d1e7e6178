import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envs import ant
from envs.arena import Arena
from envs.scene import build_model

MAZE = Arena(rows=("11111", "1r001", "11101", "10001", "11111"), cell=8.0)


@st.composite
def arenas(draw):
    height, width = draw(st.integers(1, 5)), draw(st.integers(1, 5))
    cells = draw(st.lists(st.sampled_from("01"), min_size=height * width, max_size=height * width))
    cells[draw(st.integers(0, height * width - 1))] = "r"
    rows = tuple("".join(cells[r * width : (r + 1) * width]) for r in range(height))
    return Arena(rows=rows, cell=draw(st.sampled_from([1.0, 4.0, 8.0])))


def cell_centres(arena, wanted):
    row, column = arena.origin
    return [
        ((c - column) * arena.cell, (r - row) * arena.cell)
        for r, cells in enumerate(arena.rows)
        for c, cell in enumerate(cells)
        if cell in wanted
    ]


def covers(rectangles, point):
    return sum(lo_x < point[0] < hi_x and lo_y < point[1] < hi_y for lo_x, lo_y, hi_x, hi_y in rectangles)


@given(arenas())
def test_wall_and_free_rectangles_cover_their_cells_once_and_no_other(arena):
    for rectangles, cells, others in ((arena.walls(), "1", "0r"), (arena.free(), "0r", "1")):
        assert all(covers(rectangles, centre) == 1 for centre in cell_centres(arena, cells))
        assert all(covers(rectangles, centre) == 0 for centre in cell_centres(arena, others))
        area = sum((hi_x - lo_x) * (hi_y - lo_y) for lo_x, lo_y, hi_x, hi_y in rectangles)
        assert area == len(cell_centres(arena, cells)) * arena.cell**2


def test_free_space_of_the_maze_lies_around_the_origin():
    free = MAZE.free()
    np.testing.assert_array_equal([free[:, :2].min(), free[:, 2:].max()], [-4.0, 20.0])
    np.testing.assert_array_equal(MAZE.bounds, [-12.0, -12.0, 28.0, 28.0])


def test_middle_wall_closes_the_left_and_leaves_the_right_open():
    walls = MAZE.walls()
    assert covers(walls, (0.0, 8.0)) and covers(walls, (8.0, 8.0))
    assert not covers(walls, (16.0, 8.0)) and not covers(walls, (0.0, 16.0))


def test_model_has_one_box_for_each_merged_wall():
    model = build_model(MAZE, ant.spec(), {})
    boxes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)
    centres, halves = model.geom_pos[boxes], model.geom_size[boxes]
    np.testing.assert_allclose(np.hstack([(centres - halves)[:, :2], (centres + halves)[:, :2]]), MAZE.walls())
    np.testing.assert_allclose(centres[:, 2] - halves[:, 2], 0.0)
    np.testing.assert_allclose(centres[:, 2] + halves[:, 2], 4.0)


def test_every_ant_geom_meets_floor_and_walls_and_no_other_pair_meets():
    model = build_model(MAZE, ant.spec(), {})
    moves = model.body_weldid[model.geom_bodyid] != 0
    meets = (model.geom_contype[:, None] & model.geom_conaffinity[None, :]) != 0
    np.testing.assert_array_equal(meets | meets.T, moves[:, None] ^ moves[None, :])
    assert moves.sum() == 13


@pytest.mark.parametrize(("name", "value"), [("timestep", 0.01), ("iterations", 7)])
def test_options_reach_the_model(name, value):
    assert getattr(build_model(MAZE, ant.spec(), {name: value}).opt, name) == value


def test_a_grid_covers_the_free_cells_and_nothing_else_where_its_lines_are_those_of_cells():
    grid = MAZE.grid(6)
    assert len(grid) == 4 * 7  # six lines are those of the 3 x 3 cells, and those between
    assert (grid[:, 2:] - grid[:, :2] == 4.0).all()
    for low_x, low_y, high_x, high_y in grid:
        assert covers(MAZE.free(), ((low_x + high_x) / 2, (low_y + high_y) / 2)) == 1


def test_a_grid_leaves_out_what_nobody_can_stand_on_or_go_to():
    arena = Arena(rows=("11111111", "1r0#0B01", "11111111", "10000001", "11111111"), cell=2.0, block="x")
    middles = {tuple((cell[:2] + cell[2:]) / 2) for cell in arena.grid(6)}
    assert middles == {(0.0, -0.5), (2.0, -0.5), (0.0, 0.5), (2.0, 0.5)}
