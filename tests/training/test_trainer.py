"""Whole runs through the trainer, on a maze small enough to train in a second."""

from __future__ import annotations

import dataclasses
import gzip
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import envs
from envs.common.errors import UserError
from star import cli
from star.agent import figures
from star.agent.migrations import FORMAT
from star.config.loading import load, load_run, parse
from star.sgim import teachers
from star.training import checkpoint, loop, provenance, run_folder, signals, trainer
from star.training import program as programs
from star.training.checkpoint import Checkpoints
from star.training.compatibility import check_compatible
from star.training.journal import Journal, JsonLines
from star.training.lock import locked
from star.training.side_by_side import SideBySide
from tests.small import ALONE, EPOCH, RUN, unpacked

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("undrawn")
TIMES = ("wall_s", "env_steps_per_s")
# Like the runs of older formats in `tests/data`, whose epoch is then compiled once for all.
TINY = RUN | {
    "tutor": RUN["tutor"] | {"straight": False},
    "refinement": RUN["refinement"] | {"separate": False},
    "sgim": {
        "goals": True,
        "strategies": ["autonomous", "babbling"],
        "teachers": [{"name": "guide", "kind": "decomposition", "max_queries": 3}],
    },
    "trainer": RUN["trainer"]
    | {"checkpoint_every": 2, "num_seeds": 2, "keep_checkpoints": 3, "sinks": ["tensorboard"]},
}

# One seed, nobody who teaches or chooses goals, and the same regions all the time: it compiles in a third of the time.
STEADY = RUN | {"refinement": {"enabled": False}}


def tiny(**overrides):
    return small(TINY, **overrides)


def small(values=STEADY, **overrides):
    return parse(values, {key.replace("__", "."): value for key, value in overrides.items()})


def rows(run_dir):
    return [{k: v for k, v in row.items() if k not in TIMES} for row in JsonLines(run_dir / "metrics.jsonl").read()]


def saved_state(config, run_dir):
    program = programs.build(config)
    checkpoints = Checkpoints(run_dir)
    state = checkpoints.restore(checkpoints.steps()[-1], jax.eval_shape(program.init, program.seed_keys()))
    checkpoints.close()
    return jax.tree.map(np.asarray, state.replace(key=jax.random.key_data(state.key)))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of four epochs and two seeds that was never interrupted."""
    run_dir = tmp_path_factory.mktemp("runs") / "finished"
    result = trainer.train(tiny(), run_dir, quiet=True)
    return run_dir, result


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """A run of one seed whose regions stay as they are."""
    run_dir = tmp_path_factory.mktemp("runs") / "steady"
    trainer.train(small(), run_dir, quiet=True)
    return run_dir


def test_a_run_leaves_config_metrics_checkpoints_and_figure(finished):
    run_dir, result = finished
    assert result.env_steps == 4 * EPOCH and not result.interrupted
    assert {entry.name.split(".out.")[0] for entry in run_dir.iterdir()} == {
        "config.yaml", "metrics.jsonl", "regions.jsonl", "provenance.jsonl", "checkpoints", "figures", ".lock",
        "events", "seed_0", "seed_1",
    }  # fmt: skip
    for name in ("summary", "growth", "sgim"):
        assert (run_dir / "figures" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert Checkpoints(run_dir).steps() == [2 * EPOCH, 4 * EPOCH]


def test_config_yaml_holds_every_resolved_value_and_can_be_trained_again(finished):
    run_dir, _ = finished
    config = load(run_dir / "config.yaml")
    assert yaml.safe_load((run_dir / "config.yaml").read_text()) == config.model_dump(mode="json")


def test_metrics_have_a_line_for_each_epoch_and_seed(finished):
    run_dir, _ = finished
    table = rows(run_dir)
    assert [(row["env_steps"], row["seed"]) for row in table] == [(n * EPOCH, s) for n in (1, 2, 3, 4) for s in (0, 1)]
    assert all("train/success_any" in row and "abstraction/regions" in row for row in table)
    assert [row["env_steps"] // EPOCH for row in table if "eval/success_final" in row] == [2, 2, 4, 4]


def test_regions_have_a_line_for_each_evaluation_and_seed_and_cover_the_space(finished):
    run_dir, _ = finished
    table, metrics = Journal.of(run_dir, tables="regions").tables.read(), rows(run_dir)
    assert [(row["env_steps"], row["seed"]) for row in table] == [(n * EPOCH, s) for n in (2, 4) for s in (0, 1)]
    for row in table:
        lower, upper = np.array(row["lower"]), np.array(row["upper"])
        assert np.prod(upper - lower, axis=1).sum() == pytest.approx(24.0**2)
        before, same = (
            next(r for r in metrics if (r["env_steps"], r["seed"]) == (env_steps, row["seed"]))
            for env_steps in (row["env_steps"] - EPOCH, row["env_steps"])
        )
        assert len(lower) == same["abstraction/regions"]
        assert {len(row[key]) for key in ("chosen", "visited", "value", "target")} == {len(lower)}
        assert row["goal"] == [0, 16] and max(row["target"]) < len(lower)
        assert len(row["reaches"]) == before["refinement/edges"]
        assert len(row["misses"]) == before["refinement/misses"]


@pytest.mark.parametrize(
    ("moments", "shown"),
    [(None, [10, 20, 30, 40]), ([5, 15], [10, 20]), ([20, 25, 28, math.inf], [20, 30, 40])],
)
def test_the_figure_of_growth_shows_the_regions_at_the_moments_asked_for(monkeypatch, moments, shown):
    box = {"lower": [[0.0, 0.0]], "upper": [[1.0, 1.0]], "chosen": [1.0]}
    regions = [{"seed": seed, "env_steps": n} | box for n in (10, 20, 30, 40) for seed in (3, 4)]
    drawn = []
    monkeypatch.setattr(figures, "draw_regions", lambda axis, row, walls: drawn.append((row["seed"], row["env_steps"])))
    figures.growth_figure(regions=regions, walls=[], moments=moments)
    assert drawn == [(3, n) for n in shown]


def test_a_run_notes_each_time_it_begins_with_what_and_where(finished, tmp_path):
    run_dir, _ = finished
    (start,) = Journal.of(run_dir, tables="regions").provenance.read()
    assert (start["env_steps"], start["settings"]) == (0, {}) and start["device"].startswith("CPU, ")
    assert start["versions"]["jax"] == jax.__version__
    shutil.copytree(run_dir, tmp_path / "run")
    for changed in ({}, {"tutor__reward_scale": 3.0, "trainer__sinks": []}):
        trainer.train(tiny(**changed), tmp_path / "run", resume=True, quiet=True)
    noted = [
        (row["env_steps"], row["settings"]) for row in Journal.of(tmp_path / "run", tables="regions").provenance.read()
    ]
    other = {"tutor.reward_scale": 3.0, "trainer.sinks": []}
    assert noted == [(0, {}), (4 * EPOCH, {}), (4 * EPOCH, other)]
    assert (tmp_path / "run" / "config.yaml").read_bytes() == (run_dir / "config.yaml").read_bytes()


def test_seeds_differ(finished):
    run_dir, _ = finished
    first, second = rows(run_dir)[-2:]
    assert first["train/return"] != second["train/return"]


def test_two_runs_of_one_config_and_seed_write_the_same_metrics(finished, tmp_path):
    run_dir, _ = finished
    trainer.train(tiny(), tmp_path / "again", quiet=True, profile=1)
    assert rows(tmp_path / "again") == rows(run_dir)
    (trace,) = tmp_path.glob("again/profile/**/*.trace.json.gz")
    assert b"thunk" in gzip.decompress(trace.read_bytes()).lower()


def test_a_trace_longer_than_the_run_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(UserError, match="^--profile: 4 epochs cannot be traced .*: 4 are left"):
        trainer.train(tiny(), tmp_path / "run", quiet=True, profile=4)
    assert not (tmp_path / "run").exists()


def test_an_interrupted_run_resumes_to_the_same_final_state_bit_for_bit(finished, tmp_path, monkeypatch):
    run_dir, _ = finished
    part = tmp_path / "part"
    interrupt_after(monkeypatch, epochs=3)
    stopped = trainer.train(tiny(), part, quiet=True)
    assert stopped.interrupted and stopped.env_steps == 3 * EPOCH
    monkeypatch.undo()
    result = trainer.train(load(part / "config.yaml"), part, resume=True, quiet=True)
    assert not result.interrupted
    assert rows(part) == rows(run_dir)
    assert Journal.of(part, tables="regions").tables.read() == Journal.of(run_dir, tables="regions").tables.read()
    assert_equal(saved_state(tiny(), part), saved_state(tiny(), run_dir))


@pytest.mark.usefixtures("finished")  # whose program is compiled: an epoch then ends before it is given up
def test_sigterm_ends_a_run_like_ctrl_c_but_for_the_exit_code(tmp_path, monkeypatch):
    interrupt_after(monkeypatch, epochs=1, number=signal.SIGTERM)
    result = trainer.train(tiny(), tmp_path / "run", quiet=True)
    assert result.interrupted and result.terminated and result.env_steps == EPOCH
    assert Checkpoints(tmp_path / "run").steps() == [EPOCH]


def test_an_epoch_too_long_for_sigterm_is_given_up_and_the_one_before_it_saved(finished, tmp_path, monkeypatch):
    run_dir, _ = finished
    part, over = tmp_path / "part", threading.Event()
    with monkeypatch.context() as patch:
        patch.setattr(signals, "GRACE_S", 0.0)
        patch.setattr(loop, "_LONG_S", 0.0)
        interrupt_after(patch, epochs=4, number=signal.SIGTERM, then=over.wait)
        result = trainer.train(tiny(), part, quiet=True)
        over.set()
        for thread in signals.computing():
            thread.join()
    assert result.terminated and result.env_steps == 3 * EPOCH
    assert Checkpoints(part).steps() == [2 * EPOCH, 3 * EPOCH]
    trainer.train(load(part / "config.yaml"), part, resume=True, quiet=True)
    assert_same_end(part, run_dir)


def test_a_damaged_newest_checkpoint_is_set_aside_and_the_run_goes_on_from_the_one_before(finished, tmp_path, capsys):
    run_dir, _ = finished
    part = tmp_path / "part"
    shutil.copytree(run_dir, part)
    (part / "checkpoints" / str(4 * EPOCH) / "state" / "_METADATA").write_text("")
    assert cli.main(["evaluate", str(part), "--episodes", "5", "--json", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["env_steps"] == 2 * EPOCH
    assert f"{4 * EPOCH}: is damaged: state/_METADATA differs" in err and err.count("\n") == 1
    trainer.train(tiny(), part, resume=True, quiet=True)
    err = capsys.readouterr().err
    assert f"it is now {4 * EPOCH}.damaged, and the run goes on from {2 * EPOCH} env steps" in err
    assert err.count("\n") == 1
    assert Journal.of(part, tables="regions").provenance.read()[-1]["env_steps"] == 2 * EPOCH
    assert {entry.name for entry in (part / "checkpoints").iterdir()} == {str(2 * EPOCH), str(4 * EPOCH)}
    assert_same_end(part, run_dir)


def test_a_run_killed_before_its_first_checkpoint_begins_anew(finished, tmp_path, capsys):
    run_dir, _ = finished
    part = tmp_path / "part"
    shutil.copytree(run_dir, part)
    shutil.rmtree(part / "checkpoints")
    os.truncate(part / "metrics.jsonl", (part / "metrics.jsonl").stat().st_size // 2)
    with (part / "provenance.jsonl").open("a") as file:
        file.write('{"env_steps": 0, "half a li')
    with pytest.raises(UserError, match="part: was begun with trainer.num_envs 4, not 8"):
        trainer.train(tiny(trainer__num_envs=8), part, resume=True, quiet=True)
    trainer.train(load(part / "config.yaml"), part, resume=True, quiet=True)
    assert capsys.readouterr().err == f"warning: {part}: holds no checkpoint, so it begins anew\n"
    assert rows(part) == rows(run_dir)
    assert Journal.of(part, tables="regions").tables.read() == Journal.of(run_dir, tables="regions").tables.read()
    assert len(Journal.of(part, tables="regions").provenance.read()) == 2
    assert_equal(saved_state(tiny(), part), saved_state(tiny(), run_dir))


def test_what_a_run_killed_at_once_left_does_not_keep_another_from_beginning(tmp_path):
    for name in (".lock", ".config-abc/config.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    run_folder.make(tmp_path)
    (tmp_path / "config.yaml").touch()
    with pytest.raises(UserError, match="is not empty"):
        run_folder.make(tmp_path)


def test_a_second_process_is_refused_and_changes_nothing(finished):
    run_dir, _ = finished
    before = {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}
    with locked(run_dir, warn=print):
        held = (run_dir / ".lock").read_bytes()
        with pytest.raises(UserError, match="is in use by process"):
            trainer.train(tiny(), run_dir, resume=True, quiet=True)
    assert {path: path.read_bytes() for path in run_dir.rglob("*") if path.is_file()} == before | {
        run_dir / ".lock": held
    }


def test_a_disk_that_fills_up_ends_the_run_in_one_line_and_it_resumes(finished, tmp_path, monkeypatch, capsys):
    run_dir, _ = finished
    part = tmp_path / "part"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_sums", fail_after(checkpoint._sums, 1, OSError(28, "No space left on device")))
        with pytest.raises(UserError, match=f"{4 * EPOCH}: cannot be written: No space left on device; earlier"):
            trainer.train(tiny(), part, quiet=True)
    assert Checkpoints(part).steps() == [2 * EPOCH] and rows(part) == rows(run_dir)
    trainer.train(tiny(), part, resume=True, quiet=True)
    assert_same_end(part, run_dir)


def test_a_run_of_an_older_format_goes_on_from_its_checkpoint(tmp_path, capsys):
    run_dir = unpacked("format_2", tmp_path)  # and by way of all later ones
    before = rows(run_dir)
    with pytest.raises(UserError, match="made with tutor.straight False, not True"):
        trainer.train(tiny(tutor__straight=True), run_dir, resume=True, quiet=True)
    config = load_run(run_dir, {"trainer.total_env_steps": 4 * EPOCH})
    result = trainer.train(config, run_dir, resume=True, quiet=True)
    assert result.env_steps == 4 * EPOCH and capsys.readouterr().err == ""
    assert rows(run_dir)[: len(before)] == before and len(rows(run_dir)) == 2 * len(before) == 8
    assert np.isfinite([row["controller/critic_loss"] for row in rows(run_dir)]).all()
    about = json.loads((run_dir / "checkpoints" / str(4 * EPOCH) / "about.json").read_text())
    assert about["format"] == FORMAT
    saved_state(config, run_dir)


def test_what_sgim_has_chosen_is_written_down(finished):
    run_dir, _ = finished
    for row in rows(run_dir):
        assert sum(row[f"sgim/share_{name}"] for name in ("autonomous", "babbling", "guide")) == pytest.approx(1)
        assert row["sgim/queries_guide"] <= 3
    for row in Journal.of(run_dir, tables="regions").tables.read():
        assert len(row["competence"]) == len(row["drawn"]) == len(row["chosen"])
        assert sum(row["drawn"]) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("teacher", "told"),
    [
        ({"kind": "outcome", "source": "route.npz"}, "route.npz: no such file (did you mean routes.npz?)"),
        ({"kind": "action", "source": "routes.npz"}, "sgim.teachers: routes.npz shows no actions; helper cannot be of"),
    ],
)
def test_a_teacher_who_cannot_teach_is_refused_before_anything_is_written(tmp_path, monkeypatch, teacher, told):
    monkeypatch.chdir(tmp_path)
    teachers.save(Path("routes.npz"), teachers.shortest_paths(envs.make("point_maze")), env="point_maze")
    with pytest.raises(UserError) as error:
        trainer.train(tiny(sgim__teachers=[{"name": "helper", **teacher}]), tmp_path / "run", quiet=True)
    assert str(error.value).startswith(told) and "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_metrics_written_after_the_checkpoint_are_dropped_on_resume(finished, tmp_path):
    run_dir, _ = finished
    sink = JsonLines(tmp_path / "metrics.jsonl")
    for row in rows(run_dir):
        sink.write(row)
    with sink.path.open("a") as file:
        file.write('{"env_steps": 1, "half a li')
    sink.keep_until(2 * EPOCH)
    assert [row["env_steps"] for row in sink.read()] == [EPOCH, EPOCH, 2 * EPOCH, 2 * EPOCH]
    assert len(sink.path.read_text().splitlines()) == 4


def test_auto_engine_and_the_cuts_of_the_task_are_resolved():
    config = programs.build(tiny(env__engine="auto", abstraction__cuts=None)).config
    assert config.env.engine == "jax"
    assert config.abstraction.cuts == ((8.0,), (8.0,))


@pytest.mark.parametrize("section", ["options", "training"])
def test_a_map_is_kept_whatever_becomes_of_its_file(section, tmp_path):
    path, rows = tmp_path / "map.txt", "11111\n1r001\n11111\n"
    path.write_text(rows)
    settings = {f"env.{section}.map": str(path), "abstraction.cuts": None, "abstraction.grid": [2]}
    assert getattr(programs.build(parse(RUN, settings)).config.env, section)["map"] == rows


def test_neither_the_length_of_training_episodes_nor_what_was_planned_before_changes_evaluation():
    shorter = {"env.training.episode_length": 30}
    one, other = (programs.build(parse(STEADY, more)) for more in ({}, shorter))
    assert (one.experiment.spec.episode_length, other.experiment.spec.episode_length) == (60, 30)
    fresh, shorter_fresh = (program.init(program.seed_keys()) for program in (one, other))
    planned = jax.random.uniform(jax.random.key(0), fresh.commander.q.shape)
    before = fresh.replace(commander=fresh.commander.replace(q=planned))
    found = one.evaluate(fresh, one.evaluation_keys(0))
    for program, state in ((other, shorter_fresh), (one, before)):
        jax.tree.map(np.testing.assert_array_equal, found, program.evaluate(state, one.evaluation_keys(0)))
    with pytest.raises(UserError, match="tutor.period: 10 does not divide the test episode of 55"):
        programs.build(parse(STEADY, shorter | {"env.options.episode_length": 55}))


def test_nothing_is_compiled_after_the_first_epoch(caplog):
    program = programs.build(tiny())
    start = jax.device_put(program.init(program.seed_keys()), jax.devices()[0])  # as `train` does
    state, _ = program.epoch(start)
    with jax.log_compiles(True), caplog.at_level("WARNING"):
        state, _ = program.epoch(state)
        program.epoch(state)
    assert not [record.getMessage() for record in caplog.records if "ompil" in record.getMessage()]


def test_evaluation_reports_intervals_for_every_seed(finished, capsys):
    run_dir, _ = finished
    assert cli.main(["evaluate", str(run_dir), "--episodes", "5", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert [row["seed"] for row in figures["seeds"]] == [0, 1]
    assert figures["episodes"] == 10 and figures["env_steps"] == 4 * EPOCH
    for name in ("success_any", "success_final", "distance", "return"):
        low, high = figures[f"{name}_interval"]
        assert low <= figures[name] <= high
    assert figures["success_final"] <= figures["success_any"]


def test_evaluation_of_a_checkpoint_that_is_not_there_names_those_that_are(finished, capsys):
    run_dir, _ = finished
    assert cli.main(["evaluate", str(run_dir), "--checkpoint", "7"]) == 2
    assert capsys.readouterr().err == f"error: --checkpoint: '7' is not among last, best, {2 * EPOCH}, {4 * EPOCH}\n"


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ({"controller__ppo__hidden": [16]}, "controller.ppo.hidden [8], not [16]"),
        ({"env__options": {"episode_length": 120}}, "env.options"),
        ({"trainer__num_envs": 8}, "trainer.num_envs 4, not 8"),
        ({"trainer__seed": 3}, "trainer.seed 0, not 3"),
    ],
)
def test_a_checkpoint_of_another_shape_or_environment_is_refused(finished, override, named):
    run_dir, _ = finished
    before = (run_dir / "metrics.jsonl").read_bytes()
    with pytest.raises(UserError, match="its checkpoint was made with") as error:
        trainer.train(tiny(**override), run_dir, resume=True, quiet=True)
    assert named in str(error.value) and "\n" not in str(error.value)
    assert (run_dir / "metrics.jsonl").read_bytes() == before


def test_four_devices_train_as_one_does_and_any_number_goes_on(steady, tmp_path):
    """Two epochs on four devices, the other two on one; its checkpoint goes to two as well."""
    training = """
import json, sys
from pathlib import Path
import jax
from star.config.loading import parse
from star.training import checkpoint, loop, trainer
from star.training import program as programs

loop.save = lambda figure, path: None
config, run_dir = json.loads(sys.argv[1]), Path(sys.argv[2])
trainer.train(parse(config, {"trainer.devices": 4}), run_dir, quiet=True)
program = programs.build(parse(config, {"trainer.devices": 2}))
_, state = checkpoint.load_state(program, run_dir, "last")
assert all(leaf.sharding.device_set == set(jax.devices()[:2]) for leaf in jax.tree.leaves(state))
assert jax.device_get(state.epoch).tolist() == [2]
"""
    run_dir, half = tmp_path / "run", STEADY | {"trainer": RUN["trainer"] | {"total_env_steps": 2 * EPOCH}}
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags}
    subprocess.run([sys.executable, "-c", training, json.dumps(half), str(run_dir)], env=environment, check=True)
    trainer.train(small(), run_dir, resume=True, quiet=True)
    for ours, theirs in zip(rows(run_dir), rows(steady), strict=True):
        assert ours.keys() == theirs.keys()
        for key, value in theirs.items():
            assert ours[key] == pytest.approx(value, rel=1e-3, abs=1e-4), key
    started = Journal.of(run_dir, tables="regions").provenance.read()
    assert started[0]["device"] == f"4 x {started[1]['device']}"


def test_a_numeric_hyperparameter_and_the_sinks_may_change_on_resume(finished, tmp_path):
    run_dir, _ = finished
    checkpoints = Checkpoints(run_dir)
    check_compatible(checkpoints.config(2 * EPOCH), tiny(tutor__reward_scale=3.0, trainer__sinks=[]), source=run_dir)
    checkpoints.close()


def test_ctrl_c_writes_a_checkpoint_and_says_how_to_resume(tmp_path):
    """Of the experiment of `docs/experiments.md`, which compiles in a moment."""
    (bandit,) = re.findall(
        r'```python title="bandit.py"\n(.*?)```', (ROOT / "docs/experiments.md").read_text(), re.DOTALL
    )
    (tmp_path / "bandit.py").write_text(bandit)
    endless = {"total_env_steps": 10**9, "eval_every": 10**6, "num_seeds": 2}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump({"experiment": "bandit:KIND", "trainer": endless}))
    command = [sys.executable, "-m", "star", "train", "config.yaml", "--run-dir", "run", "--import", "bandit"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    metrics = tmp_path / "run" / "metrics.jsonl"
    try:
        while process.poll() is None and not (metrics.exists() and metrics.read_text().count("\n") > 4):
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "star train --resume run" in out
    assert len(Checkpoints(tmp_path / "run").steps()) >= 1


def test_only_the_latest_checkpoints_and_the_best_are_kept(tmp_path):
    program = programs.build(tiny())
    state = program.init(program.seed_keys())
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step, success in ((1, 0.1), (2, 0.9), (3, 0.2), (4, 0.3), (5, 0.4)):
        checkpoints.save(step, state, program.config, score=success)
    assert checkpoints.steps() == [2, 4, 5]
    assert checkpoints.best() == 2
    checkpoints.close()


def test_the_published_setting_trains_with_subgoals_that_set_a_heading_too(tmp_path):
    small = {
        "env.options": {"preset": "published", "episode_length": 20, "frames": 1},
        "env.engine": "native",
        "commander.period": 10,
        "tutor.heading": 2.0,
        "trainer.total_env_steps": 40,
        "trainer.eval_every": 1,
        "trainer.eval_episodes": 1,
        "tutor.td3.hidden": [8],
        "controller.td3.hidden": [8],
        "tutor.td3.min_transitions": 1,
        "controller.td3.min_transitions": 1,
        "tutor.td3.batch_size": 8,
        "controller.td3.batch_size": 8,
        "forward_model.batch_size": 8,
        "tutor.td3.buffer_size": 100,
        "controller.td3.buffer_size": 100,
        "forward_model.buffer_size": 100,
        "forward_model.updates_per_epoch": 2,
        "abstraction.max_regions": 6,
        "refinement.enabled": False,  # nothing is due in one epoch
    }
    result = trainer.train(load(ROOT / "configs" / "paper" / "ant_maze.yaml", small), tmp_path / "run", quiet=True)
    assert result.env_steps == 40
    last = rows(tmp_path / "run")[-1]
    assert np.isfinite([last["controller/critic_loss"], last["tutor/critic_loss"], last["train/return"]]).all()


def test_runs_that_differ_in_numbers_of_any_level_and_in_the_seed_may_be_trained_side_by_side():
    numbers = {
        "controller__ppo__learning_rate": 2e-3,
        "tutor__ppo__discount": 0.5,
        "commander__epsilon_start": 0.1,
        "forward_model__learning_rate": 1e-2,
        "trainer__seed": 3,
    }
    usual, other, larger = (small(**values) for values in ({}, numbers, {"trainer__num_envs": 8}))
    assert programs.structure(usual) == programs.structure(other) != programs.structure(larger)


def test_runs_side_by_side_are_each_what_train_makes_of_them(tmp_path):
    """They differ in numbers and in the seed; one is given up half-way for another."""
    numbers = {"controller__ppo__learning_rate": 2e-3, "controller__reward_scale": 3.0, "trainer__seed": 3}
    usual, other, given_up = (small(ALONE, **values) for values in ({}, numbers, {"controller__ppo__discount": 0.1}))
    bench = SideBySide(usual, 2)
    bench.put({0: given_up, 1: other})
    rows_of = [[], []]
    for epoch in range(6):
        if epoch == 2:
            bench.put({0: usual})
        for slot, table in enumerate(bench.advance()):
            rows_of[slot].extend(table)
    for found, config, name in ((rows_of[0][2:], usual, "usual"), (rows_of[1][:4], other, "other")):
        trainer.train(config, tmp_path / name, quiet=True)
        for row, expected in zip(found, rows(tmp_path / name), strict=True):
            assert row.keys() == expected.keys()
            for key, value in row.items():
                assert value == pytest.approx(expected[key], rel=2e-3, abs=1e-4), (key, row["env_steps"])


def fail_after(function, times, error):
    """`function`, which raises `error` after so many calls."""
    calls = []

    def failing(*arguments):
        calls.append(None)
        if len(calls) > times:
            raise error
        return function(*arguments)

    return failing


def interrupt_after(monkeypatch, *, epochs, number=signal.SIGINT, then=lambda: None):
    """Press Ctrl-C, or send another signal, during epoch number `epochs`, and do `then` before the epoch itself."""
    build = programs.build

    def pressing(config):
        program = build(config)
        calls = []

        def epoch(*arguments):
            calls.append(None)
            if len(calls) == epochs:
                signal.raise_signal(number)
                then()
            return program.functions.epoch(*arguments)

        return dataclasses.replace(program, functions=dataclasses.replace(program.functions, epoch=epoch))

    monkeypatch.setattr(programs, "build", pressing)


def assert_equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def assert_same_end(part, run_dir):
    """Two runs of `tiny()` have measured the same and saved the same state."""
    assert rows(part) == rows(run_dir)
    assert_equal(saved_state(tiny(), part), saved_state(tiny(), run_dir))


def test_a_checkout_that_is_not_installed_says_where_it_runs_all_the_same(monkeypatch):
    monkeypatch.setattr(provenance, "_PACKAGES", ("jax", "no-such-package"))
    monkeypatch.setattr(provenance, "_process", provenance._process.__wrapped__)
    assert provenance.here()["versions"] == {"jax": jax.__version__, "no-such-package": None}


def test_another_config_than_that_of_the_folder_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "config.yaml").write_text(tiny().to_yaml(), encoding="utf-8")
    with pytest.raises(UserError, match="was begun with trainer.num_envs"):
        trainer.train(tiny(trainer__num_envs=6), tmp_path, resume=True, quiet=True)
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
