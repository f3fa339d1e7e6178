"""Modes, types, files and shells as people have them: what works, and what is refused in one line that names it."""

from __future__ import annotations

import ast
import copy
import errno
import hashlib
import io
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from matplotlib import pyplot
from rich.console import Console

import envs
from envs.common import files, reading
from envs.common.errors import UserError
from star import cli, sgim
from star.abstraction import regions
from star.agent import environment
from star.cli.streams import unbroken
from star.cli.words import split_settings
from star.config import command_line
from star.config.loading import parse
from star.sgim import teachers
from star.spec import Spec
from star.sweeps.ledger import sqlalchemy_url, sqlite_url
from star.training import program as programs
from star.training.compatibility import differences
from star.training.figures import literal
from star.training.signals import interruptible
from tests.scripts import load

ROOT = Path(__file__).parents[1]
NOTED = sorted(ROOT.glob("results/compatibility/*.json"))


def test_environments_refuse_modes_in_which_numbers_are_others():
    with jax.enable_x64(True), pytest.raises(UserError, match="JAX_ENABLE_X64"):
        envs.make("point_maze")
    with jax.numpy_dtype_promotion("strict"), pytest.raises(UserError, match="JAX_NUMPY_DTYPE_PROMOTION"):
        envs.make("point_maze")


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("begun", [True, False])
def test_an_environment_that_travels_goes_on_where_it_was(copied, begun):
    env = gymnasium.make("star/PointMaze-v0")
    if begun:
        env.reset(seed=1)
        env.step(np.full(2, 0.3, np.float32))
    other = copied(env)
    if not begun:
        env.reset(seed=3), other.reset(seed=3)
    for _ in range(3):
        ours, theirs = (one.step(np.ones(2, np.float32)) for one in (env, other))
        np.testing.assert_equal(theirs, ours)
    np.testing.assert_equal(other.reset()[0], env.reset()[0])


def test_a_batch_of_environments_travels_too():
    batch = envs.VectorEnv(envs.make("point_maze"), 2, auto_reset=False)
    other = pickle.loads(pickle.dumps(batch))
    assert (other.num_envs, other.auto_reset) == (2, False)
    walks = [jax.jit(lambda key, one=one: one.step(one.reset(key), jnp.ones((2, 2)))) for one in (batch, other)]
    states = [walk(jax.random.key(0)) for walk in walks]
    np.testing.assert_array_equal(states[0].obs, states[1].obs)


@pytest.mark.parametrize("num_envs", [0, -1])
def test_a_batch_of_none_is_refused(num_envs):
    with pytest.raises(UserError, match="num_envs"):
        envs.VectorEnv(envs.make("point_maze"), num_envs)


@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (2,), (2, 2, 1)])
def test_actions_of_another_shape_are_named(shape):
    batch = envs.VectorEnv(envs.make("point_maze"), 2)
    with pytest.raises(UserError, match=r"the shape of the actions .* allowed: \(2, 2\)"):
        batch.step(jax.eval_shape(batch.reset, jax.random.key(0)), jnp.ones(shape))


ROWS = ["111111", "1r00g1", "111111"]


@pytest.mark.parametrize(
    ("name", "value", "plain"),
    [
        ("episode_length", np.int64(20), 20),
        ("episode_length", np.array(20), 20),
        ("cell", np.float32(4), 4.0),
        ("success_radius", np.float64(0.5), 0.5),
        ("map", ROWS, "\n".join(ROWS) + "\n"),
        ("map", tuple(ROWS), "\n".join(ROWS) + "\n"),
    ],
)
def test_options_take_what_their_plain_twins_take(name, value, plain):
    ours, theirs = (envs.make("point_maze", **{name: one}) for one in (value, plain))
    assert (ours.episode_length, ours.arena, ours.success_radius) == (
        theirs.episode_length,
        theirs.arena,
        theirs.success_radius,
    )
    assert parse({"env": {"options": {name: value}}}).env.options[name] in (plain, ROWS)


@pytest.mark.parametrize("rows", [ROWS, tuple(ROWS), np.array(ROWS)])
def test_rows_of_a_map_are_its_text_in_a_run_and_in_gymnasium(rows):
    text = "\n".join(ROWS) + "\n"
    config = parse({"env": {"options": {"map": rows}}})
    resolved = programs.build(config).config
    assert resolved.env.options["map"] == text
    made = gymnasium.make("star/PointMaze-v0", map=rows, episode_length=np.array(20)).unwrapped
    assert made.maze.arena == envs.make("point_maze", map=text).arena


def test_settings_take_numbers_of_numpy_and_paths(tmp_path):
    (tmp_path / "maze.txt").write_text("\n".join(ROWS))
    values = {"trainer": {"num_envs": np.int32(8), "seed": np.uint32(3)}, "tutor": {"reward_scale": np.float32(0.5)}}
    config = parse(values, {"env.options": {"map": tmp_path / "maze.txt"}, "controller.ppo.hidden": np.array([8, 8])})
    assert (config.trainer.num_envs, config.trainer.seed, config.tutor.reward_scale) == (8, 3, 0.5)
    assert config.env.options["map"] == str(tmp_path / "maze.txt") and config.controller.ppo.hidden == (8, 8)
    assert envs.make("point_maze", map=tmp_path / "maze.txt").arena == envs.make("point_maze", map=ROWS).arena


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("text", ["\n".join(ROWS), "map: |\n  " + "\n  ".join(ROWS)])
def test_a_map_may_begin_with_a_byte_order_mark(tmp_path, text, end):
    path = tmp_path / ("maze.yaml" if text.startswith("map") else "maze.txt")
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", end).encode())
    assert envs.make("point_maze", map=str(path)).arena == envs.make("point_maze", map=ROWS).arena


@pytest.mark.parametrize("number", ["1e-46", "-1e-40", "1e-400"])
def test_a_number_that_float32_makes_0_is_refused(number, tmp_path, capsys):
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", str(tmp_path / "run")]
    assert cli.main([*command, "--controller.ppo.learning_rate", number]) == 2
    assert "controller.ppo.learning_rate" in capsys.readouterr().err and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "command",
    [
        ["train", "configs/point_maze.yaml", "--run-dir", "{}"],
        ["sweep", "configs/sweeps/three_values.yaml", "--out", "{}"],
        ["evaluate", "{run}", "--out", "{}"],
        ["record", "{run}", "--out", "{}.npz"],
        ["report", "{run}", "--out", "{}.html"],
        ["render", "point_maze", "--out", "{}.png"],
    ],
    ids=lambda command: command[0],
)
def test_a_name_that_is_not_utf8_is_refused_before_anything_is_made(command, tmp_path, capsys):
    name, run = os.fsdecode(os.fsencode(tmp_path) + b"/r\xff"), tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("env: {name: point_maze}\n")
    words = [str(ROOT / word) if word.startswith("configs") else word.format(name, run=run) for word in command]
    assert cli.main(words) == 2
    assert "not UTF-8" in capsys.readouterr().err and list(tmp_path.iterdir()) == [run]


def test_cells_that_nobody_reaches_are_told_of_in_one_line_of_a_command(tmp_path, capsys):
    sealed = "\n".join(["11111", "1r0g1", "11111", "11011", "11111"])
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--env.options.map", sealed]
    assert cli.main([*command, "--run-dir", str(tmp_path / "run"), "--abstraction.max_regions", "2"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["note", "error"] and "row 4, column 3" in lines[0]


@pytest.mark.parametrize("mode", [jax.enable_x64(True), jax.numpy_dtype_promotion("strict")])
def test_goal_selection_alone_refuses_the_modes_that_environments_refuse(mode):
    bins = regions.create(([0.0], [3.0]), [[1.0, 2.0]], max_regions=8)
    with mode:
        with pytest.raises(UserError, match="JAX_"):
            sgim.init(sgim.Config(), bins, costs=[1.0])
        with pytest.raises(UserError, match="JAX_"):
            regions.create(([0.0], [3.0]), [[1.0, 2.0]], max_regions=8)


def test_printed_commands_can_be_typed(tmp_path, capsys):
    assert command_line.of("evaluate", Path("runs/a b")) == "star evaluate 'runs/a b'"
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "config.yaml").touch()
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", str(tmp_path / "a b")]
    assert cli.main(command) == 2
    assert f"star train --resume '{tmp_path}/a b'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "value"),
    [("010", 10), ("08", 8), ("-007", -7), ("0x10", 16), ("0b11", 3), ("1_000", 1000), ("1e-4", 1e-4), (".5", 0.5)]
    + [(text, text) for text in ("1:30", "1:30:00", "2024-01-02", "1.2.3", "e5", "1e", "0x", "-.")],
)
def test_numbers_are_those_that_people_mean(text, value, tmp_path):
    found = reading.plain(text)
    assert found == value and type(found) is type(value)
    assert reading.plain(reading.written({"x": text}))["x"] == text
    assert yaml.safe_load(reading.written({"x": text, "y": value})) == {"x": text, "y": value}


def test_a_padded_seed_is_that_seed_and_a_time_is_no_number(tmp_path, capsys):
    found, _ = split_settings(["--trainer.seed", "010"]), None
    assert parse({}, found[1]).trainer.seed == 10
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", str(tmp_path / "run")]
    assert cli.main([*command, "--total-env-steps", "1:30:00"]) == 2
    assert "trainer.total_env_steps: '1:30:00'" in capsys.readouterr().err


class Gone(io.StringIO):
    """A stream whose other end is gone."""

    encoding = "utf-8"

    def write(self, text):
        raise OSError(errno.EIO, "Input/output error")


def test_a_command_goes_on_when_nobody_sees_its_output(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", Gone())
    monkeypatch.setattr(sys, "stdout", Gone())
    with unbroken() as out:
        Console(stderr=True).print("progress")
        print("result")
    assert out.error.errno == errno.EIO and isinstance(sys.stdout, Gone)


def test_letters_that_a_stream_lacks_are_written_as_escapes(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    with unbroken():
        print("\N{GREEK SMALL LETTER ALPHA}!")
    assert stream.buffer.getvalue() == b"\\u03b1!\n"


@pytest.mark.parametrize(("place", "code"), [("/dev/full", 2), ("pipe", 0)])
def test_a_list_that_nobody_reads_ends_well_and_one_that_cannot_be_written_is_told(place, code):
    reads, writes = os.pipe()
    os.close(reads)
    command, environment = [sys.executable, "-m", "star", "settings"], os.environ | {"PYTHONPATH": str(ROOT)}
    with open(place, "wb") if code else os.fdopen(writes, "wb") as out:
        done = subprocess.run(command, env=environment, stdout=out, stderr=subprocess.PIPE, text=True)
    expected = "error: standard output cannot be written: No space left on device\n" if code else ""
    assert (done.returncode, done.stderr) == (code, expected)


def test_signals_are_the_callers_outside_of_the_main_thread():
    found = []

    def work():
        with interruptible() as stop:
            found.append(stop())

    before = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [False] and signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(("as_it_was", "heard"), [(signal.SIG_DFL, True), (signal.SIG_IGN, False)])
def test_a_closed_terminal_stops_a_run_as_sigterm_does_unless_it_is_ignored(as_it_was, heard):
    before = signal.signal(signal.SIGHUP, as_it_was)
    try:
        with interruptible() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert (stop(), stop.terminated) == (heard, heard)
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("name", ["lr=[1e-3]", "a\\b"])
def test_a_folder_that_orbax_takes_for_a_pattern_is_refused(name, tmp_path, capsys):
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", str(tmp_path / name / "run")]
    assert cli.main(command) == 2
    assert "a run cannot be kept there" in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def test_two_commands_in_one_second_get_a_place_each(tmp_path):
    places = {files.new_place(tmp_path / "runs", "maze") for _ in range(3)}
    assert len(places) == 3 and all(place.is_dir() for place in places)


def test_what_is_refused_leaves_no_place_behind(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--abstraction.max_regions", "2"]
    assert cli.main(command) == 2 and capsys.readouterr().err.count("\n") == 1
    assert list((tmp_path / "runs").iterdir() if (tmp_path / "runs").exists() else []) == []


def test_a_run_knows_its_teachers_file_by_its_checksum(tmp_path):
    source = tmp_path / "demos.npz"
    source.write_bytes(b"1")
    teacher = {"name": "expert", "kind": "decomposition", "source": str(source)}
    config = parse({"sgim": {"teachers": [teacher]}})
    resolved = programs.build(config).config
    noted = resolved.sgim.teachers[0].sha256
    assert noted == hashlib.sha256(b"1").hexdigest()
    before = resolved.model_dump(mode="json")
    before["sgim"]["teachers"][0]["sha256"] = None  # as in runs from before
    assert list(differences(parse(before), resolved)) == []
    np.savez(source, format=np.int32(1))
    with pytest.raises(UserError, match=f"is not the file that the run began with; its SHA-256 was {noted}"):
        teachers.load(source, env="point_maze", spec=Spec.of(environment.make(config, "test")), sha256=noted)


@pytest.mark.parametrize("kind", ["rbg", "unsafe_rbg"])
def test_runs_draw_the_same_whatever_keys_jax_makes(kind):
    expected = jax.random.key_data(programs.seed_keys([3])), programs.evaluation_keys([3], [1], stream=2)
    with jax.default_prng_impl(kind):
        found = jax.random.key_data(programs.seed_keys([3])), programs.evaluation_keys([3], [1], stream=2)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(*(jax.random.key_data(keys[1]) for keys in (found, expected)))


def test_a_run_refuses_to_draw_other_numbers_than_it_did():
    with jax.threefry_partitionable(False), pytest.raises(UserError, match="^JAX_THREEFRY_PARTITIONABLE: is off"):
        programs.build(parse({}))


def test_a_name_with_an_underscore_in_front_is_in_the_legend():
    _, axis = pyplot.subplots()
    axis.plot([0], label=literal("_baseline"))
    assert [text.get_text().strip() for text in axis.legend().get_texts()] == ["_baseline"]


def test_pictures_may_be_drawn_in_any_thread(can_draw):
    env = gymnasium.make("star/PointMaze-v0", render_mode="rgb_array", width=32, height=32)
    env.reset(seed=0)
    here = env.render()
    with ThreadPoolExecutor(3) as pool:
        others = list(pool.map(lambda _: env.render(), range(6)))
    for other in [*others, env.render()]:
        np.testing.assert_array_equal(other, here)


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")  # Python's own, from 3.12 on
def test_a_process_forked_from_one_that_runs_jax_is_told_so_instead_of_hanging():
    gymnasium.make("star/PointMaze-v0")
    with pytest.warns(RuntimeWarning, match="fork"):
        child = os.fork()
    if child == 0:  # nothing of pytest may go on here
        try:
            gymnasium.make("star/PointMaze-v0")
        except envs.EnvError as error:
            os._exit(7 if "forked" in str(error) else 8)
        finally:
            os._exit(9)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


@pytest.mark.parametrize("name", ["what?next", "a%20b", "x#y", "d b"])
def test_a_sweep_keeps_its_database_in_a_folder_of_any_name(name, tmp_path):
    folder = tmp_path / name
    folder.mkdir()
    assert sqlalchemy_url(sqlite_url(folder / "sweep.db")).database == str(folder / "sweep.db")


def test_what_is_imported_leaves_the_loggers_of_the_user_alone():
    words = "import logging, star.training.trainer, envs.gym; assert logging.root.handlers == []"
    subprocess.run([sys.executable, "-c", words], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)


@pytest.fixture(scope="module")
def matrix():
    return load("checks/matrix")


@pytest.mark.parametrize("mode", [partial(jax.debug_infs, True), partial(jax.numpy_rank_promotion, "raise")])
@pytest.mark.parametrize("use", ["programs.build", "goal_selection"])
def test_what_learns_refuses_the_modes_that_it_does_not_run_in(matrix, mode, use):
    with mode(), pytest.raises(UserError, match="^JAX_(DEBUG_INFS: is on|NUMPY_RANK_PROMOTION: is raise)"):
        matrix.goal_selection() if use == "goal_selection" else programs.build(parse({}))


def test_goal_selection_makes_no_number_that_is_none(matrix):
    with jax.debug_nans(True):
        state = matrix.goal_selection()
    assert int(state.blocks) == 5


@pytest.mark.parametrize("title", ["Types of options", "Encodings of files"])
def test_a_sample_of_the_matrix_is_as_it_was_noted(matrix, title):
    """The page shows what the whole of it gave; here are those of its tables that take least."""
    found = {"Types of options": matrix.types, "Encodings of files": matrix.files}[title]()
    noted = [tables[title] for path in NOTED for tables in json.loads(path.read_text()).values()]
    assert len(noted) >= 1
    for table in noted:
        assert found == table


def test_the_matrix_has_no_fault_and_the_page_shows_it(matrix):
    both = {machine: tables for path in NOTED for machine, tables in json.loads(path.read_text()).items()}
    lines = [
        line for tables in both.values() for table in tables.values() for row in table.values() for line in row.values()
    ]
    assert len(lines) > 250 and not [line for line in lines if line.startswith("FAULT")]
    assert matrix.page(both) in (ROOT / "docs/compatibility.md").read_text(encoding="utf-8")


def test_the_matrix_tells_works_from_refused_from_faults(matrix):
    def refused():
        raise UserError("key: 3; allowed: 4")

    assert matrix.outcome(lambda: None) == "works"
    assert matrix.outcome(refused) == "key: 3; allowed: 4"
    assert matrix.outcome(lambda: 1 / 0).startswith("FAULT: ZeroDivisionError")


def test_every_mend_can_be_taken_back_and_has_its_test():
    for mend in load("checks/mends").MENDS:
        text = (ROOT / mend.file).read_text(encoding="utf-8")
        assert text.count(mend.now) == 1, mend.fault
        if mend.file.endswith(".py"):
            ast.parse(text.replace(mend.now, mend.before), mend.fault)
        file, _, name = mend.test.partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(encoding="utf-8"), mend.fault
