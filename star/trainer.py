"""The host's side of a run: epochs, evaluation, checkpoints, metrics and the figure, around one jitted function."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from envs import EnvError, files
from star import checkpoint, evaluation, lock, profiling, provenance, report, sinks
from star import program as programs
from star.checkpoint import Checkpoints
from star.config import Config, ConfigError
from star.display import Display, Stopwatch
from star.episode import Episode
from star.loading import load
from star.lock import locked
from star.metrics import Journal, by_step, mean, of_epoch
from star.profiling import Profile
from star.program import Program
from star.sinks import Sinks
from star.state import TrainState
from star.stopping import Overdue, Stop, interruptible

_BEGUN = (lock.NAME, ".config-")  # of a run that was killed before its config.yaml was written
_LONG_S = 3.0  # of what is to come a copy of the state is worth its time; shorter parts end in good time after SIGTERM


@dataclass(frozen=True)
class Result:
    """How a call of `train` ended."""

    run_dir: Path
    env_steps: int
    interrupted: bool
    success_final: float | None
    terminated: bool = False
    """Whether it was SIGTERM that interrupted it."""


def train(
    config: Config,
    run_dir: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    profile: int = 0,
    console: Console | None = None,
) -> Result:
    """Train to the end, or go on with the run in `run_dir`. Ctrl-C writes a checkpoint and returns.

    So does SIGTERM, and it waits no longer than `star.stopping.GRACE_S` for the epoch under way; after that the
    checkpoint is of the one before it. `profile` is the number of epochs that JAX's profiler traces, to
    `run_dir/profile`. What cannot be written, as on a full disk, raises `ConfigError`.
    """
    console = console or Console(stderr=True)
    sinks.check(config)
    program = programs.build(config)
    program.lessons()  # refused before anything is written
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    traced = _traced(program, checkpoints, profile) if profile else 0
    if not resume:
        _make(run_dir)
    journal = Journal.of(run_dir)
    warn = partial(_warn, console)
    with interruptible() as stop, locked(run_dir, warn=warn), closing(checkpoints):
        if resume:
            state = _restore(program, checkpoints, journal, warn=warn)
        else:
            _note(run_dir, program.config)
            state = _fresh(program)
        began = int(state.epoch[0]) * program.env_steps_per_epoch
        journal.provenance.write({"env_steps": began} | provenance.here())
        records = _Records(program, journal)
        return _loop(
            records, state, run_dir, checkpoints, stop=stop, quiet=quiet, console=console, profile=(traced, profile)
        )


class _Records:
    """What a run has measured so far. What is added is written down too, in the journal and by the sinks."""

    def __init__(self, program: Program, journal: Journal) -> None:
        self.program = program
        self.rows, self.regions = journal.metrics.read(), journal.regions.read()
        self._journal = journal
        self._began = time.monotonic() - (self.rows[-1]["wall_s"] if self.rows else 0.0)
        self.sync = journal.sync

    @property
    def success(self) -> float | None:
        """Mean `eval/success_final` of the latest evaluation."""
        evaluated = [row for row in self.rows if "eval/success_final" in row]
        return mean(by_step(evaluated)[-1], "eval/success_final") if evaluated else None

    def add(self, table: list[dict[str, Any]], *, env_steps: int, speed: float) -> None:
        """An epoch: one row for each seed."""
        for row in table:
            row |= {"env_steps": env_steps, "wall_s": round(time.monotonic() - self._began, 3)}
            row |= {"env_steps_per_s": round(speed)}
            self._journal.metrics.write(row)
        self.rows.extend(table)

    def add_regions(self, state: TrainState, *, env_steps: int, write: bool = True) -> None:
        """The regions of each seed, if it has a Commander."""
        program = self.program
        if not program.config.commander.enabled:
            return
        found = report.region_rows(
            program.config.agent(), state, seeds=program.seeds, env_steps=env_steps, goal=program.goal
        )
        if write:
            for row in found:
                self._journal.regions.write(row)
        self.regions.extend(found)


def _loop(
    records: _Records,
    state: TrainState,
    run_dir: Path,
    checkpoints: Checkpoints,
    *,
    stop: Stop,
    quiet: bool,
    console: Console,
    profile: tuple[int, int],
) -> Result:
    program = records.program
    config, seeds = program.config.trainer, program.seeds
    done = int(state.epoch[0])
    saved = done if checkpoints.steps() else -1
    stopwatch = Stopwatch()
    display = Display(
        console,
        stopwatch,
        title=f"{program.config.env.name} on {jax.default_backend()}, {_named(seeds)}",
        total_env_steps=program.epochs * program.env_steps_per_epoch,
        done_env_steps=done * program.env_steps_per_epoch,
        quiet=quiet,
    )

    def save(epochs: int, state: TrainState) -> None:
        records.sync()  # a checkpoint that is there has its rows
        checkpoints.save(epochs * program.env_steps_per_epoch, state, program.config, success=records.success or 0.0)

    def epoch(state: TrainState) -> tuple[TrainState, list[dict[str, Any]]]:
        state, metrics = program.epoch(state)
        return state, of_epoch(metrics, seeds)

    def evaluate(state: TrainState, done: int) -> Episode:
        return jax.block_until_ready(program.evaluate(state, program.evaluation_keys(done)))

    stop.on_first = display.stop
    spare: tuple[int, TrainState] | None = None  # (epochs, state) before what may take long
    trace = Profile(run_dir / "profile", first=profile[0], epochs=profile[1], say=display.say, warn=display.warn)
    try:
        with Sinks(run_dir, program.config, records.rows, warn=display.warn) as others:
            with display, trace:
                while done < program.epochs and not stop():
                    trace.before(done)
                    evaluated = (done + 1) % config.eval_every == 0 or done + 1 == program.epochs
                    long = stopwatch.expected("epoch", *["evaluation"] * evaluated) > _LONG_S
                    spare = (done, _copied(state)) if long else None
                    with stopwatch.measure("epoch"):
                        state, table = stop.during(partial(epoch, state))
                    speed = program.env_steps_per_epoch * len(seeds) / stopwatch.last("epoch")
                    done += 1
                    trace.after(done)
                    env_steps = done * program.env_steps_per_epoch
                    if evaluated:
                        with stopwatch.measure("evaluation"):
                            evaluation.add_to(table, stop.during(partial(evaluate, state, done)))
                        records.add_regions(state, env_steps=env_steps)
                    records.add(table, env_steps=env_steps, speed=speed)
                    others.write(table)
                    display.update(env_steps, table, left_s=stopwatch.left(_left(program, done)))
                    if done % config.checkpoint_every == 0 or done == program.epochs:
                        with stopwatch.measure("checkpoint"):
                            save(done, state)
                        saved = done
                stopped = done < program.epochs
                if saved != done:
                    save(done, state)
            env_steps = done * program.env_steps_per_epoch
            if not (records.regions and records.regions[-1]["env_steps"] == env_steps):  # stopped between evaluations
                records.add_regions(state, env_steps=env_steps, write=False)
            _draw(run_dir / "figures", records)
            others.figures(run_dir / "figures")
    except Overdue:
        done = max(saved, 0)  # where it is, if what is short took long for once
        if spare is not None and spare[0] > saved:
            save(*spare)
            done = spare[0]
        return Result(run_dir, done * program.env_steps_per_epoch, True, records.success, terminated=True)
    return Result(run_dir, env_steps, stopped, records.success, terminated=stop.terminated)


def _copied(state: TrainState) -> TrainState:
    """A copy of `state` on the host: an epoch uses up what it is given."""
    return jax.tree.map(np.array, checkpoint.plain(state))


def _draw(folder: Path, records: _Records) -> None:
    rows, regions, walls = records.rows, records.regions, records.program.walls
    try:
        report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=walls)
        if regions:
            report.growth_figure(folder / "growth.png", regions=regions, walls=walls)
        if rows and records.program.config.sgim.enabled:
            report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=walls)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}; the run itself is saved") from None


def _named(seeds: list[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"


def _left(program: Program, done: int) -> dict[str, int]:
    """How many epochs, evaluations and checkpoints follow after `done` epochs; the last epoch has both."""

    def count(every: int) -> int:
        return -(-program.epochs // every) - done // every if done < program.epochs else 0

    config = program.config.trainer
    return {
        "epoch": program.epochs - done,
        "evaluation": count(config.eval_every),
        "checkpoint": count(config.checkpoint_every),
    }


def _traced(program: Program, checkpoints: Checkpoints, epochs: int) -> int:
    """After how many epochs the profiler begins to trace; raises `ConfigError` if the run is too short for it."""
    return profiling.plan(
        done=(checkpoints.steps() or [0])[-1] // program.env_steps_per_epoch,
        total=program.epochs,
        eval_every=program.config.trainer.eval_every,
        epochs=epochs,
    )


def _restore(
    program: Program, checkpoints: Checkpoints, journal: Journal, *, warn: Callable[[str], None]
) -> TrainState:
    """The state to go on from, after what was measured later has been dropped. A damaged checkpoint is set aside."""
    run_dir = journal.metrics.path.parent
    if not checkpoints.steps():
        for key, old, new in checkpoint.differences(load(run_dir / "config.yaml"), program.config):
            raise ConfigError(f"{run_dir}: was begun with {key} {old}, not {new}")
        warn(f"{run_dir}: holds no checkpoint, so it begins anew")
        journal.keep_until(0)
        return _fresh(program)
    step, damaged = checkpoint.newest(checkpoints)
    state = checkpoint.restore(program, checkpoints, step, source=run_dir)
    for number, error in damaged.items():
        warn(f"{error}; it is now {checkpoints.set_aside(number).name}, and the run goes on from {step:,} env steps")
    journal.keep_until(step)
    return state


def _fresh(program: Program) -> TrainState:
    """The state that a run begins with, where a restored one is too."""
    return jax.device_put(program.init(program.seed_keys()), jax.devices()[0])


def _make(run_dir: Path) -> None:
    """Make the folder of a new run; what a process that was killed at once left there does no harm."""
    used = run_dir.is_dir() and any(not entry.name.startswith(_BEGUN) for entry in run_dir.iterdir())
    if used or (run_dir.exists() and not run_dir.is_dir()):
        raise ConfigError(
            f"{run_dir}: is not empty; choose another --run-dir, or go on with it: star train --resume {run_dir}"
        )
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be written: {error.strerror}") from None


def _note(run_dir: Path, config: Config) -> None:
    try:
        with files.whole(run_dir / "config.yaml") as path:
            path.write_text(config.to_yaml(), encoding="utf-8")
    except EnvError as error:
        raise ConfigError(str(error)) from None


def _warn(console: Console, line: str) -> None:
    console.print(f"warning: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
