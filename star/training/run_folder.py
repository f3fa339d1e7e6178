"""A run begins, or goes on: its folder and first state. Of several processes the first one writes."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from envs.common import files
from star import devices
from star.config import command_line
from star.config.loading import changed, dotted, load_run
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.training import checkpoint, compatibility, lock
from star.training.checkpoint import Checkpoints
from star.training.journal import Journal
from star.training.program import Program

_BEGUN = (lock.NAME, ".config-")  # of a run that was killed before its config.yaml was written


def make(run_dir: Path) -> None:
    """Make the folder of a new run; what a process that was killed at once left there does no harm."""
    try:
        if run_dir.exists() and not run_dir.is_dir():
            raise ConfigError(f"{run_dir}: is a file; choose another --run-dir")
        if run_dir.is_dir() and any(not entry.name.startswith(_BEGUN) for entry in run_dir.iterdir()):
            run = (run_dir / "config.yaml").is_file()
            again = f", or go on with it: {command_line.of('train', '--resume', run_dir)}" if run else ""
            raise ConfigError(f"{run_dir}: is not empty; choose another --run-dir{again}")
        devices.wait("the run directory is empty")
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be written: {error.strerror}") from None


def check_name(run_dir: Path) -> None:
    """Raise `UserError` for a folder that orbax takes for a pattern: checkpoints written there could not be read."""
    files.check_name(run_dir)
    if re.search(r"\[.*\]|\\", os.fspath(run_dir.absolute())):
        raise ConfigError(f"{run_dir}: a run cannot be kept there; not allowed in the name, or above: [ with ], and \\")


def note(run_dir: Path, config: RunConfig) -> None:
    """Write the config of a new run into its folder."""
    if not devices.first():
        return
    with files.whole(run_dir / "config.yaml") as path:
        path.write_text(config.to_yaml(), encoding="utf-8")


def settings(run_dir: Path, program: Program) -> dict[str, Any]:
    """The settings of `program` that are not those of the run's `config.yaml`, by their dotted keys."""
    return changed(dotted(_noted(run_dir, program)), dotted(program.config))


def _noted(run_dir: Path, program: Program) -> Any:
    """The config in the folder of a run of the task of `program`."""
    config = load_run(run_dir, {})
    return program.experiment.resolve(config) if config.experiment == program.config.experiment else config


def restored(program: Program, checkpoints: Checkpoints, journal: Journal, *, warn: Callable[[str], None]) -> Any:
    """The state to go on from, after what was measured later has been dropped. A damaged checkpoint is set aside."""
    run_dir = journal.metrics.path.parent
    if not checkpoints.steps():
        for key, old, new in compatibility.differences(_noted(run_dir, program), program.config):
            raise ConfigError(f"{run_dir}: was begun with {key} {old}, not {new}")
        warn(f"{run_dir}: holds no checkpoint, so it begins anew")
        journal.keep_until(0)
        devices.wait("the journal is empty")
        return program.init(program.seed_keys())
    step, damaged = checkpoint.newest(checkpoints)
    state = checkpoint.restore(program, checkpoints, step, source=run_dir)
    devices.wait("all processes have their state")
    for number, error in damaged.items():
        aside = checkpoints.set_aside(number)
        warn(f"{error}; it is now {aside.name}, and the run goes on from {step:,} env steps")
    journal.keep_until(step)
    devices.wait("the journal is that of the checkpoint")
    return state
