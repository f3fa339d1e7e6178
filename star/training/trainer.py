"""The host's side of a run: what it is made of and where it begins; `star.training.loop` takes it on from there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

from envs.common import plugins
from star import devices
from star.config.run import RunConfig
from star.training import memory_budget, profiling, provenance, rollback, run_folder, sinks
from star.training import program as programs
from star.training.checkpoint import Checkpoints
from star.training.journal import Journal
from star.training.lock import locked
from star.training.loop import Loop, Result
from star.training.program import Program
from star.training.recorder import Recorder
from star.training.signals import interruptible


def train(
    config: RunConfig,
    run_dir: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    profile: int = 0,
    console: Console | None = None,
) -> Result:
    """Train to the end, or go on with the run in `run_dir`. Ctrl-C writes a checkpoint and returns.

    So does SIGTERM, and it waits no longer than `star.training.signals.GRACE_S` for the epoch under way; after that the
    checkpoint is of the one before it. Where numbers are no longer finite it returns too, or goes back and on, as
    `trainer.on_non_finite` says. `profile` is the number of epochs that JAX's profiler traces, to `run_dir/profile`.
    What cannot be written, as on a full disk, raises `UserError`. Several processes (`devices.join`) call this alike,
    and only the first of them writes anything but its share of the checkpoints.
    """
    program = ready(config, run_dir)
    first = devices.first()
    console = console or Console(stderr=True, quiet=not first)
    warn = partial(_warn, console)
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    profile *= first
    traced = _traced(program, checkpoints, profile) if profile else 0
    if not resume:
        run_folder.make(run_dir)
    journal = Journal.of(run_dir, tables=program.kind.tables, muted=not first)
    alone = locked(run_dir, warn=warn) if first else nullcontext()
    with interruptible() as stop, alone, closing(checkpoints):
        stop.patient = jax.process_count() > 1  # the others would wait for ever for one that leaves an epoch
        state, began = _begin(program, run_dir, checkpoints, journal, resume=resume, warn=warn)
        recorder = Recorder(program, journal)
        while True:
            slowed, state = rollback.slowed(program, state, journal, env_steps=began)
            result = Loop(
                slowed, recorder, checkpoints, run_dir,
                done=_epochs(state), stop=stop, quiet=quiet, console=console, profile=(traced, profile),
            ).run(state)  # fmt: skip
            fault = result.fault
            if fault is None or not rollback.goes_back(program, journal, fault, to=result.saved, warn=warn):
                return result
            state = run_folder.restored(program, checkpoints, journal, warn=warn)
            began = _epochs(state) * program.steps_per_epoch
            recorder.look_back()
            if result.interrupted:
                return replace(result, env_steps=began, fault=None)
            profile = 0


def ready(config: RunConfig, run_dir: Path) -> Program:
    """The program of a run that can begin; raises `UserError` for one that cannot, before anything is written."""
    run_folder.check_name(run_dir)
    sinks.check(config)
    program = programs.build(config)
    program.data()
    memory_budget.check(program)
    if plugins.trusted():  # a user's own code may be wrong
        program.check()
    return program


def _begin(
    program: Program,
    run_dir: Path,
    checkpoints: Checkpoints,
    journal: Journal,
    *,
    resume: bool,
    warn: Callable[[str], None],
) -> tuple[Any, int]:
    """The state to train from, fresh or restored, and its env steps; notes down with what and where they began."""
    if resume:
        settings = run_folder.settings(run_dir, program)
        state = run_folder.restored(program, checkpoints, journal, warn=warn)
    else:
        settings = {}
        run_folder.note(run_dir, program.config)
        state = program.init(program.seed_keys())
    began = _epochs(state) * program.steps_per_epoch
    here = provenance.here(devices=program.config.trainer.devices)
    journal.provenance.write({"env_steps": began, "settings": settings} | here)
    if program.config.trainer.on_non_finite == "rollback" and not checkpoints.steps():
        checkpoints.save(0, state, program.config, score=None)  # there is always one to go back to
    return state, began


def _epochs(state: Any) -> int:
    """The number done."""
    return int(jax.device_get(state.epoch)[0])


def _traced(program: Program, checkpoints: Checkpoints, epochs: int) -> int:
    """After how many epochs the profiler begins to trace; raises `UserError` if the run is too short for it."""
    return profiling.plan(
        done=(checkpoints.steps() or [0])[-1] // program.steps_per_epoch,
        total=program.epochs,
        eval_every=program.config.trainer.eval_every,
        epochs=epochs,
    )


def _warn(console: Console, line: str) -> None:
    console.print(f"warning: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
