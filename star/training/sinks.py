"""Destinations of a run's metrics besides `metrics.jsonl`: TensorBoard and Weights & Biases.

A sink is told of every epoch and, at the end, of the figures. Each works in a thread of its own, and what goes wrong
there is said in one line and ends that sink, never the training.
"""

from __future__ import annotations

import importlib.util
import json
import math
import queue
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any, Protocol, Self

from envs.common import extras, files
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.training.journal import by_step, mean

Row = Mapping[str, Any]
Warn = Callable[[str], None]

_EXTRAS = ("wandb",)  # whose package, of the same name, is in an extra
_WAITING = 1000  # epochs and figures that a sink may be behind
_PATIENCE_S = 30.0  # how long the end of a run waits for a sink
_EVENTS = "events.out.tfevents.*"


class Sink(Protocol):
    """Something that keeps metrics. Any exception ends it."""

    def write(self, rows: Sequence[Row]) -> None:
        """Keep the rows of one epoch, one per seed, as in `metrics.jsonl`."""

    def figure(self, path: Path) -> None:
        """Keep a picture (.png) of the run as it is now, under the name of the file."""

    def close(self) -> None:
        """Finish what was begun."""


class TensorBoard:
    """Event files in the run directory: means over seeds there, each of several seeds in `seed_<n>/`.

    They are made anew from `history`, the rows so far, so that a resumed run shows each epoch once. Events are written
    at once and by the calling thread.
    """

    def __init__(self, run_dir: Path, config: RunConfig, history: Sequence[Row]) -> None:
        from tensorboardX.event_file_writer import EventsWriter

        first, count = config.trainer.seed, config.trainer.num_seeds
        folders = {"": run_dir}
        if count > 1:
            folders |= {f"seed_{seed}": run_dir / f"seed_{seed}" for seed in range(first, first + count)}
        for folder in folders.values():
            folder.mkdir(exist_ok=True)
            for old in folder.glob(_EVENTS):
                old.unlink()
        self._writers = {name: EventsWriter(str(folder / "events")) for name, folder in folders.items()}
        self._env_steps = 0
        # Time goes on where an interrupted run stopped, as `wall_s` does.
        self._began = time.time() - (history[-1]["wall_s"] if history else 0.0)
        for rows in by_step(history):
            self._add(rows)
        self._flush()

    def write(self, rows: Sequence[Row]) -> None:
        """Add a scalar for each metric."""
        self._add(rows)
        self._flush()

    def figure(self, path: Path) -> None:
        """Add an image of the file's bytes."""
        from PIL import Image
        from tensorboardX.proto.summary_pb2 import Summary

        with Image.open(path) as picture:
            width, height = picture.size
        image = Summary.Image(width=width, height=height, colorspace=3, encoded_image_string=path.read_bytes())
        self._event("", [Summary.Value(tag=f"figures/{path.stem}", image=image)], time.time())
        self._flush()

    def close(self) -> None:
        """Close the event files."""
        with ExitStack() as stack:
            for writer in self._writers.values():
                stack.callback(writer.close)

    def _add(self, rows: Sequence[Row]) -> None:
        from tensorboardX.proto.summary_pb2 import Summary

        self._env_steps = rows[0]["env_steps"]
        seeds = {f"seed_{row['seed']}": numbers([row]) for row in rows} if len(self._writers) > 1 else {}
        for name, values in ({"": numbers(rows)} | seeds).items():
            scalars = [Summary.Value(tag=key, simple_value=value) for key, value in values.items()]
            self._event(name, scalars, self._began + rows[0]["wall_s"])

    def _event(self, name: str, values: Sequence[Any], at: float) -> None:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        event = Event(wall_time=at, step=self._env_steps, summary=Summary(value=values))
        self._writers[name].write_event(event)

    def _flush(self) -> None:
        for writer in self._writers.values():
            writer.flush()


class WandB:
    """A run of Weights & Biases, with its files in `wandb/` below the run directory.

    Means over seeds have the keys of `metrics.jsonl`, several seeds besides `seed_<n>/<key>`; the step is that of
    `env_steps`. `wandb/star.json` remembers the id of the run and what it was last told, so that a resumed run goes on
    as the same one and tells nothing twice. Without an API key, and unless WANDB_MODE says otherwise, it works offline.
    """

    def __init__(self, run_dir: Path, config: RunConfig, *, warn: Warn) -> None:
        import wandb

        wandb.setup(settings=wandb.Settings(silent=True))
        settings = wandb.Settings(console="off", silent=True, finish_timeout=_PATIENCE_S - 5)
        offline = wandb.setup().settings.mode == "online" and not wandb.login(prompt=False, verify=False)
        if offline:
            warn(f"wandb: no API key, so it works offline; upload later: wandb sync {run_dir}/wandb/offline-run-*")
        self._memory = run_dir / "wandb" / "star.json"
        known = json.loads(self._memory.read_text()) if self._memory.exists() else {}
        self._id = known.get("id") or secrets.token_hex(4)
        self._told = known.get("env_steps", 0)
        self._memory.parent.mkdir(exist_ok=True)
        self._remember()
        self._run = wandb.init(
            project=wandb.setup().settings.project or "star",
            name=run_dir.resolve().name,
            id=self._id,
            resume="allow",
            dir=run_dir,
            mode="offline" if offline else None,
            config=config.model_dump(mode="json"),
            allow_val_change=True,
            settings=settings,
        )

    def write(self, rows: Sequence[Row]) -> None:
        """Log one step, unless an earlier part of the run did."""
        env_steps = rows[0]["env_steps"]
        if env_steps <= self._told:  # before the run was interrupted
            return
        values = numbers(rows)
        if len(rows) > 1:
            for row in rows:
                values |= {f"seed_{row['seed']}/{key}": value for key, value in numbers([row]).items()}
        self._run.log(values | {"env_steps": env_steps}, step=env_steps)
        self._told = env_steps
        self._remember()

    def figure(self, path: Path) -> None:
        """Log an image with the last step."""
        import wandb

        self._run.log({f"figures/{path.stem}": wandb.Image(str(path))}, step=self._told)

    def close(self) -> None:
        """Finish the run, which uploads the rest unless it is offline."""
        self._run.finish()

    def _remember(self) -> None:
        with files.whole(self._memory) as path:
            path.write_text(json.dumps({"id": self._id, "env_steps": self._told}), encoding="utf-8")


class Sinks:
    """All sinks of a run, as a context. Nothing raises, and nothing waits but its end, for half a minute at most.

    After an exception the end does not wait either.
    """

    def __init__(
        self, run_dir: Path, config: RunConfig, history: Sequence[Row], *, warn: Warn, muted: bool = False
    ) -> None:
        """`history` holds the rows of `metrics.jsonl`; `warn` takes one line and is called from other threads.

        With `muted` there is no sink: somebody else tells them.
        """
        makers: dict[str, Callable[[], Sink]] = {
            "tensorboard": partial(TensorBoard, run_dir, config, list(history)),
            "wandb": partial(WandB, run_dir, config, warn=warn),
        }
        self._workers = [Worker(name, makers[name], warn=warn) for name in config.trainer.sinks if not muted]

    def write(self, rows: Sequence[Row]) -> None:
        """Hand on the rows of one epoch, one per seed."""
        for worker in self._workers:
            worker.do(methodcaller("write", rows))

    def figures(self, folder: Path) -> None:
        """Hand on the pictures in `folder`."""
        for path in sorted(folder.glob("*.png")):
            for worker in self._workers:
                worker.do(methodcaller("figure", path))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        until = time.monotonic() + (_PATIENCE_S if kind is None else 0.0)
        for worker in self._workers:
            worker.do(None)
        for worker in self._workers:
            worker.wait(until - time.monotonic())


class Worker:
    """A sink in a thread of its own, which makes it, does in turn what it is told, and closes it."""

    def __init__(self, name: str, make: Callable[[], Sink], *, warn: Warn) -> None:
        self._name, self._make, self._warn = name, make, warn
        self._tasks: queue.Queue[Callable[[Sink], None] | None] = queue.Queue(_WAITING)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"sink {name}", daemon=True)
        self._thread.start()

    def do(self, task: Callable[[Sink], None] | None) -> None:
        """Have a task done after those before it; None ends the thread."""
        if self._ended.is_set():
            return
        try:
            self._tasks.put_nowait(task)
        except queue.Full:
            self._give_up("it cannot keep up")

    def wait(self, seconds: float) -> None:
        """Wait until all is done, but no longer than this."""
        self._thread.join(max(seconds, 0.0))
        if self._thread.is_alive():
            self._give_up("it does not finish")

    def _work(self) -> None:
        try:
            sink = self._make()
            try:
                while (task := self._tasks.get()) is not None and not self._ended.is_set():
                    task(sink)
            finally:
                sink.close()
        except Exception as error:  # a third party's, of any kind
            self._give_up(" ".join(str(error).split()) or type(error).__name__)

    def _give_up(self, reason: str) -> None:
        if not self._ended.is_set():
            self._ended.set()
            self._warn(f"{self._name}: {reason[:200]}; metrics go on without it, all of them are in metrics.jsonl")


def check(config: RunConfig) -> None:
    """Raise `UserError` if a package that a sink of `config` needs is not installed."""
    for name in config.trainer.sinks:
        if name in _EXTRAS and importlib.util.find_spec(name) is None:
            raise ConfigError(f"trainer.sinks: {name} is not installed; install it with {extras.install(name)}")


def numbers(rows: Sequence[Row]) -> dict[str, float]:
    """The means over seeds of an epoch's metrics, without those that are not finite and what counts or names rows."""
    found: dict[str, float] = {}
    for key in rows[0]:
        value = None if key in ("seed", "env_steps") else mean(rows, key)
        if value is not None and math.isfinite(value):
            found[key] = value
    return found
