import jax
import numpy as np
import pytest

import envs
from envs import render, scene
from envs.render import GOAL, SUBGOAL, Marks, Stage
from envs.topdown import BODY, SMALL, VOID, Sheet, tiled

HEIGHT = 400


def byte(colour):
    """`colour` as a sheet holds it."""
    return np.round(255 * np.array(colour[:3])).astype(int)


def staged(name, **options):
    env = envs.make(name, **options)
    stage = Stage(env)
    qpos, mocap_pos = map(np.array, env.pose(env.reset(jax.random.key(0)).pipeline_state.data))
    stage.place(qpos, mocap_pos)
    return stage, qpos, mocap_pos


def near(sheet, colour, tolerance=3):
    return (np.abs(sheet.astype(int) - byte(colour)) <= tolerance).all(axis=-1)


def colour_at(stage, sheet, x, y):
    """The colour of a place on the map, whose outline is that of the walls around it."""
    rows, columns = np.nonzero(near(sheet, scene.WALL_COLOUR))
    x_lo, _, x_hi, y_hi = render.frame_of(stage.env.arena)
    scale = (columns.max() + 1 - columns.min()) / (x_hi - x_lo)  # below the map the legend has a wall, too
    return sheet[int(rows.min() + (y_hi - y) * scale), int(columns.min() + (x - x_lo) * scale)].astype(int)


@pytest.fixture(scope="module")
def maze():
    stage, *_ = staged("point_maze")
    return stage, Sheet(stage, height=HEIGHT, subgoals=True)


def at(stage, x, y):
    stage.place(np.array([x, y]), np.zeros((0, 3)))


@pytest.mark.parametrize("goal", [(0.0, 16.0), (16.0, 2.0)])
def test_goal_body_and_walls_have_their_colours_where_they_are(maze, goal):
    stage, sheet = maze
    at(stage, 8.0, 0.0)
    picture = sheet.draw(Marks(goal=np.array(goal)))
    np.testing.assert_allclose(colour_at(stage, picture, *goal), byte(GOAL), atol=3)
    np.testing.assert_allclose(colour_at(stage, picture, 8.0, 0.0), byte(BODY), atol=3)
    np.testing.assert_allclose(colour_at(stage, picture, 8.0, 8.0), byte(scene.WALL_COLOUR), atol=3)


def test_inside_the_success_radius_the_floor_is_tinted(maze):
    stage, sheet = maze
    at(stage, 8.0, 0.0)
    picture = sheet.draw(Marks(goal=np.array([0.0, 16.0])))
    inside, outside = colour_at(stage, picture, 3.0, 16.0), colour_at(stage, picture, 6.0, 16.0)
    assert inside[1] > inside[0] + 20 and abs(outside[1] - outside[0]) < 3


def test_subgoal_and_target_region_are_drawn_where_they_are_and_vanish_with_them(maze):
    stage, sheet = maze
    at(stage, 0.0, 0.0)
    marks = Marks(subgoal=np.array([16.0, 16.0]), target=(np.array([12.0, -4.0]), np.array([20.0, 4.0])))
    with_both, without = sheet.draw(marks), sheet.draw(Marks())
    np.testing.assert_allclose(colour_at(stage, with_both, 16.0, 16.0), byte(SUBGOAL), atol=3)
    red, _, blue = colour_at(stage, with_both, 16.0, 0.0)
    assert blue > red + 20
    for place in ((16.0, 16.0), (16.0, 0.0)):
        assert np.ptp(colour_at(stage, without, *place)) < 3


def test_the_way_of_the_body_is_drawn(maze):
    stage, sheet = maze
    at(stage, 16.0, 16.0)
    picture = sheet.draw(Marks(trail=np.array([[0.0, 0.0], [16.0, 0.0], [16.0, 16.0]])))
    np.testing.assert_allclose(colour_at(stage, picture, 8.0, 0.0), byte(render.TRAIL), atol=25)


def test_a_sheet_shows_only_what_it_was_last_told(maze):
    stage, sheet = maze
    at(stage, 0.0, 0.0)
    first = sheet.draw(Marks(), left="a", right="b")
    at(stage, 16.0, 16.0)
    assert (sheet.draw(Marks(goal=np.array([0.0, 16.0])), left="c", right="d") != first).any()
    at(stage, 0.0, 0.0)
    assert (sheet.draw(Marks(), left="a", right="b") == first).all()


@pytest.mark.parametrize("name", ["point_maze", "point_hardest_maze", "ant_fall"])
@pytest.mark.parametrize("height", [SMALL, 480, 1080])
def test_the_legend_names_all_marks_and_is_no_wider_than_the_map_and_its_margins(name, height):
    stage, *_ = staged(name)
    corners = np.zeros((1, len(stage.env.abstract_indices)))
    for subgoals in (False, True):
        sheet = Sheet(stage, height=height, view_width=100, regions=(corners, corners + 1), subgoals=subgoals)
        figure = sheet._canvas.figure
        labels = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        radius = f"success: within {stage.env.success_radius:g} m"
        aims = ["subgoal", "target: region or goal's box", "region"]
        assert labels == ["way", "goal", radius, "wall"] + aims * subgoals
        lowest = figure.axes[0].get_tightbbox().y0
        for legend in figure.legends:
            box = legend.get_window_extent()
            assert 100 <= box.x0 and box.x1 <= sheet.width and 0 <= box.y0 and box.y1 <= lowest


def test_text_and_the_picture_of_the_camera_have_their_places(maze):
    stage, _ = maze
    sheet = Sheet(stage, height=HEIGHT, view_width=100)
    view = np.full((HEIGHT, 100, 3), (10, 20, 30), np.uint8)
    picture = sheet.draw(Marks(), left="left", right="right", view=view)
    head = sheet.height - HEIGHT
    assert picture.shape == (sheet.height, sheet.width, 3)
    assert (picture[head:, :100] == view).all()
    assert (picture[:head, :40] < 200).any() and (picture[:head, -40:] < 200).any()


def test_chasm_and_block_are_drawn_and_the_block_moves():
    stage, qpos, mocap_pos = staged("ant_fall", engine="native")
    sheet = Sheet(stage, height=HEIGHT)
    before = sheet.draw(Marks())
    np.testing.assert_allclose(colour_at(stage, before, 0.0, 16.0), byte((float(VOID),) * 3), atol=3)
    np.testing.assert_allclose(colour_at(stage, before, 8.0, 8.0), byte(scene.BLOCK_COLOUR), atol=3)
    qpos[-2] += 8.0
    stage.place(qpos, mocap_pos)
    after = sheet.draw(Marks())
    np.testing.assert_allclose(colour_at(stage, after, 8.0, 16.0), byte(scene.BLOCK_COLOUR), atol=3)
    assert np.ptp(colour_at(stage, after, 8.0, 8.0)) < 3


def test_an_open_gate_is_only_hatched():
    stage, qpos, mocap_pos = staged("point_maze_cam")
    sheet = Sheet(stage, height=HEIGHT)
    closed = sheet.draw(Marks())
    mocap_pos[:, 2] += 2 * stage.env.arena.wall_height
    stage.place(qpos, mocap_pos)
    opened = sheet.draw(Marks())
    assert 0 < near(opened, scene.GATE_COLOUR).sum() < 0.5 * near(closed, scene.GATE_COLOUR).sum()


@pytest.mark.parametrize("name", ["point_3rooms", "ant_fall", "point_maze"])
@pytest.mark.parametrize("height", [97, 180, 480])
def test_sheets_have_even_sides(name, height):
    stage, *_ = staged(name)
    sheet = Sheet(stage, height=height, view_width=height)
    picture = sheet.draw(Marks())
    assert picture.shape == (sheet.height, sheet.width, 3)
    assert sheet.height % 2 == sheet.width % 2 == 0


@pytest.mark.parametrize(
    ("count", "columns", "shape"), [(1, 1, (4, 6)), (3, 2, (8, 12)), (4, 2, (8, 12)), (5, 3, (8, 18))]
)
def test_tiles_stand_in_rows(count, columns, shape):
    pictures = [np.full((4, 6, 3), i, np.uint8) for i in range(count)]
    sheet = tiled(pictures, columns)
    assert sheet.shape == (*shape, 3)
    for i in range(count):
        row, column = divmod(i, columns)
        assert (sheet[4 * row : 4 * row + 4, 6 * column : 6 * column + 6] == i).all()
    assert (sheet[4 * (count - 1) // columns :, :][-4:, 6 * ((count - 1) % columns + 1) :] == 255).all()
