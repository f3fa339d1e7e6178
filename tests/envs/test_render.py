import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from envs import EnvError, render
from envs.render import Marks, Painter, Stage
from tests.made import jitted, made

ROOT = Path(__file__).parents[2]
SIZE = {"width": 120, "height": 90}


pytestmark = pytest.mark.usefixtures("can_draw")


@pytest.fixture(scope="module")
def point():
    return made("point_maze", goals="test")


@pytest.fixture(scope="module")
def painter(point):
    with Painter(Stage(point), width=120, height=120) as painter:
        yield painter


def paint(painter, x, y, marks=render.NOTHING, camera="top"):
    painter.stage.place(np.array([x, y]), np.zeros((0, 3)))
    return painter.paint(marks, camera=camera).astype(int)


def middle_of(pixels):
    """(right, up) of the middle of the pixels that are set, from -1 to 1 across the picture."""
    rows, columns = np.nonzero(pixels)
    height, width = pixels.shape
    return 2 * columns.mean() / width - 1, 1 - 2 * rows.mean() / height


@pytest.mark.parametrize("camera", render.CAMERAS)
def test_a_frame_has_the_size_that_was_asked_for_and_shows_something(point, camera):
    data = jitted(point.reset)(jax.random.key(0)).pipeline_state.data
    picture = render.frame(point, data, **SIZE, camera=camera)
    assert picture.shape == (90, 120, 3) and picture.dtype == np.uint8
    assert picture.std(axis=(0, 1)).min() > 10


def test_a_frame_depends_on_the_data_and_on_nothing_else(point):
    one, other = (jitted(point.reset)(jax.random.key(seed)).pipeline_state.data for seed in (0, 1))
    first, second, again = (render.frame(point, data, **SIZE) for data in (one, other, one))
    assert (first == again).all() and (first != second).any()


def test_the_point_is_drawn_where_it_is(painter):
    lone, moved = paint(painter, 0.0, 0.0), paint(painter, 16.0, 16.0)
    right, up = middle_of((lone != moved).any(axis=-1))  # both places are as far from the middle
    assert abs(right) < 0.1 and abs(up) < 0.1
    gone = paint(painter, 100.0, 0.0)
    right, up = middle_of((moved != gone).any(axis=-1))
    assert right > 0.4 and up > 0.4


@pytest.mark.parametrize(("goal", "side"), [((0.0, 16.0), (-1, 1)), ((16.0, 0.0), (1, -1))])
def test_a_goal_is_marked_in_its_colour_where_it_is(painter, goal, side):
    without, marked = paint(painter, 0.0, 0.0), paint(painter, 0.0, 0.0, Marks(goal=np.array(goal)))
    changed = (without != marked).any(axis=-1)
    right, up = middle_of(changed)
    assert right * side[0] > 0.3 and up * side[1] > 0.3
    red, green, _ = marked[changed].mean(axis=0)
    assert green > 1.5 * red


@pytest.mark.parametrize(
    "marks",
    [
        pytest.param(Marks(subgoal=np.array([16.0, 0.0])), id="subgoal"),
        pytest.param(Marks(target=(np.array([12.0, -4.0]), np.array([20.0, 4.0]))), id="target"),
        pytest.param(Marks(trail=np.array([[13.0, -3.0], [19.0, 3.0]])), id="trail"),
    ],
)
def test_every_other_mark_is_drawn_where_it_is(painter, marks):
    right, up = middle_of((paint(painter, 0.0, 0.0) != paint(painter, 0.0, 0.0, marks)).any(axis=-1))
    assert right > 0.3 and up < -0.3


def test_a_wall_between_camera_and_body_does_not_hide_it(painter):
    red, _, blue = paint(painter, 0.0, 12.55, camera="follow")[60, 60]
    assert red > blue  # the body is brown, walls are blue


@pytest.mark.parametrize("name", ["ant_push", "ant_fall"])
def test_the_block_is_where_the_data_say(name):
    env = made(name)
    qpos, mocap_pos = map(np.array, env.pose(jitted(env.reset)(jax.random.key(0)).pipeline_state.data))
    stage = Stage(env)
    stage.place(qpos, mocap_pos)
    ((low, high, height),) = stage.boxes("block")
    qpos[-1] -= 2.0  # the last slide is y or z
    stage.place(qpos, mocap_pos)
    ((new_low, new_high, new_height),) = stage.boxes("block")
    if name == "ant_push":
        np.testing.assert_allclose([new_low, new_high], [low - [0, 2], high - [0, 2]], atol=1e-6)
    else:
        assert new_height == pytest.approx(height - 2.0)


def test_a_gate_is_where_the_data_say():
    env = made("point_maze_cam")
    data = jitted(env.reset)(jax.random.key(0)).pipeline_state.data
    stage = Stage(env)
    heights = []
    for is_open in (0.0, 1.0):
        stage.place(*map(np.asarray, env.pose(data.replace(open=data.open + is_open))))
        ((_, _, height),) = stage.boxes("gate")
        heights.append(height)
    assert heights[0] < env.arena.wall_height < heights[1]


@pytest.mark.parametrize("name", ["point_3rooms", "ant_fall", "point_hardest_maze"])
@pytest.mark.parametrize("camera", ["overview", "top"])
def test_the_whole_arena_is_in_the_picture_and_fills_it(name, camera):
    env = made(name)
    stage = Stage(env)
    stage.place(*map(np.asarray, env.pose(jitted(env.reset)(jax.random.key(0)).pipeline_state.data)))
    with Painter(stage, width=160, height=100) as painter:
        blank = (painter.paint(camera=camera) > 250).all(axis=-1)
    rows, columns = np.nonzero(~blank)
    gaps = rows.min(), 99 - rows.max(), columns.min(), 159 - columns.max()
    assert min(gaps) >= 1
    assert max(gaps[:2]) <= 6 or max(gaps[2:]) <= 10


def test_an_unknown_camera_is_refused(point):
    data = jitted(point.reset)(jax.random.key(0)).pipeline_state.data
    with pytest.raises(EnvError, match='camera "folow" is unknown.*did you mean "follow"'):
        render.frame(point, data, **SIZE, camera="folow")


def test_a_painter_can_be_closed_twice_and_draws_no_more(point):
    painter = Painter(Stage(point), **SIZE)
    painter.close()
    painter.close()
    with pytest.raises(ValueError, match="closed"):
        painter.paint()


def test_the_example_of_the_gallery_runs_and_nothing_is_said_at_the_end():
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "gallery.md").read_text(), re.DOTALL)
    script = f"import mujoco\n{example}\nassert picture.shape == (480, 480, 3)"
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"} | {"JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert "Error" not in done.stderr and "Exception" not in done.stderr
