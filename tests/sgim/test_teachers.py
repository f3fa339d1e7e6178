"""Teachers: what they show, which demonstration is asked for, and the files that demonstrations are kept in."""

import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs.common.errors import UserError
from envs.tasks import TASKS, own
from star.sgim import teachers
from star.sgim.teachers import Demonstrations
from star.spec import Spec

SPEC = Spec(
    state_dim=4,
    action_size=2,
    episode_length=10,
    abstract_indices=(0, 1),
    goal_indices=(0, 1),
    subgoal_scale=(1.0, 1.0),
    space=((-4.0, -4.0), (20.0, 20.0)),
    region_cuts=((), ()),
    success_radius=1.0,
)


def shown(n=3, *, actions=True, seed=0):
    """`n` demonstrations of two waypoints and up to four env steps, as NumPy arrays by name."""
    rng = np.random.default_rng(seed)

    def points(*shape):
        return rng.uniform(-4, 20, (*shape, 2)).astype(np.float32)

    outcomes = points(n)
    arrays = {"starts": points(n), "outcomes": outcomes, "waypoints": np.stack([points(n), outcomes], axis=1)}
    if actions:
        arrays["states"] = rng.normal(size=(n, 5, 4)).astype(np.float32)
        arrays["actions"] = rng.uniform(-1, 1, (n, 5, 2)).astype(np.float32)
        arrays["lengths"] = rng.integers(1, 5, n).astype(np.int32)
    return arrays


def demonstrations(*args, **kwargs):
    return Demonstrations(**shown(*args, **kwargs))


# Compiled once, not each time that a test calls them.
nearest = jax.jit(teachers.nearest)
repetitive, wrong_half = jax.jit(teachers.repetitive), jax.jit(teachers.wrong_half)
other_body = jax.jit(teachers.other_body)


def a_file(tmp_path, **changes):
    """A good file with other arrays in place of its own, or without those that are None."""
    path = tmp_path / "demos.npz"
    arrays = {"format": 1, "env": "point_maze"} | shown() | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def task(name):
    """All that `shortest_paths` looks at in an environment, without its physics."""
    row = TASKS[name]
    return SimpleNamespace(arena=row.arena, switch=row.switch, abstract_indices=row.geometry.abstract_indices)


@settings(max_examples=20)
@given(st.sampled_from([1, 5]), st.integers(0, 99), st.booleans())
def test_the_nearest_demonstration_is_the_one_that_looking_at_each_finds(n, seed, by_start):
    demos = demonstrations(n, actions=False, seed=seed)
    start, goal = np.random.default_rng(seed + 100).uniform(-4, 20, (2, 5, 2)).astype(np.float32)
    asked = np.asarray(nearest(demos, start if by_start else None, goal))
    for i in range(5):
        apart = [
            np.sum((goal[i] - outcome) ** 2) + by_start * np.sum((start[i] - begin) ** 2)
            for begin, outcome in zip(np.asarray(demos.starts), np.asarray(demos.outcomes), strict=True)
        ]
        assert apart[asked[i]] == pytest.approx(min(apart), rel=1e-5)


def test_the_nearest_is_found_for_one_learner_for_many_and_in_a_compiled_program():
    demos = demonstrations(5, actions=False)
    starts, goals = demos.starts[::-1], demos.outcomes[::-1]
    many = nearest(demos, starts, goals)
    one_by_one = jax.vmap(lambda start, goal: teachers.nearest(demos, start, goal))(starts, goals)
    assert many.tolist() == one_by_one.tolist() == [4, 3, 2, 1, 0]
    assert nearest(demos, None, goals[1]).tolist() == 3


@pytest.mark.parametrize("name", TASKS)
def test_the_map_of_every_task_can_be_shown(name):
    env = task(name)
    demos = jax.tree.map(np.asarray, teachers.shortest_paths(env))
    d, cells = len(env.abstract_indices), env.arena.centres("0rg")
    assert demos.starts.shape == demos.outcomes.shape and demos.waypoints.shape[::2] == (len(demos.starts), d)
    np.testing.assert_array_equal(demos.waypoints[:, -1], demos.outcomes)
    pairs = {(*start[:2], *end[:2]) for start, end in zip(demos.starts, demos.outcomes, strict=True)}
    assert len(pairs) == len(demos.starts) <= len(cells) ** 2 and {(*cell, *cell) for cell in cells} <= pairs
    if not any(env.arena.cells("DB")):
        assert len(pairs) == len(cells) ** 2
    assert (demos.waypoints[:, 0] == demos.waypoints[:, -1]).all(axis=-1).any()
    assert (demos.waypoints[:, -2] != demos.outcomes).any(), "no waypoint more than the longest route needs"


def test_the_ant_is_shown_how_to_stand_beyond_the_gap():
    env = envs.make("ant_fall", engine="native")
    demos = teachers.shortest_paths(env)
    asked = nearest(demos, np.float32([0.0, 0.0, 4.5]), np.float32([0.0, 27.0, 4.5]))
    np.testing.assert_array_equal(
        np.asarray(demos.waypoints)[asked], [[8.0, 0.0, 4.5], [8.0, 24.0, 4.5], [0.0, 24.0, 4.5], [0.0, 24.0, 4.5]]
    )


def test_the_environment_says_where_the_gate_opens():
    demos = teachers.shortest_paths(envs.make("point_maze_cam", cell=4.0))
    asked = nearest(demos, np.zeros(2, np.float32), np.float32([0.0, 8.0]))
    np.testing.assert_array_equal(np.asarray(demos.waypoints)[asked], [[9.0, 0.0], [8.0, 8.0], [0.0, 8.0]])


def test_of_a_large_map_some_cells_spread_over_it_are_shown_and_the_start_is_among_them():
    rows = ["1" * 17, "1r" + "0" * 14 + "1", *["1" + "0" * 15 + "1"] * 8, "1" * 17]
    arena = own("point", "\n".join(rows), cell=2.0).arena
    demos = teachers.shortest_paths(SimpleNamespace(arena=arena, switch=None, abstract_indices=(0, 1)))
    starts = {tuple(start) for start in np.asarray(demos.starts).tolist()}
    assert teachers.MAX_ENDS <= len(starts) <= teachers.MAX_ENDS + 1 and (0.0, 0.0) in starts
    assert len(demos.starts) == len(starts) ** 2
    for cell in arena.centres("0r"):
        assert min(np.linalg.norm(cell - start) for start in starts) <= 2 * arena.cell


def test_a_repetitive_teacher_always_shows_the_same():
    demos = demonstrations(5)
    poor = repetitive(demos)
    far = int(np.argmax(np.linalg.norm(np.asarray(demos.outcomes - demos.starts), axis=-1)))
    assert set(nearest(poor, demos.starts, demos.outcomes).tolist()) == {0}
    np.testing.assert_array_equal(np.asarray(poor.actions)[0], demos.actions[far])
    assert len(poor.lengths) == 1


def test_a_teacher_of_the_wrong_half_knows_nothing_near_the_goal():
    demos, goal = demonstrations(5), np.float32([0.0, 16.0])
    poor = jax.device_get(wrong_half(demos, goal))
    away = sorted(np.linalg.norm(np.asarray(demos.outcomes) - [0, 16], axis=-1).tolist())
    kept = sorted(np.linalg.norm(np.asarray(poor.outcomes) - [0, 16], axis=-1).tolist())
    assert kept == pytest.approx(away[2:])
    for start, actions in zip(poor.starts, poor.actions, strict=True):
        (same,) = np.flatnonzero((np.asarray(demos.starts) == start).all(axis=-1))
        np.testing.assert_array_equal(actions, demos.actions[same])


def test_a_teacher_of_another_body_promises_the_same_and_shows_something_else():
    demos = demonstrations(5)
    poor = jax.device_get(other_body(demos))
    np.testing.assert_array_equal(poor.outcomes, demos.outcomes)
    np.testing.assert_array_equal(poor.waypoints[:, -1], demos.outcomes)
    np.testing.assert_array_equal(poor.actions, np.asarray(demos.actions)[..., ::-1])
    back = other_body(poor)
    np.testing.assert_allclose(back.waypoints, demos.waypoints, atol=1e-5)


def test_the_mirrored_route_of_the_maze_runs_into_its_wall():
    demos = teachers.shortest_paths(task("point_maze"))
    poor = other_body(demos)
    asked = nearest(poor, np.zeros(2, np.float32), np.float32([0.0, 16.0]))
    np.testing.assert_array_equal(np.asarray(poor.waypoints)[asked], [[0.0, 0.0], [0.0, 16.0], [0.0, 16.0]])
    assert poor.actions is None


@settings(max_examples=15)
@given(st.sampled_from([1, 3]), st.booleans(), st.integers(0, 99))
def test_what_is_saved_is_loaded(tmp_path_factory, n, actions, seed):
    path = tmp_path_factory.mktemp("files") / "demos.npz"
    demos = demonstrations(n, actions=actions, seed=seed)
    teachers.save(path, demos, env="point_maze")
    loaded = teachers.load(path, env="point_maze", spec=SPEC)
    assert jax.tree.structure(loaded) == jax.tree.structure(demos)
    for new, old in zip(jax.tree.leaves(loaded), jax.tree.leaves(demos), strict=True):
        assert new.dtype == old.dtype
        np.testing.assert_array_equal(new, old)


def test_the_shown_map_can_be_saved_and_loaded(tmp_path):
    env = envs.make("point_maze")
    demos = teachers.shortest_paths(env)
    teachers.save(tmp_path / "map.npz", demos, env=env.name)
    loaded = teachers.load(tmp_path / "map.npz", env=env.name, spec=Spec.of(env))
    np.testing.assert_array_equal(loaded.waypoints, demos.waypoints)


def test_numbers_of_other_sizes_are_read(tmp_path):
    wide = {name: array.astype(float) for name, array in shown().items() if name != "lengths"}
    demos = teachers.load(a_file(tmp_path, **wide, lengths=shown()["lengths"].astype(np.uint8)), **ABOUT)
    assert demos.states.dtype == jnp.float32 and demos.lengths.dtype == jnp.int32
    np.testing.assert_array_equal(demos.starts, shown()["starts"])


ABOUT = {"env": "point_maze", "spec": SPEC}


def changed(name, index, value):
    array = shown()[name]
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        pytest.param({"format": 2}, "format 2 is newer than 1", id="newer"),
        pytest.param({"format": 0}, "format is not a whole number from 1 to 1", id="no such format"),
        pytest.param({"format": "1"}, "format is not a whole number", id="format as text"),
        pytest.param({"format": None}, "holds no format", id="no format"),
        pytest.param({"env": None}, "holds no env", id="no task"),
        pytest.param({"env": 3}, "env is not the name of a task", id="task as a number"),
        pytest.param({"env": "ant_maze"}, "holds demonstrations in 'ant_maze', not in 'point_maze'", id="other task"),
        pytest.param({"speed": 1.0}, "holds an unknown array 'speed'; allowed: format, env, starts", id="unknown"),
        pytest.param({"outcomes": None}, "holds no outcomes", id="missing"),
        pytest.param({"actions": None}, "holds no actions", id="states without actions"),
        pytest.param({"states": None, "actions": None}, "holds no states", id="lengths alone"),
        pytest.param({"starts": np.zeros((3, 3))}, "starts has the shape [3, 3]; allowed: [N, 2]", id="dimensions"),
        pytest.param({"outcomes": np.zeros((2, 2))}, "outcomes has the shape [2, 2]; allowed: [3, 2]", id="number"),
        pytest.param({"waypoints": np.zeros((3, 2))}, "waypoints has the shape [3, 2]; allowed: [3, L, 2]", id="axes"),
        pytest.param({"states": np.zeros((3, 5, 30))}, "[3, 5, 30]; allowed: [3, T, 4]", id="another state"),
        pytest.param({"actions": np.zeros((3, 5, 8))}, "[3, 5, 8]; allowed: [3, 5, 2]", id="another body"),
        pytest.param({"actions": np.zeros((3, 4, 2))}, "[3, 4, 2]; allowed: [3, 5, 2]", id="another length"),
        pytest.param({k: v[:0] for k, v in shown().items()}, "[0, 2]: nothing is demonstrated", id="empty"),
        pytest.param({"waypoints": np.zeros((3, 0, 2))}, "[3, 0, 2]: nothing is demonstrated", id="no waypoint"),
        pytest.param({"starts": np.zeros((3, 2), int)}, "starts is int64; allowed: floating-point", id="integers"),
        pytest.param({"starts": np.zeros((3, 2), complex)}, "starts is complex128", id="complex numbers"),
        pytest.param({"lengths": np.ones(3)}, "lengths is float64; allowed: whole numbers", id="half a step"),
        pytest.param({"lengths": np.array([1, 0, 2])}, "lengths[1] is 0; allowed: 1 to 4", id="too short"),
        pytest.param({"lengths": np.array([1, 2, 5])}, "lengths[2] is 5; allowed: 1 to 4", id="too long"),
        pytest.param(changed("starts", (1, 0), np.nan), "starts[1, 0] is nan; allowed: finite", id="not a number"),
        pytest.param(changed("states", (0, 2, 3), -np.inf), "states[0, 2, 3] is -inf; allowed: finite", id="infinite"),
        pytest.param({"states": np.full((3, 5, 4), 1e300)}, "states[0, 0, 0] is inf", id="beyond float32"),
        pytest.param(changed("actions", (2, 0, 1), 1.5), "actions[2, 0, 1] is 1.5; allowed: -1 to 1", id="too strong"),
        pytest.param(
            changed("starts", (2, 1), 27), "starts[2, 1] is 27; allowed: [-10, -10] to [26, 26]", id="far away"
        ),
        pytest.param(changed("waypoints", (1, 1, 0), -4.5), "waypoints[1] do not end with its outcome", id="astray"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_in_one_line(tmp_path, changes, said):
    path = a_file(tmp_path, **changes)
    with pytest.raises(UserError) as error:
        teachers.load(path, **ABOUT)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and said in message and "\n" not in message


def test_a_file_made_for_a_body_in_three_dimensions_is_refused(tmp_path):
    spec = replace(SPEC, abstract_indices=(0, 1, 2), space=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
    with pytest.raises(UserError, match=r"starts has the shape \[3, 2\]; allowed: \[N, 3\]"):
        teachers.load(a_file(tmp_path), env="point_maze", spec=spec)


def test_a_missing_file_is_refused_with_the_name_of_one_like_it(tmp_path):
    path = a_file(tmp_path)
    with pytest.raises(UserError) as error:
        teachers.load(tmp_path / "demo.npz", **ABOUT)
    assert str(error.value) == f"{tmp_path / 'demo.npz'}: no such file (did you mean {path}?)"


def _write_one_array(path):
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda path: path.write_text("starts: [0, 0]\n"), id="text"),
        pytest.param(lambda path: path.write_bytes(b""), id="nothing"),
        pytest.param(lambda path: path.write_bytes(b"PK\x03\x04 and no more"), id="broken archive"),
        pytest.param(_write_one_array, id="one array"),
        pytest.param(lambda path: np.savez(path, starts=np.array([{}])), id="Python objects"),
        pytest.param(lambda path: path.mkdir(), id="folder"),
    ],
)
def test_what_is_no_file_of_arrays_is_refused_in_one_line(tmp_path, write):
    path = tmp_path / "demos.npz"
    write(path)
    with pytest.raises(UserError) as error:
        teachers.load(path, **ABOUT)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


def _array(shape, data=b""):
    """An array of floats as a file of NumPy, with a header that may not be true of its data."""
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}".encode()
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ({"starts.npy": _array((10**15,))}, "starts.npy is shorter than it claims"),
        ({"starts.npy": _array((2, 10**9), b"\0" * 80)}, "starts.npy is shorter than it claims"),
        ({f"{i}.npy": _array((0,)) for i in range(17)}, "holds 17 arrays; allowed: up to 16"),
        ({"starts.npy": _array((2000,), b"\0" * 8000)}, "holds 0.0 GiB; allowed: up to"),
    ],
)
def test_an_archive_that_would_take_much_memory_is_refused_unread(tmp_path, monkeypatch, members, said):
    monkeypatch.setattr(teachers, "MAX_BYTES", 4000)
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("was read"))
    path = tmp_path / "demos.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    with pytest.raises(UserError) as error:
        teachers.load(path, **ABOUT)
    assert str(error.value).startswith(f"{path}: {said}") and "\n" not in str(error.value)


def test_a_device_is_no_file_of_demonstrations():
    with pytest.raises(UserError, match="/dev/zero: cannot be read: Not a regular file"):
        teachers.load(Path("/dev/zero"), **ABOUT)


@settings(max_examples=60)
@given(st.data())
def test_a_damaged_file_is_read_as_it_was_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("files") / "demos.npz"
    teachers.save(path, demonstrations(), env="point_maze")
    whole = bytearray(path.read_bytes())
    where = data.draw(st.integers(0, len(whole) - 1))
    damaged = whole[:where] if data.draw(st.booleans()) else whole
    if damaged is whole:
        whole[where] ^= data.draw(st.integers(1, 255))
    path.write_bytes(damaged)
    try:
        demos = teachers.load(path, **ABOUT)
    except UserError as error:
        assert "\n" not in str(error)
    else:
        np.testing.assert_array_equal(demos.waypoints, demonstrations().waypoints)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("old.npz", "exists; replace it with --force"),
        ("demos.csv", "cannot tell what to write; allowed endings: .npz"),
        ("nowhere/demos.npz", "there is no folder"),
    ],
)
def test_what_cannot_be_written_is_refused_and_nothing_is_overwritten(tmp_path, name, said):
    (tmp_path / "old.npz").write_text("precious")
    with pytest.raises(UserError) as error:
        teachers.save(tmp_path / name, demonstrations(), env="point_maze")
    assert said in str(error.value) and "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["old.npz"]
    assert (tmp_path / "old.npz").read_text() == "precious"


def test_an_existing_file_is_replaced_on_request(tmp_path):
    (tmp_path / "old.npz").write_text("worthless")
    teachers.save(tmp_path / "old.npz", demonstrations(), env="point_maze", force=True)
    assert len(teachers.load(tmp_path / "old.npz", **ABOUT).starts) == 3
