"""Checkpoints on disk: whole, checked, kept, and those of older versions."""

import dataclasses
import errno
import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.common.errors import UserError
from star.agent.kind import STAR
from star.agent.migrations import FORMAT
from star.agent.sections import Config
from star.config import kinds
from star.config.kinds import Migration
from star.learners import td3
from star.training import checkpoint
from star.training import program as programs
from star.training.checkpoint import Checkpoints, Damaged, best, choose, kept, newest
from tests.small import unpacked

ROOT = Path(__file__).parents[2]


def state(number):
    return {"x": jnp.full(300, float(number)), "pair": (jnp.arange(3), None)}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A run with the checkpoints 10, 20 and 30, of which 10 is the best."""
    run_dir = tmp_path_factory.mktemp("written")
    checkpoints = Checkpoints(run_dir)
    for step, success in ((10, 0.9), (20, 0.1), (30, 0.2)):
        checkpoints.save(step, state(step), Config(), score=success)
    checkpoints.close()
    return run_dir


@pytest.fixture
def checkpoints(written, tmp_path):
    """Those of a copy of it."""
    shutil.copytree(written, tmp_path / "run")
    found = Checkpoints(tmp_path / "run")
    yield found
    found.close()


def folder(checkpoints, step):
    return checkpoints._path / str(step)


def files(path):
    return sorted(entry for entry in path.rglob("*") if entry.is_file())


def test_a_checkpoint_says_what_it_is_and_what_wrote_it(checkpoints):
    about = json.loads((folder(checkpoints, 20) / "about.json").read_text())
    assert about["format"] == FORMAT and about["env_steps"] == 20 and about["success_final"] == 0.1
    assert about["config"] == Config().model_dump(mode="json")
    assert {"commit", "device", "python", "versions", "time"} <= about.keys()


def test_sha256sum_finds_every_file_of_a_checkpoint_as_it_was_written(checkpoints):
    path = folder(checkpoints, 20)
    told = subprocess.run(["sha256sum", "--check", "SHA256SUMS"], cwd=path, capture_output=True, text=True)
    assert told.returncode == 0 and told.stdout.count(": OK\n") == len(files(path)) - 1


def test_any_bit_that_flips_and_any_file_that_is_cut_or_gone_is_noticed_and_named(checkpoints):
    path, chance = folder(checkpoints, 30), random.Random(0)
    for file in files(path):
        data = file.read_bytes()
        flipped = bytearray(data)
        flipped[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        for damaged in (bytes(flipped), data[: chance.randrange(len(data))], None):
            file.unlink() if damaged is None else file.write_bytes(damaged)
            with pytest.raises(Damaged) as error:
                checkpoints.check(30)
            assert str(error.value).startswith(f"{path}: is damaged: ") and "\n" not in str(error.value)
            if damaged is None:
                assert str(error.value).endswith(f"{file.relative_to(path)} is missing")
            else:
                assert "SHA256SUMS" in str(error.value)
            file.write_bytes(data)
    checkpoints.check(30)


def test_of_several_damaged_checkpoints_the_newest_whole_one_is_found(checkpoints):
    assert newest(checkpoints) == (30, {})
    for step in (30, 20):
        os.truncate(files(folder(checkpoints, step) / "state")[0], 0)
    step, wrong = newest(checkpoints)
    assert step == 10 and list(wrong) == [30, 20]
    shutil.rmtree(folder(checkpoints, 10) / "state")
    with pytest.raises(Damaged, match="/30: is damaged: .*, and there is no other that is not"):
        newest(checkpoints)


def test_the_last_checkpoint_falls_back_in_one_line_and_any_other_is_refused(checkpoints, tmp_path, capsys):
    (folder(checkpoints, 30) / "SHA256SUMS").unlink()
    assert choose(checkpoints, tmp_path, "last") == 20
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "/30: is damaged: SHA256SUMS is missing" in told and "of 20 env steps" in told
    assert choose(checkpoints, tmp_path, "best") == 10
    with pytest.raises(Damaged):
        choose(checkpoints, tmp_path, "30")


def test_which_checkpoint_is_best_is_not_guessed_and_saving_goes_on_all_the_same(checkpoints, tmp_path):
    (folder(checkpoints, 10) / "about.json").write_text("{")
    with pytest.raises(Damaged, match="/10: is damaged, its success_final cannot be read"):
        choose(checkpoints, tmp_path, "best")
    checkpoints.save(40, state(40), Config(), score=0.0)
    assert checkpoints.steps() == [20, 30, 40]


def test_a_damaged_checkpoint_set_aside_stays_until_its_step_is_saved_again(checkpoints):
    aside = checkpoints.set_aside(30)
    assert checkpoints.steps() == [10, 20] and aside.name == "30.damaged" and files(aside)
    checkpoints.save(25, state(25), Config(), score=0.0)
    assert aside.exists()
    checkpoints.save(30, state(31), Config(), score=0.0)
    assert not aside.exists()
    np.testing.assert_array_equal(checkpoints.restore(30, state(0))["x"], np.full(300, 31.0))


def test_a_checkpoint_saved_again_replaces_the_old_one(checkpoints):
    checkpoints.save(30, state(99), Config(), score=0.0)
    checkpoints.check(30)
    np.testing.assert_array_equal(checkpoints.restore(30, state(0))["x"], np.full(300, 99.0))


def test_what_a_killed_process_had_not_finished_is_no_checkpoint_and_goes_with_the_next(checkpoints):
    for name in (".40.partial", ".20.removed"):
        shutil.copytree(folder(checkpoints, 20), checkpoints._path / name)
    assert checkpoints.steps() == [10, 20, 30]
    checkpoints.save(40, state(40), Config(), score=0.0)
    assert {entry.name for entry in checkpoints._path.iterdir()} == {"10", "20", "30", "40"}


def test_the_name_of_a_checkpoint_appears_after_its_files_are_on_the_disk(checkpoints, monkeypatch):
    done = []
    sync, rename = checkpoint.files.sync, os.rename

    def noting_rename(old, new):
        done.append(("rename", Path(new).name))
        rename(old, new)

    monkeypatch.setattr(checkpoint.files, "sync", lambda path: (done.append(("sync", path.name)), sync(path)))
    monkeypatch.setattr(checkpoint.os, "rename", noting_rename)
    checkpoints.save(40, state(40), Config(), score=0.0)
    appears = done.index(("rename", "40"))
    synced = [name for kind, name in done[:appears] if kind == "sync"]
    everything = [entry.name for entry in folder(checkpoints, 40).rglob("*")]
    assert sorted(synced) == sorted([*everything, ".40.partial"])
    assert ("sync", "checkpoints") in done[appears:]


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "No space left on device"),
        (ValueError("RESOURCE_EXHAUSTED: Failed to write: No space left on device [OS error 28]"), "No space left"),
    ],
)
def test_a_checkpoint_that_cannot_be_written_is_told_in_one_line_and_leaves_no_trace(
    checkpoints, monkeypatch, failure, told
):
    def fail(path):
        raise failure

    monkeypatch.setattr(checkpoint, "_sums", fail)
    with pytest.raises(UserError) as error:
        checkpoints.save(40, state(40), Config(), score=0.0)
    assert f"/40: cannot be written: {told}" in str(error.value) and "\n" not in str(error.value)
    monkeypatch.undo()
    assert {entry.name for entry in checkpoints._path.iterdir()} == {"10", "20", "30"}
    checkpoints.check(30)


def test_a_full_disk_and_one_that_is_read_only_leave_older_checkpoints_and_whole_lines(tmp_path):
    """On a real one of 2 MB, where this user may mount such a thing."""
    script = """
import sys, subprocess, numpy as np
from pathlib import Path
from star.training.checkpoint import Checkpoints
from star.agent.sections import Config
from star.config import kinds
from star.config.kinds import Migration
from star.learners import td3
from envs.common.errors import UserError
from star.training.lock import locked
from star.training.journal import JsonLines
run = Path("disk/run")
run.mkdir()
checkpoints, lines = Checkpoints(run), JsonLines(run / "metrics.jsonl")
def fails(action):
    try:
        action()
    except UserError as error:
        print(error)
    checkpoints.check(10)
    assert checkpoints.steps() == [10] and all(row == {"env_steps": 1} for row in lines.read())
random = np.random.default_rng(0).random
checkpoints.save(10, {"x": random(10_000)}, Config(), score=0.0)
lines.write({"env_steps": 1})
fails(lambda: checkpoints.save(20, {"x": random(400_000)}, Config(), score=0.0))
def fill():
    while True:
        lines.write({"env_steps": 1})
Path("disk/other").write_bytes(bytes(1_500_000))
fails(fill)
assert lines.path.read_bytes().endswith(b"}\\n")
subprocess.run(["mount", "-o", "remount,ro", "disk"], check=True)
fails(lambda: checkpoints.save(30, {"x": random(10)}, Config(), score=0.0))
fails(lambda: lines.write({"env_steps": 1}))
fails(lambda: locked(run, warn=print).__enter__())
"""
    (tmp_path / "disk").mkdir()
    alone = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    mount = "mount -t tmpfs -o size=2m none disk"
    if shutil.which("unshare") is None or subprocess.run([*alone, mount], cwd=tmp_path, capture_output=True).returncode:
        pytest.skip("cannot mount a file system")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [*alone, f'{mount} && exec "$0" -c "$1"', sys.executable, script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    full, no_line, *read_only = done.stdout.splitlines()
    assert full.endswith("20: cannot be written: No space left on device; earlier ones are intact")
    assert no_line == "disk/run/metrics.jsonl: cannot be written: No space left on device"
    assert len(read_only) == 3 and all("cannot be written: Read-only file system" in line for line in read_only)


def test_the_latest_and_the_best_are_kept_the_later_of_equals():
    successes = {1: 0.5, 2: 0.9, 3: 0.9, 4: 0.1, 5: -1.0}
    assert best(successes) == 3
    assert kept(successes, latest=1) == {3, 5} and kept(successes, latest=3) == {3, 4, 5}


def test_a_checkpoint_of_another_version_says_which_can_be_read(checkpoints):
    for number, told in (
        (FORMAT + 1, f"{FORMAT + 1} is newer than {FORMAT}"),
        (1, "1 is none that"),
        ("x", "x is none"),
    ):
        path = folder(checkpoints, 20) / "about.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {"format": number}))
        with pytest.raises(UserError, match=f"/20: checkpoint format {told}"):
            checkpoints.config(20)


def test_an_older_format_is_brought_up_step_by_step(checkpoints, monkeypatch):
    """Two more formats: in the first a setting and an array get other names, in the second an array is doubled."""

    def rename(about):
        config = about["config"]
        return about | {"config": config | {"env": {"name": config["env"]["name"]}}}

    rows = {
        FORMAT: Migration(rename, lambda arrays: {("y" if name == "x" else name): x for name, x in arrays.items()}),
        FORMAT + 1: Migration(arrays=lambda arrays: arrays | {"y": 2 * arrays["y"]}),
    }
    later = STAR._replace(format=FORMAT + 2, migrations=rows)
    monkeypatch.setattr(kinds, "find", lambda name: later)
    assert checkpoints.config(20).env.name == Config().env.name
    wanted = {"y": jnp.zeros(300), "pair": (jnp.zeros(3, jnp.int32), None)}
    found = checkpoints.restore(20, wanted)
    np.testing.assert_array_equal(found["y"], np.full(300, 40.0))
    np.testing.assert_array_equal(found["pair"][0], [0, 1, 2])
    for other, told in (
        ({"z": jnp.zeros(3)}, "z is missing"),
        ({"y": jnp.zeros(4)}, "y is float32[300], not float32[4]"),
    ):
        with pytest.raises(Damaged) as error:
            checkpoints.restore(20, other)
        assert told in str(error.value)


@pytest.mark.parametrize("name", ["format_2", "format_3"])
def test_what_is_read_of_an_older_format_is_what_was_written(name, tmp_path):
    run_dir = unpacked(name, tmp_path)
    checkpoints = Checkpoints(run_dir)
    assert checkpoints.steps() == [480] and checkpoints.best() == 480
    config = checkpoints.config(480)
    assert config.trainer.num_seeds == 2
    assert config.tutor.straight is False  # what there was when it was written, whatever a new run does
    arrays = checkpoints.arrays(480)
    assert arrays["epoch"].tolist() == [2, 2] and arrays["tutor/params/actor/params/Dense_0/kernel"].shape == (2, 8, 8)
    before, after = (x["commander/model/led"] for x in (arrays, STAR.migrated_arrays(arrays, int(name[-1]))))
    assert before.any() and (after == before[:, None]).all()  # of seeds, then of aims, which were counted together
    assert after.shape == (2, 2, *before.shape[1:])
    checkpoints.close()


def test_the_critics_of_format_4_speak_of_returns_as_they_are(tmp_path):
    checkpoints = Checkpoints(unpacked("format_4", tmp_path))
    before = checkpoints.arrays(480)
    after = STAR.migrated_arrays(before, 4)
    new = {
        f"{level}/returns/{name}": x for level in ("tutor", "controller") for name, x in (("mean", 0), ("variance", 1))
    }
    later = {name for name in after if name.startswith(("graph/tries/", "upcoming/"))}
    assert set(after) - set(before) - later == set(new) and set(before) - set(after) == {"commander/model/reach"}
    for name, x in new.items():
        np.testing.assert_array_equal(after[name], [x, x])
    checkpoints.close()


def test_td3_of_format_5_saw_observations_and_rewards_as_they_are(tmp_path):
    checkpoints = Checkpoints(unpacked("format_5", tmp_path))
    program = programs.build(checkpoints.config(480))
    state = checkpoints.restore(480, jax.eval_shape(program.init, program.seed_keys()))
    normalizer = state.tutor.normalizer
    assert normalizer.mean.shape[0] == 2 and not normalizer.mean.any() and (normalizer.variance == 1).all()
    np.testing.assert_array_equal(normalizer.count, [1e6, 1e6])
    learner = program.config.tutor.td3
    unit = jax.vmap(lambda rewards: td3.unit(learner, rewards))(state.tutor.rewards)
    np.testing.assert_allclose(unit, [1, 1], rtol=1e-5)
    checkpoints.close()


def test_a_commander_of_format_6_had_values_for_practice_which_are_left_out(tmp_path):
    run_dir = unpacked("format_6", tmp_path)
    assert "practice: 0.25" in (run_dir / "config.yaml").read_text()
    checkpoints = Checkpoints(run_dir)
    program = programs.build(checkpoints.config(480))
    state = checkpoints.restore(480, jax.eval_shape(program.init, program.seed_keys()))
    before = checkpoints.arrays(480)
    assert before["commander/model/reach"].any()
    np.testing.assert_array_equal(state.commander.q, before["commander/q"])
    checkpoints.close()


def test_in_format_7_nothing_was_known_of_tries_in_earlier_epochs(tmp_path):
    checkpoints = Checkpoints(unpacked("format_7", tmp_path))
    program = programs.build(checkpoints.config(480))
    state = checkpoints.restore(480, jax.eval_shape(program.init, program.seed_keys()))
    new = {"graph/tries/beyond", "graph/tries/passed", "graph/tries/beside", "graph/tries/met"}
    before = checkpoints.arrays(480)
    added = set(STAR.migrated_arrays(before, 7)) - set(before)
    assert {name for name in added if not name.startswith("upcoming/")} == new
    assert all(not x.any() for x in jax.tree.leaves(state.graph.tries))
    np.testing.assert_array_equal(state.graph.transitions, before["graph/transitions"])
    checkpoints.close()


def test_in_format_8_cuts_came_at_once_so_an_epoch_begins_with_what_is_there(tmp_path):
    checkpoints = Checkpoints(unpacked("format_8", tmp_path))
    program = programs.build(checkpoints.config(480))
    state = checkpoints.restore(480, jax.eval_shape(program.init, program.seed_keys()))
    parts = ("commander", "abstraction", "graph", "sgim")
    assert state.abstraction.count.max() > 2
    for name in parts:
        jax.tree.map(np.testing.assert_array_equal, getattr(state, name), getattr(state.upcoming, name))
    assert {field.name for field in dataclasses.fields(state.upcoming)} == set(parts)
    checkpoints.close()


def test_a_checkpoint_of_format_2_whose_config_is_damaged_is_refused(tmp_path):
    run_dir = unpacked("format_2", tmp_path)
    checkpoints = Checkpoints(run_dir)
    (run_dir / "checkpoints" / "480" / "config" / "metadata").write_text("{")
    with pytest.raises(Damaged, match="its config cannot be read"):
        checkpoints.config(480)
    checkpoints.close()
