"""Modes, types, files and shells as people have them: what works, and what is refused in one line that names it."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.common.errors import UserError
from star import cli, sgim
from star import program as programs
from star.abstraction import regions
from star.loading import parse
from star.spec import Spec

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("mode", "value"),
    [
        ("JAX_ENABLE_X64", "1"),
        ("JAX_NUMPY_DTYPE_PROMOTION", "strict"),
        ("JAX_PLATFORMS", "cuda"),
        ("JAX_PLATFORMS", "abacus"),
    ],
)
def test_a_mode_that_nothing_runs_in_is_named_in_one_line_and_leaves_nothing_behind(mode, value, tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT), mode: value}
    command = [sys.executable, "-m", "star", "train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", "run"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {mode}: ") and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


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
    states = [one.step(one.reset(jax.random.key(0)), jnp.ones((2, 2))) for one in (batch, other)]
    np.testing.assert_array_equal(states[0].obs, states[1].obs)


@pytest.mark.parametrize("num_envs", [0, -1])
def test_a_batch_of_none_is_refused(num_envs):
    with pytest.raises(UserError, match="num_envs"):
        envs.VectorEnv(envs.make("point_maze"), num_envs)


@pytest.mark.parametrize("shape", [(3, 2), (2, 3), (2,), (2, 2, 1)])
def test_actions_of_another_shape_are_named(shape):
    batch = envs.VectorEnv(envs.make("point_maze"), 2)
    with pytest.raises(UserError, match=r"the shape of the actions .* allowed: \(2, 2\)"):
        batch.step(batch.reset(jax.random.key(0)), jnp.ones(shape))


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
    resolved = programs.resolve(config, "jax", Spec.of(programs.make_env(config, "test")))
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


def test_printed_commands_can_be_typed(tmp_path):
    assert cli._typed(Path("runs/a b")) == "'runs/a b'" and cli._typed(Path("runs/ab")) == "runs/ab"
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "x").touch()
    command = ["train", str(ROOT / "configs/point_maze.yaml"), "--run-dir", str(tmp_path / "a b")]
    done = subprocess.run(
        [sys.executable, "-m", "star", *command],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and f"star train --resume '{tmp_path}/a b'" in done.stderr
