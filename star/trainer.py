"""The host's side of a run: epochs, evaluation, checkpoints, metrics and the figure, around one jitted function."""

from __future__ import annotations

from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from star import (
    checkpoint,
    devices,
    evaluation,
    faults,
    memory,
    profiling,
    provenance,
    report,
    rollback,
    sinks,
    starting,
)
from star import program as programs
from star.checkpoint import Checkpoints
from star.config import Config, ConfigError
from star.display import Display, Stopwatch
from star.episode import Episode
from star.faults import Fault
from star.lock import locked
from star.metrics import Journal, of_epoch
from star.profiling import Profile
from star.program import Program
from star.records import Records
from star.sinks import Sinks
from star.state import TrainState
from star.stopping import Overdue, Stop, interruptible

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
    fault: Fault | None = None
    """What was not finite, if that is why."""
    saved: int | None = None
    """Env steps of the last checkpoint."""


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
    checkpoint is of the one before it. Where numbers are no longer finite it returns too, or goes back and on, as
    `trainer.on_non_finite` says. `profile` is the number of epochs that JAX's profiler traces, to `run_dir/profile`.
    What cannot be written, as on a full disk, raises `ConfigError`. Several processes (`devices.join`) call this alike,
    and only the first of them writes anything but its share of the checkpoints.
    """
    sinks.check(config)
    program = programs.build(config)
    program.lessons()  # refused before anything is written
    memory.check(program)
    first = devices.first()
    console = console or Console(stderr=True, quiet=not first)
    warn = partial(_warn, console)
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    profile *= first
    traced = _traced(program, checkpoints, profile) if profile else 0
    if not resume:
        starting.make(run_dir)
    journal = Journal.of(run_dir, muted=not first)
    alone = locked(run_dir, warn=warn) if first else nullcontext()
    with interruptible() as stop, alone, closing(checkpoints):
        stop.patient = jax.process_count() > 1  # the others would wait for ever for one that leaves an epoch
        if resume:
            state = starting.restored(program, checkpoints, journal, warn=warn)
        else:
            starting.note(run_dir, program.config)
            state = program.init(program.seed_keys())
        began = _epochs(state) * program.env_steps_per_epoch
        journal.provenance.write({"env_steps": began} | provenance.here(devices=config.trainer.devices))
        if config.trainer.on_non_finite == "rollback" and not checkpoints.steps():
            checkpoints.save(0, state, program.config, success=0.0)  # there is always one to go back to
        records = Records(program, journal)
        while True:
            slowed, state = rollback.slowed(program, state, journal, env_steps=began)
            result = _loop(
                slowed, records, state, run_dir, checkpoints,
                stop=stop, quiet=quiet, console=console, profile=(traced, profile),
            )  # fmt: skip
            fault = result.fault
            if fault is None or not rollback.goes_back(program, journal, fault, to=result.saved, warn=warn):
                return result
            state = starting.restored(program, checkpoints, journal, warn=warn)
            began = _epochs(state) * program.env_steps_per_epoch
            records.look_back()
            if result.interrupted:
                return replace(result, env_steps=began, fault=None)
            profile = 0


def _loop(
    program: Program,
    records: Records,
    state: TrainState,
    run_dir: Path,
    checkpoints: Checkpoints,
    *,
    stop: Stop,
    quiet: bool,
    console: Console,
    profile: tuple[int, int],
) -> Result:
    config, seeds = program.config.trainer, program.seeds
    done, fault = _epochs(state), None
    saved = done if checkpoints.steps() else -1
    stopwatch = Stopwatch()
    display = Display(
        console,
        stopwatch,
        title=f"{program.config.env.name} on {_machine(config.devices)}, {_named(seeds)}",
        total_env_steps=program.epochs * program.env_steps_per_epoch,
        done_env_steps=done * program.env_steps_per_epoch,
        quiet=quiet,
    )

    def save(epochs: int, state: TrainState) -> None:
        records.journal.sync()  # a checkpoint that is there has its rows
        checkpoints.save(epochs * program.env_steps_per_epoch, state, program.config, success=records.success or 0.0)

    def epoch(state: TrainState) -> tuple[TrainState, list[dict[str, Any]]]:
        state, metrics = program.epoch(state)
        return state, of_epoch(metrics, seeds)

    def evaluate(state: TrainState, done: int) -> Episode:
        return jax.block_until_ready(program.evaluate(state, program.evaluation_keys(done)))

    def asked() -> bool:
        return devices.anywhere(stop())

    stop.on_first = display.stop
    spare: tuple[int, TrainState] | None = None  # (epochs, state) before what may take long
    trace = Profile(run_dir / "profile", first=profile[0], epochs=profile[1], say=display.say, warn=display.warn)
    history = records.look_back()
    try:
        with Sinks(run_dir, program.config, history, warn=display.warn, muted=not devices.first()) as others:
            with display, trace:
                while done < program.epochs and fault is None and not asked():
                    trace.before(done)
                    evaluated = (done + 1) % config.eval_every == 0 or done + 1 == program.epochs
                    long = stopwatch.expected("epoch", *["evaluation"] * evaluated) > _LONG_S
                    spare = (done, _copied(state)) if long and not stop.patient else None
                    with stopwatch.measure("epoch"):
                        state, table = stop.during(partial(epoch, state))
                    speed = program.env_steps_per_epoch * len(seeds) / stopwatch.last("epoch")
                    done += 1
                    trace.after(done)
                    env_steps = done * program.env_steps_per_epoch
                    fault = faults.find(table, state, env_steps=env_steps)
                    if evaluated and fault is None:
                        with stopwatch.measure("evaluation"):
                            evaluation.add_to(table, stop.during(partial(evaluate, state, done)))
                        records.add_regions(state, env_steps=env_steps)
                    records.add(table, env_steps=env_steps, speed=speed)
                    others.write(table)
                    display.update(env_steps, table, left_s=stopwatch.left(_left(program, done)))
                    if fault is None and (done % config.checkpoint_every == 0 or done == program.epochs):
                        with stopwatch.measure("checkpoint"):
                            save(done, state)
                        saved = done
                interrupted = asked() if fault else done < program.epochs
                if fault is None and saved != done:
                    save(done, state)
            env_steps = done * program.env_steps_per_epoch
            regions = records.regions(state if fault is None else None, env_steps=env_steps)
            if devices.first():
                _draw(run_dir / "figures", program, rows=records.journal.metrics.read(), regions=regions)
            others.figures(run_dir / "figures")
    except Overdue:
        done = max(saved, 0)  # where it is, if what is short took long for once
        if spare is not None and spare[0] > saved:
            save(*spare)
            done = spare[0]
        return Result(run_dir, done * program.env_steps_per_epoch, True, records.success, terminated=True)
    steps = checkpoints.steps()
    return Result(
        run_dir,
        env_steps,
        interrupted,
        records.success,
        terminated=interrupted and devices.anywhere(stop.terminated),
        fault=fault,
        saved=steps[-1] if steps else None,
    )


def _copied(state: TrainState) -> TrainState:
    """A copy of `state` on the host: an epoch uses up what it is given."""
    return jax.tree.map(np.array, checkpoint.plain(state))


def _draw(folder: Path, program: Program, *, rows: list[dict[str, Any]], regions: list[dict[str, Any]]) -> None:
    walls = program.walls
    try:
        report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=walls)
        if regions:
            report.growth_figure(folder / "growth.png", regions=regions, walls=walls)
        if rows and program.config.sgim.enabled:
            report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=walls)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}; the run itself is saved") from None


def _epochs(state: TrainState) -> int:
    """How many are over."""
    return int(jax.device_get(state.epoch)[0])


def _machine(count: int) -> str:
    return (f"{count} x " if count > 1 else "") + jax.default_backend()


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


def _warn(console: Console, line: str) -> None:
    console.print(f"warning: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
