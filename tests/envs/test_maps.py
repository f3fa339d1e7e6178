import warnings

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from envs import arena as arenas
from envs.arena import Arena, unreached
from envs.common.errors import Notice
from envs.maze import sample
from envs.tasks import TASKS

OWN = """
11111
1r001
11101
1g001
11111
"""


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("11111\n1r001\n1111", ["row 3", "4 cells", "row 1 has 5"]),
        ("11111\n10001\n11111", ["no start", '"r"']),
        ("11111\n1r0x1\n11111", ["row 2, column 4", "'x'", "1 0 r g # B D"]),
        ("11111\n1r1g1\n11111", ["goal", "row 2, column 4", "cannot be reached"]),
        ("11111\n1r#g1\n11111", ["goal", "row 2, column 4", "cannot be reached"]),
        ("11111\n1r00g\n11111", ["row 2, column 5", "'g'", "outline"]),
        ("111\n1r1\n111", ["no free cell"]),
        ("1" * 65 + "\n" + "1r0" + "1" * 62, ["65", "64"]),
    ],
)
def test_a_malformed_map_is_told_by_row_and_column(rows, words):
    for name in ("point_maze", "ant_maze"):
        with pytest.raises(envs.EnvError) as caught:
            envs.make(name, map=rows)
        message = str(caught.value)
        assert "\n" not in message
        assert all(word in message for word in words)


@pytest.mark.parametrize(("symbol", "bodies"), [("D", ["point", "ant"]), ("B", ["point"]), ("#", ["point"])])
def test_what_a_body_can_do_nothing_with_is_refused(symbol, bodies):
    for body in ("point", "ant"):
        rows = f"11111\n1r0{symbol}1\n11111"
        if body in bodies:
            with pytest.raises(envs.EnvError, match="row 2, column 4 is a "):
                envs.make(f"{body}_maze", map=rows)
        else:
            assert envs.make(f"{body}_maze", map=rows, engine="native").arena.rows[1][3] == symbol


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yaml", "map: [1", ["is not YAML"]),
        ("a.yaml", "cell: 4\ncell: 5\nmap: |\n  111\n", ["is not YAML, line 2: cell is given twice"]),
        ("a.yaml", "rows: |\n  111", ["block of text"]),
        ("a.yaml", "map: |\n  111\nsize: 3", ['"size"', "map, cell, block"]),
        ("a.yaml", "map: |\n  111\ncell: big", ["'big'", "1.5 to 100"]),
        ("a.yaml", "map: |\n  111\ncell: .nan", ["nan", "1.5 to 100"]),
        ("a.yaml", "map: |\n  111\nblock: zz", ["'zz'", "yz"]),
        ("a.yaml", "map: |\n  11111\n  1rB01\n  11111\nblock: yz", ["'yz'", "no cell is without floor"]),
        ("a.txt", "", ["is empty"]),
    ],
)
def test_a_malformed_file_is_told_by_its_path(tmp_path, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(envs.EnvError) as caught:
        envs.make("point_maze", map=str(path))
    message = str(caught.value)
    assert "\n" not in message and str(path) in message
    assert all(word in message for word in words)


def test_a_file_that_is_not_there_or_not_text_is_told(tmp_path):
    with pytest.raises(envs.EnvError, match="cannot be read"):
        envs.make("point_maze", map=str(tmp_path / "none.txt"))
    (tmp_path / "binary.txt").write_bytes(bytes(range(128, 256)))
    with pytest.raises(envs.EnvError, match="not a text file"):
        envs.make("point_maze", map=str(tmp_path / "binary.txt"))


@given(st.text(alphabet="10rg#BD\n x", max_size=40).map(lambda text: text + "\n\n."))
def test_any_text_is_a_map_or_refused_in_one_line(text):
    try:
        arena = arenas.read_arena(text, cell=4.0)
    except envs.EnvError as error:
        assert "\n" not in str(error)
    else:
        assert arena.free().size


def test_text_yaml_and_rows_give_the_same_arena(tmp_path):
    (tmp_path / "own.txt").write_text(OWN)
    (tmp_path / "own.yaml").write_text("cell: 4.0\nblock: xy\nmap: |" + OWN.replace("\n", "\n  "))
    rows, text = arenas.read_arena(OWN, cell=4.0), arenas.read_arena(str(tmp_path / "own.txt"), cell=4.0)
    assert rows == text == arenas.read_arena(str(tmp_path / "own.yaml"), cell=8.0)


def test_on_a_map_of_ones_own_goals_success_and_regions_follow_the_map():
    env = envs.make("point_maze", map=OWN, cell=4.0, goals="test")
    assert env.success_radius == 2.5
    # As in the text: +x points right, +y up, and the goal lies two rows below the start.
    assert [corner.tolist() for corner in env.space] == [[-2.0, -10.0], [10.0, 2.0]]
    assert env.region_cuts == ((4.0,), (-4.0,))
    assert TASKS["point_maze"].goals["test"].lower == ((0.0, 16.0),)
    assert env.reset(jax.random.key(0)).obs[-2:].tolist() == [0.0, -8.0]


def test_on_a_map_with_a_gap_nobody_in_it_is_near_a_goal():
    rows = "block: yz\nmap: |\n  1111\n  1001\n  1##1\n  10B1\n  1r01\n  1111"
    env = envs.make("ant_maze", engine="native", map=rows)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 100))
    goals = np.asarray(state.obs)[:, -2:]
    assert len(np.unique(goals, axis=0)) == 5
    assert (np.abs(goals[:, 1] - np.clip(goals[:, 1], 12.3, 19.7)) > env.success_radius).all()
    jax.jit(jax.vmap(env.step))(state, np.zeros((100, 8)))  # such a model can be stepped


def test_without_marked_goals_the_test_goal_is_the_longest_walk_away():
    assert arenas.farthest(TASKS["ant_maze"].arena) == (0.0, 16.0)
    assert arenas.farthest(Arena(("11111", "10r01", "10111", "11111"), 2.0)) == (-2.0, 2.0)


@pytest.mark.parametrize("name", envs.names())
def test_the_maps_of_all_tasks_are_sound(name):
    arenas.check(TASKS[name].arena, name=name)


SEALED = """
1111111
1r00101
1000101
1111111
"""


@pytest.mark.parametrize("options", [{"goals": "train"}, {"goals": "test"}, {"start": "free"}])
@pytest.mark.parametrize("name", ["point_maze", "ant_maze"])
def test_cells_that_nobody_reaches_are_told_of_and_hold_neither_goals_nor_starts(name, options):
    with pytest.warns(Notice, match=r"^map: 2 free cells cannot be reached .* row 2, column 6: taken for walls[^\n]*$"):
        env = envs.make(name, map=SEALED, cell=4.0, **options)
    assert env.arena.rows[1:3] == ("1000111", "1r00111")
    np.testing.assert_array_equal(env.space, [[-2.0, -6.0], [10.0, 2.0]])
    keys = jax.random.split(jax.random.key(0), 200)
    goals = jax.vmap(env.draw_goal)(keys)
    starts = jax.vmap(lambda key: sample(env._starts, key))(keys)
    assert (goals[:, 0] < 10).all() and (starts[:, 0] < 10).all()


def test_a_map_whose_cells_are_all_reached_says_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert unreached(envs.make("point_maze", map=OWN).arena) == []


def test_a_start_with_free_cells_behind_walls_alone_is_refused():
    with pytest.raises(envs.EnvError, match="no free cell beside the start"):
        envs.make("point_maze", map="11111\n1r101\n11111")
