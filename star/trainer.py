"""The host's side of a run: epochs, evaluation, checkpoints, metrics and the figure, around one jitted function."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import numpy as np
from rich.console import Console

from star import checkpoint, devices, evaluation, faults, profiling, provenance, report, sinks
from star import program as programs
from star.checkpoint import Checkpoints
from star.config import Config, ConfigError
from star.display import Display, Stopwatch
from star.faults import Fault
from star.metrics import Journal, by_step, mean, of_epoch
from star.profiling import Profile
from star.program import Program
from star.sinks import Sinks
from star.state import TrainState


@dataclass(frozen=True)
class Result:
    """How a call of `train` ended. `fault` is what was not finite, if that is why; `saved` the last checkpoint."""

    run_dir: Path
    env_steps: int
    interrupted: bool
    success_final: float | None
    fault: Fault | None = None
    saved: int | None = None


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

    Where numbers are no longer finite, it returns too, or goes back and on, as `trainer.on_non_finite` says.
    `profile` is the number of epochs that JAX's profiler traces, to `run_dir/profile`. Several processes
    (`devices.join`) call this alike, and only the first of them writes anything but its share of the checkpoints.
    """
    sinks.check(config)
    program = programs.build(config)
    program.lessons()  # refused before anything is written
    console = console or Console(stderr=True, quiet=not devices.first())
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    profile *= devices.first()
    traced = _traced(program, checkpoints, profile) if profile else 0
    journal = Journal.of(run_dir, muted=not devices.first())
    if resume:
        state = _restore(program, checkpoints, journal)
    else:
        _prepare(run_dir, program.config)
        state = program.init(program.seed_keys())
    began = _epochs(state) * program.env_steps_per_epoch
    journal.provenance.write({"env_steps": began} | provenance.here(devices=config.trainer.devices))
    if config.trainer.on_non_finite == "rollback" and not checkpoints.steps():
        checkpoints.save(0, state, program.config, success=0.0)  # there is always one to go back to
    try:
        records = _Records(program, journal)
        while True:
            slowed, state = _slowed(program, state, journal)
            result = _loop(
                slowed, records, state, run_dir, checkpoints, quiet=quiet, console=console, profile=(traced, profile)
            )
            if result.fault is None or not _goes_back(program, checkpoints, journal, result.fault, console):
                return result
            state = _restore(program, checkpoints, journal)
            records.keep_until(checkpoints.steps()[-1])
            if result.interrupted:
                return replace(result, env_steps=checkpoints.steps()[-1], fault=None)
            profile = 0
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

    def keep_until(self, env_steps: int) -> None:
        """Forget what came after `env_steps`; the journal has been cut already."""
        self.rows = [row for row in self.rows if row["env_steps"] <= env_steps]
        self.regions = [row for row in self.regions if row["env_steps"] <= env_steps]

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
    program: Program,
    records: _Records,
    state: TrainState,
    run_dir: Path,
    checkpoints: Checkpoints,
    *,
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

    def save() -> None:
        checkpoints.save(done * program.env_steps_per_epoch, state, program.config, success=records.success or 0.0)

    trace = Profile(run_dir / "profile", first=profile[0], epochs=profile[1], say=display.say, warn=display.warn)
    with Sinks(run_dir, program.config, records.rows, warn=display.warn, muted=not devices.first()) as others:
        with display, trace, interruptible(display.stop) as interrupted:
            while done < program.epochs and fault is None and not devices.anywhere(interrupted()):
                trace.before(done)
                with stopwatch.measure("epoch"):
                    state, metrics = program.epoch(state)
                    table = of_epoch(metrics, seeds)
                speed = program.env_steps_per_epoch * len(seeds) / stopwatch.last("epoch")
                done += 1
                trace.after(done)
                env_steps = done * program.env_steps_per_epoch
                fault = faults.find(table, state, env_steps=env_steps)
                if fault is None and (done % config.eval_every == 0 or done == program.epochs):
                    with stopwatch.measure("evaluation"):
                        evaluation.add_to(table, program.evaluate(state, program.evaluation_keys(done)))
                    records.add_regions(state, env_steps=env_steps)
                records.add(table, env_steps=env_steps, speed=speed)
                others.write(table)
                display.update(env_steps, table, left_s=stopwatch.left(_left(program, done)))
                if fault is None and (done % config.checkpoint_every == 0 or done == program.epochs):
                    with stopwatch.measure("checkpoint"):
                        save()
                    saved = done
            stopped = devices.anywhere(interrupted()) if fault else done < program.epochs
            if fault is None and saved != done:
                save()
        env_steps = done * program.env_steps_per_epoch
        known = records.regions and records.regions[-1]["env_steps"] == env_steps
        if fault is None and not known:  # stopped between evaluations
            records.add_regions(state, env_steps=env_steps, write=False)
        if devices.first():
            _draw(run_dir / "figures", records)
        others.figures(run_dir / "figures")
    steps = checkpoints.steps()
    return Result(run_dir, env_steps, stopped, records.success, fault, saved=steps[-1] if steps else None)


def _goes_back(program: Program, checkpoints: Checkpoints, journal: Journal, fault: Fault, console: Console) -> bool:
    """Whether the run goes back to its last checkpoint for a `fault`, which is said; written down it is anyway."""
    config, rolled = program.config.trainer, _rollbacks(journal)
    number = {seed: 1 + sum(row["seed"] == seed for row in rolled) for seed in fault.found}
    back = config.on_non_finite == "rollback" and all(n <= config.rollbacks for n in number.values())
    to = checkpoints.steps()[-1] if back else None
    devices.wait("all processes know of the faults before")
    for seed, found in fault.found.items():
        journal.faults.write({"env_steps": fault.env_steps, "seed": seed, "back_to": to, "found": found})
    devices.wait("the fault is in the journal")
    if back:
        whose = ", ".join(
            f"{config.rollback_factor**n:g} for seed {seed} ({n} of {config.rollbacks})" for seed, n in number.items()
        )
        line = f"warning: {fault}; back to {to:,} env steps, learning rates times {whose}"
        console.print(line, style="yellow", highlight=False, markup=False, soft_wrap=True)
    return back


def _slowed(program: Program, state: TrainState, journal: Journal) -> tuple[Program, TrainState]:
    """`program` and the restored `state` with the learning rates of seeds that were rolled back, each as often.

    Seeds have numbers of their own then, so that the others go on as if nothing had happened.
    """
    rolled, config = _rollbacks(journal), program.config.trainer
    if not rolled and config.on_non_finite == "stop":
        return program, state
    env_steps = _epochs(state) * program.env_steps_per_epoch

    def factors(rows: list[dict[str, Any]]) -> list[float]:
        return [config.rollback_factor ** sum(row["seed"] == seed for row in rows) for seed in program.seeds]

    agent = jax.tree.map(lambda x: np.full(len(program.seeds), x, np.float32), program.config.agent())
    # A step size that is part of the state was made smaller by the rollbacks before its checkpoint.
    since = [row for row in rolled if row["back_to"] >= env_steps]
    return replace(program, agent=faults.slower(agent, factors(rolled))), faults.slower(state, factors(since))


def _rollbacks(journal: Journal) -> list[dict[str, Any]]:
    return [row for row in journal.faults.read() if row["back_to"] is not None]


def _draw(folder: Path, records: _Records) -> None:
    rows, regions, walls = records.rows, records.regions, records.program.walls
    report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=walls)
    if regions:
        report.growth_figure(folder / "growth.png", regions=regions, walls=walls)
    if rows and records.program.config.sgim.enabled:
        report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=walls)


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


def _restore(program: Program, checkpoints: Checkpoints, journal: Journal) -> TrainState:
    steps, run_dir = checkpoints.steps(), journal.metrics.path.parent
    if not steps:
        raise ConfigError(f"{run_dir}: holds no checkpoint to resume from")
    state = checkpoint.restore(program, checkpoints, steps[-1], source=run_dir)
    for lines in (journal.metrics, journal.regions):
        lines.keep_until(steps[-1])
    devices.wait("the journal is that of the checkpoint")
    return state


def _prepare(run_dir: Path, config: Config) -> None:
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        raise ConfigError(
            f"{run_dir}: is not empty; choose another --run-dir, or go on with it: star train --resume {run_dir}"
        )
    devices.wait("the run directory is empty")
    if not devices.first():
        return
    try:
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
