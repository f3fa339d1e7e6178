"""The loop of a run: epochs from a state on, with what is seen and kept of them, until something ends it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from star import devices
from star.config.section import ConfigError
from star.training import faults
from star.training.checkpoint import Checkpoints
from star.training.console import Display, Stopwatch
from star.training.faults import Fault
from star.training.figures import save
from star.training.journal import of_epoch
from star.training.profiling import Profile
from star.training.program import Program
from star.training.recorder import Recorder
from star.training.signals import Overdue, Stop
from star.training.sinks import Sinks
from star.training.state import plain

_LONG_S = 3.0  # of what is to come a copy of the state is worth its time; shorter parts end in good time after SIGTERM


@dataclass(frozen=True)
class Result:
    """The end of a loop, or of a call of `train`."""

    run_dir: Path
    env_steps: int
    interrupted: bool
    score: float | None
    """Mean over seeds of the first measure in the latest evaluation."""
    terminated: bool = False
    """True if it was SIGTERM that interrupted it."""
    fault: Fault | None = None
    """The fault, if numbers were not finite."""
    saved: int | None = None
    """Env steps of the last checkpoint."""
    began: int = 0
    """Env steps that there were before."""


class Loop:
    """The part of a run that begins after the epoch `done`; `profile` says after which epoch to trace how many."""

    def __init__(
        self,
        program: Program,
        recorder: Recorder,
        checkpoints: Checkpoints,
        run_dir: Path,
        *,
        done: int,
        stop: Stop,
        quiet: bool,
        console: Console,
        profile: tuple[int, int],
    ) -> None:
        self._program, self._recorder, self._checkpoints, self._run_dir = program, recorder, checkpoints, run_dir
        self._began = self._done = done
        self._saved = done if checkpoints.steps() else -1
        self._spare: tuple[int, Any] | None = None
        """(epochs, state) before what may take long."""
        self._stop = stop
        self._seen: dict[int, list[dict[str, Any]]] = {seed: [] for seed in program.seeds}
        """Of each seed what notices are drawn from, since this process began."""
        self._noted: set[tuple[int, str]] = set()
        self._stopwatch = Stopwatch()
        self._display = Display(
            console,
            self._stopwatch,
            experiment=program.experiment,
            kind=program.kind,
            title=_title(program),
            total=max(program.epochs, done) * program.steps_per_epoch,
            done=self._env_steps,
            quiet=quiet,
        )
        first, epochs = profile
        say, warn = self._display.say, self._display.warn
        self._trace = Profile(run_dir / "profile", first=first, epochs=epochs, say=say, warn=warn)

    def run(self, state: Any) -> Result:
        """Train from `state` to the end, to a signal, or until numbers are no longer finite."""
        program, muted = self._program, not devices.first()
        self._say_what_is_rounded()
        for line in program.experiment.notes():
            self._display.note(line)
        history = self._recorder.journal.metrics.read() if program.config.trainer.sinks else []
        self._stop.on_first = self._display.stop
        try:
            with Sinks(self._run_dir, program.config, history, warn=self._display.warn, muted=muted) as others:
                del history
                with self._display, self._trace:
                    state, fault = self._epochs(state, others)
                    interrupted = self._asked() if fault else self._done < program.epochs
                    if fault is None and self._saved != self._done:
                        self._save(self._done, state)
                self._draw(None if fault else state)
                others.figures(self._run_dir / "figures")
        except Overdue:
            return self._left_off()
        steps = self._checkpoints.steps()
        return Result(
            self._run_dir,
            self._env_steps,
            interrupted,
            self._recorder.score,
            terminated=interrupted and devices.anywhere(self._stop.terminated),
            fault=fault,
            saved=steps[-1] if steps else None,
            began=self._began * program.steps_per_epoch,
        )

    def _say_what_is_rounded(self) -> None:
        wanted, one = self._program.config.trainer.total_env_steps, self._program.steps_per_epoch
        total = self._program.epochs * one
        if self._began < self._program.epochs and wanted != total:
            self._display.note(f"trainer.total_env_steps: {wanted:,} becomes {total:,}, whole epochs of {one:,}")

    def _epochs(self, state: Any, others: Sinks) -> tuple[Any, Fault | None]:
        program, fault = self._program, None
        while self._done < program.epochs and fault is None and not self._asked():
            state, table, fault = self._epoch(state)
            others.write(table)
            self._display.update(self._env_steps, table, left_s=self._stopwatch.left(_left(program, self._done)))
            self._note(table)
            if fault is None and self._is_due(program.config.trainer.checkpoint_every, self._done):
                with self._stopwatch.measure("checkpoint"):
                    self._save(self._done, state)
        return state, fault

    def _epoch(self, state: Any) -> tuple[Any, list[dict[str, Any]], Fault | None]:
        """An epoch, with its evaluation if it is due: the state, the rows, and what is not finite."""
        program, seeds = self._program, self._program.seeds
        self._trace.before(self._done)
        evaluated = self._is_due(program.config.trainer.eval_every, self._done + 1)
        kept = self._done <= max(self._saved, 0)  # on disk, or made anew from the seeds
        long = self._stopwatch.expected("epoch", *["evaluation"] * evaluated) > _LONG_S
        self._spare = (self._done, _copied(state)) if long and not kept and not self._stop.patient else None
        with self._stopwatch.measure("epoch"):
            state, table = self._stop.during(partial(self._compute, state))
        speed = program.steps_per_epoch * len(seeds) / self._stopwatch.last("epoch")
        self._done += 1
        self._trace.after(self._done)
        fault = faults.find(table, state, env_steps=self._env_steps, may_be_nan=program.kind.may_be_nan)
        if evaluated and fault is None:
            with self._stopwatch.measure("evaluation"):
                found = program.rows(self._stop.during(partial(self._evaluate, state)))
            for row, measured in zip(table, found, strict=True):
                row |= measured
            self._recorder.add_tables(state, env_steps=self._env_steps)
        self._recorder.add(table, env_steps=self._env_steps, speed=speed)
        return state, table, fault

    def _note(self, table: list[dict[str, Any]]) -> None:
        """Say what is new to say of each seed."""
        notices = self._program.kind.notices
        for row in table:
            seed, rows = row["seed"], self._seen[row["seed"]]
            rows.append({key: row[key] for key in ("env_steps", *notices.keys) if key in row})
            for subject, line in notices.lines(rows).items():
                if (seed, subject) not in self._noted:
                    self._noted.add((seed, subject))
                    self._display.note(f"seed {seed}: {line}")

    def _compute(self, state: Any) -> tuple[Any, list[dict[str, Any]]]:
        first = self._done == self._began and jax.process_count() == 1  # several would have to compile in one order
        if first:
            self._program.prepare()
        state, metrics = self._program.epoch(state)
        if first and (counted := int(jax.device_get(state.epoch)[0])) != self._done + 1:
            name = self._program.config.experiment
            raise ConfigError(f"experiment: {name}: `epoch` is {counted} after epoch {self._done + 1}; it must add 1")
        return state, of_epoch(metrics, self._program.seeds)

    def _evaluate(self, state: Any) -> Any:
        return jax.block_until_ready(self._program.evaluate(state, self._program.evaluation_keys(self._done)))

    def _save(self, epochs: int, state: Any) -> None:
        program = self._program
        self._recorder.journal.sync()  # a checkpoint that is there has its rows
        self._checkpoints.save(epochs * program.steps_per_epoch, state, program.config, score=self._recorder.score)
        self._saved = epochs

    def _left_off(self) -> Result:
        """The state after SIGTERM in a computation that took too long: that before it, if there is a copy."""
        done = max(self._saved, 0)  # where it is, if what is short took long for once
        if self._spare is not None and self._spare[0] > self._saved:
            self._save(*self._spare)
            done = self._spare[0]
        env_steps = done * self._program.steps_per_epoch
        return Result(self._run_dir, env_steps, True, self._recorder.score, terminated=True)

    def _draw(self, state: Any) -> None:
        """The figures; with the tables of `state` even if it was not evaluated."""
        tables = self._recorder.tables(state, env_steps=self._env_steps)
        if not devices.first():
            return
        folder, rows = self._run_dir / "figures", self._recorder.journal.metrics.read()
        try:
            for name, figure in self._program.experiment.figures(rows, tables).items():
                save(figure, folder / f"{name}.png")
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be written: {error.strerror}; the run itself is saved") from None

    @property
    def _env_steps(self) -> int:
        return self._done * self._program.steps_per_epoch

    def _is_due(self, every: int, done: int) -> bool:
        """True if what is done every so many epochs, and at the end, is done after `done` epochs."""
        return done % every == 0 or done == self._program.epochs

    def _asked(self) -> bool:
        return devices.anywhere(self._stop())


def _copied(state: Any) -> Any:
    """A copy of `state` on the host: an epoch uses up what it is given."""
    found = jax.device_get(plain(state))
    return jax.tree.map(np.array, found) if jax.default_backend() == "cpu" else found  # there it is the state itself


def _title(program: Program) -> str:
    machine = _machine(program.config.trainer.devices)
    return f"{program.kind.title(program.config)} on {machine}, {_named(program.seeds)}"


def _machine(count: int) -> str:
    return (f"{count} x " if count > 1 else "") + jax.default_backend()


def _named(seeds: list[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"


def _left(program: Program, done: int) -> dict[str, int]:
    """Number of epochs, evaluations and checkpoints that follow after `done` epochs; the last epoch has both."""

    def count(every: int) -> int:
        return -(-program.epochs // every) - done // every if done < program.epochs else 0

    config = program.config.trainer
    return {
        "epoch": program.epochs - done,
        "evaluation": count(config.eval_every),
        "checkpoint": count(config.checkpoint_every),
    }
