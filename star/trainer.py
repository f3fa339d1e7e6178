"""The host's side of a run: epochs, evaluation, checkpoints, metrics and the figure, around one jitted function."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import jax
from rich.console import Console

from star import checkpoint, evaluation, memory, profiling, provenance, report, sinks
from star import program as programs
from star.checkpoint import Checkpoints
from star.config import Config, ConfigError
from star.display import Display, Stopwatch
from star.metrics import Journal, by_step, mean, of_epoch
from star.profiling import Profile
from star.program import Program
from star.sinks import Sinks
from star.state import TrainState


@dataclass(frozen=True)
class Result:
    """How a call of `train` ended."""

    run_dir: Path
    env_steps: int
    interrupted: bool
    success_final: float | None


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

    `profile` is the number of epochs that JAX's profiler traces, to `run_dir/profile`.
    """
    console = console or Console(stderr=True)
    sinks.check(config)
    program = programs.build(config)
    program.lessons()  # refused before anything is written
    memory.check(program)
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    traced = _traced(program, checkpoints, profile) if profile else 0
    journal = Journal.of(run_dir)
    if resume:
        state = _restore(program, checkpoints, journal)
    else:
        _prepare(run_dir, program.config)
        state = jax.device_put(program.init(program.seed_keys()), jax.devices()[0])  # as a restored one is
    began = int(state.epoch[0]) * program.env_steps_per_epoch
    journal.provenance.write({"env_steps": began} | provenance.here())
    try:
        records = _Records(program, journal)
        return _loop(records, state, run_dir, checkpoints, quiet=quiet, console=console, profile=(traced, profile))
    finally:
        checkpoints.close()


class _Records:
    """What a run has measured so far. What is added is written down too, in the journal and by the sinks."""

    def __init__(self, program: Program, journal: Journal) -> None:
        self.program = program
        self.rows, self.regions = journal.metrics.read(), journal.regions.read()
        self._journal = journal
        self._began = time.monotonic() - (self.rows[-1]["wall_s"] if self.rows else 0.0)

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

    def save() -> None:
        checkpoints.save(done * program.env_steps_per_epoch, state, program.config, success=records.success or 0.0)

    trace = Profile(run_dir / "profile", first=profile[0], epochs=profile[1], say=display.say, warn=display.warn)
    with Sinks(run_dir, program.config, records.rows, warn=display.warn) as others:
        with display, trace, interruptible(display.stop) as interrupted:
            while done < program.epochs and not interrupted():
                trace.before(done)
                with stopwatch.measure("epoch"):
                    state, metrics = program.epoch(state)
                    table = of_epoch(metrics, seeds)
                speed = program.env_steps_per_epoch * len(seeds) / stopwatch.last("epoch")
                done += 1
                trace.after(done)
                env_steps = done * program.env_steps_per_epoch
                if done % config.eval_every == 0 or done == program.epochs:
                    with stopwatch.measure("evaluation"):
                        evaluation.add_to(table, program.evaluate(state, program.evaluation_keys(done)))
                    records.add_regions(state, env_steps=env_steps)
                records.add(table, env_steps=env_steps, speed=speed)
                others.write(table)
                display.update(env_steps, table, left_s=stopwatch.left(_left(program, done)))
                if done % config.checkpoint_every == 0 or done == program.epochs:
                    with stopwatch.measure("checkpoint"):
                        save()
                    saved = done
            stopped = done < program.epochs
            if saved != done:
                save()
        env_steps = done * program.env_steps_per_epoch
        if not (records.regions and records.regions[-1]["env_steps"] == env_steps):  # stopped between evaluations
            records.add_regions(state, env_steps=env_steps, write=False)
        _draw(run_dir / "figures", records)
        others.figures(run_dir / "figures")
    return Result(run_dir, env_steps, stopped, records.success)


def _draw(folder: Path, records: _Records) -> None:
    rows, regions, walls = records.rows, records.regions, records.program.walls
    report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=walls)
    if regions:
        report.growth_figure(folder / "growth.png", regions=regions, walls=walls)
    if rows and records.program.config.sgim.enabled:
        report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=walls)


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


def _restore(program: Program, checkpoints: Checkpoints, journal: Journal) -> TrainState:
    steps, run_dir = checkpoints.steps(), journal.metrics.path.parent
    if not steps:
        raise ConfigError(f"{run_dir}: holds no checkpoint to resume from")
    state = checkpoint.restore(program, checkpoints, steps[-1], source=run_dir)
    for lines in (journal.metrics, journal.regions):
        lines.keep_until(steps[-1])
    return state


def _prepare(run_dir: Path, config: Config) -> None:
    try:
        if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
            raise ConfigError(
                f"{run_dir}: is not empty; choose another --run-dir, or go on with it: star train --resume {run_dir}"
            )
        run_dir.mkdir(parents=True, exist_ok=True)
        (run_dir / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be written: {error.strerror}") from None


@contextlib.contextmanager
def interruptible(on_first: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether Ctrl-C was pressed, upon which it calls `on_first`; a second one stops."""
    pressed = False

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True
        on_first()

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
