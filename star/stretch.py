"""A stretch of a run: epochs from a state on, with what is seen and kept of them, until something ends it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from star import checkpoint, devices, evaluation, faults, report
from star.agent.play import Episode
from star.agent.state import TrainState
from star.checkpoint import Checkpoints
from star.config.section import ConfigError
from star.display import Display, Stopwatch
from star.faults import Fault
from star.metrics import of_epoch
from star.profiling import Profile
from star.program import Program
from star.records import Records
from star.sinks import Sinks
from star.stopping import Overdue, Stop

_LONG_S = 3.0  # of what is to come a copy of the state is worth its time; shorter parts end in good time after SIGTERM


@dataclass(frozen=True)
class Result:
    """How a stretch, or a call of `train`, ended."""

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


class Stretch:
    """The stretch of a run that begins after the epoch `done`; `profile` says after which epoch to trace how many."""

    def __init__(
        self,
        program: Program,
        records: Records,
        checkpoints: Checkpoints,
        run_dir: Path,
        *,
        done: int,
        stop: Stop,
        quiet: bool,
        console: Console,
        profile: tuple[int, int],
    ) -> None:
        self._program, self._records, self._checkpoints, self._run_dir = program, records, checkpoints, run_dir
        self._done = done
        self._saved = done if checkpoints.steps() else -1
        self._spare: tuple[int, TrainState] | None = None
        """(epochs, state) before what may take long."""
        self._stop = stop
        self._stopwatch = Stopwatch()
        self._display = Display(
            console,
            self._stopwatch,
            title=f"{program.config.env.name} on {_machine(program.config.trainer.devices)}, {_named(program.seeds)}",
            total_env_steps=program.epochs * program.env_steps_per_epoch,
            done_env_steps=self._env_steps,
            quiet=quiet,
        )
        first, epochs = profile
        say, warn = self._display.say, self._display.warn
        self._trace = Profile(run_dir / "profile", first=first, epochs=epochs, say=say, warn=warn)

    def run(self, state: TrainState) -> Result:
        """Train from `state` to the end, to a signal, or until numbers are no longer finite."""
        program, muted = self._program, not devices.first()
        history = self._records.journal.metrics.read() if program.config.trainer.sinks else []
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
            self._records.success,
            terminated=interrupted and devices.anywhere(self._stop.terminated),
            fault=fault,
            saved=steps[-1] if steps else None,
        )

    def _epochs(self, state: TrainState, others: Sinks) -> tuple[TrainState, Fault | None]:
        program, fault = self._program, None
        while self._done < program.epochs and fault is None and not self._asked():
            state, table, fault = self._epoch(state)
            others.write(table)
            self._display.update(self._env_steps, table, left_s=self._stopwatch.left(_left(program, self._done)))
            if fault is None and self._is_due(program.config.trainer.checkpoint_every, self._done):
                with self._stopwatch.measure("checkpoint"):
                    self._save(self._done, state)
        return state, fault

    def _epoch(self, state: TrainState) -> tuple[TrainState, list[dict[str, Any]], Fault | None]:
        """An epoch, with its evaluation if it is due: the state, the rows, and what is not finite."""
        program, seeds = self._program, self._program.seeds
        self._trace.before(self._done)
        evaluated = self._is_due(program.config.trainer.eval_every, self._done + 1)
        long = self._stopwatch.expected("epoch", *["evaluation"] * evaluated) > _LONG_S
        self._spare = (self._done, _copied(state)) if long and not self._stop.patient else None
        with self._stopwatch.measure("epoch"):
            state, table = self._stop.during(partial(self._compute, state))
        speed = program.env_steps_per_epoch * len(seeds) / self._stopwatch.last("epoch")
        self._done += 1
        self._trace.after(self._done)
        fault = faults.find(table, state, env_steps=self._env_steps)
        if evaluated and fault is None:
            with self._stopwatch.measure("evaluation"):
                evaluation.add_to(table, self._stop.during(partial(self._evaluate, state)))
            self._records.add_regions(state, env_steps=self._env_steps)
        self._records.add(table, env_steps=self._env_steps, speed=speed)
        return state, table, fault

    def _compute(self, state: TrainState) -> tuple[TrainState, list[dict[str, Any]]]:
        state, metrics = self._program.epoch(state)
        return state, of_epoch(metrics, self._program.seeds)

    def _evaluate(self, state: TrainState) -> Episode:
        return jax.block_until_ready(self._program.evaluate(state, self._program.evaluation_keys(self._done)))

    def _save(self, epochs: int, state: TrainState) -> None:
        program, records = self._program, self._records
        records.journal.sync()  # a checkpoint that is there has its rows
        env_steps, success = epochs * program.env_steps_per_epoch, records.success or 0.0
        self._checkpoints.save(env_steps, state, program.config, success=success)
        self._saved = epochs

    def _left_off(self) -> Result:
        """What SIGTERM leaves of a computation that took too long: the state before it, if there is a copy."""
        done = max(self._saved, 0)  # where it is, if what is short took long for once
        if self._spare is not None and self._spare[0] > self._saved:
            self._save(*self._spare)
            done = self._spare[0]
        env_steps = done * self._program.env_steps_per_epoch
        return Result(self._run_dir, env_steps, True, self._records.success, terminated=True)

    def _draw(self, state: TrainState | None) -> None:
        """The figures; with the regions of `state` even if it was not evaluated."""
        regions = self._records.regions(state, env_steps=self._env_steps)
        if not devices.first():
            return
        folder, walls, rows = self._run_dir / "figures", self._program.walls, self._records.journal.metrics.read()
        try:
            report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=walls)
            if regions:
                report.growth_figure(folder / "growth.png", regions=regions, walls=walls)
            if rows and self._program.config.sgim.enabled:
                report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=walls)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be written: {error.strerror}; the run itself is saved") from None

    @property
    def _env_steps(self) -> int:
        return self._done * self._program.env_steps_per_epoch

    def _is_due(self, every: int, done: int) -> bool:
        """Whether what is done every so many epochs, and at the end, is done after `done` epochs."""
        return done % every == 0 or done == self._program.epochs

    def _asked(self) -> bool:
        return devices.anywhere(self._stop())


def _copied(state: TrainState) -> TrainState:
    """A copy of `state` on the host: an epoch uses up what it is given."""
    return jax.tree.map(np.array, checkpoint.plain(state))


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
