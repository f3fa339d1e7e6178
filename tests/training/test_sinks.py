import json
import math
import struct
import threading
import time

import pytest
from PIL import Image
from tensorboardX.proto.event_pb2 import Event

from envs.common import files
from envs.common.errors import UserError
from star.config.loading import parse
from star.training import sinks
from star.training.sinks import Sinks, TensorBoard, WandB, Worker


def settings(*names, seeds=2):
    return parse({"trainer": {"num_seeds": seeds, "sinks": list(names)}})


def epoch(env_steps, *returns):
    row = {"env_steps": env_steps, "wall_s": env_steps / 10, "train/distance": None}
    return [row | {"seed": seed, "train/return": value} for seed, value in enumerate(returns)]


def events(folder):
    """All events of the one event file in `folder`: its records are a length, its checksum, the data and theirs."""
    (path,) = folder.glob("events.out.tfevents.*")
    data, at = path.read_bytes(), 0
    while at < len(data):
        (size,) = struct.unpack("<Q", data[at : at + 8])
        yield Event.FromString(data[at + 12 : at + 12 + size])
        at += size + 16


def scalars(folder, tag):
    return [(e.step, v.simple_value) for e in events(folder) for v in e.summary.value if v.tag == tag]


def logged(path):
    """The records of a W&B file: blocks of 32 KiB of pieces (checksum, length, kind) after a header of 7 bytes."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, whole = path.read_bytes(), 7, b""
    while at + 7 <= len(data):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
            continue
        size, kind = struct.unpack("<HB", data[at + 4 : at + 7])
        whole, at = whole + data[at + 7 : at + 7 + size], at + 7 + size
        if kind in (1, 4):  # whole, or the last piece
            yield Record.FromString(whole)
            whole = b""


def values(items):
    return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}


def test_numbers_are_means_over_seeds_without_those_that_are_not_finite():
    rows = [
        {"seed": 0, "env_steps": 9, "a": 1.0, "b": math.nan, "c": None},
        {"seed": 1, "env_steps": 9, "a": 2, "b": 1},
    ]
    assert sinks.numbers(rows) == {"a": 1.5}


def test_tensorboard_has_the_mean_in_the_run_directory_and_each_seed_in_its_own(tmp_path):
    board = TensorBoard(tmp_path, settings(), [])
    board.write(epoch(10, 1.0, 3.0))
    assert scalars(tmp_path, "train/return") == [(10, 2.0)]  # on disk at once
    board.write(epoch(20, 2.0, 4.0))
    board.close()
    assert scalars(tmp_path, "train/return") == [(10, 2.0), (20, 3.0)]
    assert scalars(tmp_path / "seed_1", "train/return") == [(10, 3.0), (20, 4.0)]
    assert scalars(tmp_path, "train/distance") == []


def test_one_seed_needs_no_folder_of_its_own(tmp_path):
    TensorBoard(tmp_path, settings(seeds=1), []).close()
    assert [path.is_file() for path in tmp_path.iterdir()] == [True]


def test_tensorboard_shows_every_epoch_of_a_resumed_run_once_and_none_that_was_lost(tmp_path):
    killed = TensorBoard(tmp_path, settings(), [])
    for n in (1, 2, 3):
        killed.write(epoch(10 * n, 5.0, 5.0))
    killed.close()
    resumed = TensorBoard(tmp_path, settings(), [*epoch(10, 1.0, 1.0), *epoch(20, 2.0, 2.0)])
    resumed.write(epoch(30, 3.0, 3.0))
    resumed.close()
    for folder in (tmp_path, tmp_path / "seed_0", tmp_path / "seed_1"):
        assert scalars(folder, "train/return") == [(10, 1.0), (20, 2.0), (30, 3.0)]
    times = [event.wall_time for event in events(tmp_path)][1:]
    assert times[1] - times[0] == pytest.approx(1.0) and times[2] - times[1] == pytest.approx(1.0)


def test_tensorboard_keeps_pictures(tmp_path):
    Image.new("RGB", (4, 3)).save(tmp_path / "summary.png")
    board = TensorBoard(tmp_path, settings(), epoch(10, 1.0, 1.0))
    board.figure(tmp_path / "summary.png")
    board.close()
    (shown,) = [(e.step, v) for e in events(tmp_path) for v in e.summary.value if v.HasField("image")]
    assert shown[0] == 10 and shown[1].tag == "figures/summary"
    assert (shown[1].image.width, shown[1].image.height) == (4, 3)
    assert shown[1].image.encoded_image_string == (tmp_path / "summary.png").read_bytes()


def whole(path, *, seconds=30):
    """All records of a run; W&B writes them in a process of its own, which may still be at it."""
    until = time.monotonic() + seconds
    while True:
        records = list(logged(path))
        if "exit" in {record.WhichOneof("record_type") for record in records} or time.monotonic() > until:
            return records
        time.sleep(0.1)


def test_an_offline_run_of_wandb_goes_on_as_the_same_run_and_tells_nothing_twice(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setattr(sinks, "_PATIENCE_S", 300)
    run_dir = tmp_path / "my_run"
    (run_dir / "figures").mkdir(parents=True)
    Image.new("RGB", (4, 3)).save(run_dir / "figures" / "summary.png")
    warned = []
    for numbers in ((1, 2), (2, 3)):  # the second epoch is trained again after an interrupt
        with Sinks(run_dir, settings("wandb"), [], warn=warned.append) as others:
            for n in numbers:
                others.write(epoch(10 * n, float(n), 3.0 * n))
            others.figures(run_dir / "figures")
    assert warned == []
    parts = sorted((run_dir / "wandb").glob("offline-run-*/*.wandb"), key=lambda path: path.stat().st_mtime)
    told = [whole(path) for path in parts]
    runs = [next(r.run for r in records if r.WhichOneof("record_type") == "run") for records in told]
    assert len(runs) == 2 and runs[0].run_id == runs[1].run_id
    assert {(run.project, run.display_name) for run in runs} == {("star", "my_run")}
    assert values(runs[0].config.update)["trainer"]["num_seeds"] == 2
    steps = [values(r.history.item) for records in told for r in records if r.WhichOneof("record_type") == "history"]
    returns = [(s["_step"], s["train/return"], s["seed_1/train/return"]) for s in steps if "train/return" in s]
    assert returns == [(10, 2.0, 3.0), (20, 4.0, 6.0), (30, 6.0, 9.0)]
    summary = {}
    for record in told[1]:
        summary |= values(record.summary.update)
    assert summary["train/return"] == 6.0 and summary["env_steps"] == 30
    assert len(list(run_dir.glob("wandb/offline-*/files/media/images/figures/summary*.png"))) == 2


def test_what_wandb_remembers_is_whole_after_a_full_disk(tmp_path, monkeypatch):
    sink = object.__new__(WandB)
    sink._memory, sink._id, sink._told = tmp_path / "star.json", "abc", 10
    sink._remember()
    sink._told = 20
    monkeypatch.setattr(files, "sync", failing)
    with pytest.raises(UserError, match="star.json: cannot be written"):
        sink._remember()
    assert json.loads(sink._memory.read_text()) == {"id": "abc", "env_steps": 10}


class Stuck:
    """A sink that never comes back."""

    def write(self, rows):
        threading.Event().wait()


def failing(*_, **__):
    raise OSError("no\nroom left")


def test_a_sink_that_fails_is_warned_of_once_in_one_line_and_the_others_go_on(tmp_path, monkeypatch):
    monkeypatch.setattr(WandB, "__init__", failing)
    warned = []
    with Sinks(tmp_path, settings("wandb", "tensorboard"), [], warn=warned.append) as others:
        for n in (1, 2, 3):
            others.write(epoch(10 * n, 1.0, 2.0))
    assert len(scalars(tmp_path, "train/return")) == 3
    assert warned == ["wandb: no room left; metrics go on without it, all of them are in metrics.jsonl"]


def test_a_sink_that_fails_in_the_middle_is_closed_and_left(tmp_path, monkeypatch):
    add = TensorBoard._add
    monkeypatch.setattr(
        TensorBoard, "_add", lambda self, rows: (failing if rows[0]["env_steps"] == 20 else add)(self, rows)
    )
    warned = []
    with Sinks(tmp_path, settings("tensorboard"), [], warn=warned.append) as others:
        for n in (1, 2, 3):
            others.write(epoch(10 * n, 1.0, 2.0))
    assert len(warned) == 1 and warned[0].startswith("tensorboard: no room left;")
    assert scalars(tmp_path, "train/return") == [(10, 1.5)]


def test_a_sink_that_hangs_holds_up_neither_the_training_nor_its_end(monkeypatch):
    monkeypatch.setattr(sinks, "_WAITING", 2)
    warned = []
    worker = Worker("slow", Stuck, warn=warned.append)
    began = time.monotonic()
    for n in range(9):
        worker.do(lambda sink, n=n: sink.write(epoch(n, 1.0)))
    worker.wait(0.05)
    assert time.monotonic() - began < 2
    assert [line.split(";")[0] for line in warned] == ["slow: it cannot keep up"]
    hanging = Worker("hanging", Stuck, warn=warned.append)
    hanging.do(lambda sink: sink.write(()))
    hanging.do(None)
    hanging.wait(0.05)
    assert [line.split(";")[0] for line in warned[1:]] == ["hanging: it does not finish"]


def test_a_package_that_is_not_installed_is_named_with_what_to_install(monkeypatch):
    monkeypatch.setattr(sinks.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"^trainer.sinks: wandb is not installed; install it with pip .*\[wandb\]'$"):
        sinks.check(settings("tensorboard", "wandb"))
    sinks.check(settings("tensorboard"))
