"""Sweeps: many trials of one experiment, their settings chosen by Optuna, trained side by side where they can be.

    work(sweep, ledger):
        take trials; those of one structure begin together, each in a slot of one program
        repeat an epoch of all slots                          # star/training/side_by_side.py
            report evaluations; end trials that are finished, pruned or broken
            a slot that is free takes the next trial of its structure
        until the study has all its trials

Any number of workers do this with one study (star/sweeps/ledger.py).
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

from optuna import pruners, samplers
from optuna.study import get_all_study_names
from optuna.trial import FrozenTrial, Trial, TrialState
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envs.common import files
from envs.common.errors import UserError
from star.config.kinds import Measure
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.sweeps import results
from star.sweeps.ledger import MEASURED, Cmaes, Holding, Ledger, reachable, reason, sqlite_url
from star.sweeps.plan import Plan, Sweep
from star.training import faults
from star.training import program as programs
from star.training.console import Elapsed
from star.training.journal import mean
from star.training.side_by_side import SideBySide
from star.training.signals import interruptible

_WAIT_S = 2.0  # between looks at what other workers do


class Bench(Protocol):
    """The trainer of a batch of trials: `star.training.side_by_side.SideBySide`."""

    slots: int
    epochs: int
    steps_per_epoch: int

    def put(self, runs: Mapping[int, RunConfig]) -> None:
        """Begin new runs in these slots."""

    def advance(self) -> list[list[dict[str, Any]]]:
        """Train all slots for an epoch: metrics of each seed, for each slot."""


def open_ledger(found: Plan, url: str, *, beat_s: int = 15, grace_s: int = 90) -> Ledger:
    """The study of a sweep in the database at `url`; raises `UserError`."""
    return Ledger(
        url,
        found.name,
        description=found.description,
        sampler=lambda seed: _sampler(found.file, seed),
        pruner=_pruner(found),
        grid=found.grid,
        lower_is_better=found.measure.better == "low",
        beat_s=beat_s,
        grace_s=grace_s,
    )


def _check_alone(found: Plan, out: Path, url: str) -> None:
    for name in get_all_study_names(url):
        if name != found.name:
            raise ConfigError(f"{out}: holds the results of the sweep {name}; choose another --out")


def run(
    found: Plan, out: Path, *, storage: str | None = None, quiet: bool = False, console: Console | None = None
) -> Summary:
    """Work on a sweep until all its trials have ended and write the results to `out`.

    Without a `storage` the database is `sweep.db` in `out`. A sweep that is there already goes on.
    Raises `UserError` for what cannot be used.
    """
    files.check_name(out)
    database = out / "sweep.db"
    if storage is None and not database.exists() and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: is not empty and holds no sweep.db to go on with; choose another --out")
    if storage is None:
        _make(out)
    url = storage or sqlite_url(database)
    with reachable(url):
        if storage is None:
            _check_alone(found, out, url)
        ledger = open_ledger(found, url)
        _make(out)
        with closing(ledger):
            finished = work(found, ledger, quiet=quiet, console=console)
            trials, shares = ledger.trials(), results.importance(ledger.study)
    rows = [_row(found, trial) for trial in trials]
    best = _best(rows, found.measure)
    results.write(out, rows, found, shares=shares)
    if best is not None:
        with files.whole(out / "best.yaml") as path:
            path.write_text(found.config(trials[rows.index(best)].params).to_yaml(), encoding="utf-8")
    return Summary(rows, finished, best)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written: {error.strerror}") from None


def work(
    found: Plan,
    ledger: Ledger,
    *,
    make: Callable[[RunConfig, int], Bench] = SideBySide,
    quiet: bool = True,
    console: Console | None = None,
) -> bool:
    """Run trials until the study has ended all of them; False if interrupted. `make` builds what trains a batch."""
    display = _Display(console or Console(stderr=True), found.trials, quiet=quiet)
    with display, interruptible() as interrupted, ledger.holding() as holding:
        worker = _Worker(found, ledger, holding, make, display, interrupted)
        try:
            while not interrupted():
                worker.take()
                if worker.queue:
                    worker.run_batch()
                elif worker.others_at_work():
                    time.sleep(_WAIT_S)
                else:
                    return True
            return False
        finally:
            ledger.give_back(list(holding.trials.values()), "interrupted")


@dataclass(frozen=True)
class Summary:
    """State of a sweep: a row for each trial, whether all have ended, and the row of the best."""

    rows: list[dict[str, Any]]
    finished: bool
    best: dict[str, Any] | None


@dataclass
class _Run:
    """A trial that this process has."""

    trial: Trial
    config: Any
    evaluations: dict[str, list[float]]
    epochs: int = 0


@dataclass
class _Worker:
    """The trials of one process: those that train, and those that wait in its `queue`."""

    found: Plan
    ledger: Ledger
    holding: Holding
    make: Callable[[RunConfig, int], Bench]
    display: _Display
    interrupted: Callable[[], bool]
    name: str = field(default_factory=lambda: f"{platform.node()}:{os.getpid()}")
    queue: list[_Run] = field(default_factory=list)

    def take(self) -> None:
        """Ask for as many trials as a batch has room for."""
        room = self.found.file.batch - len(self.holding.trials)
        asked = self.ledger.take(self.found.distributions, room, limit=self.found.trials, worker=self.name)
        self.holding.add(asked)
        for trial in asked:
            try:
                measured: dict[str, list[float]] = {measure.name: [] for measure in self.found.kind.measures}
                self.queue.append(_Run(trial, self.found.config(trial.params), measured))
            except UserError as error:
                self._end(trial, None, reason=str(error))

    def others_at_work(self) -> bool:
        """True if the study has trials that have not ended."""
        states = [trial.state for trial in self.ledger.trials()]
        self.display.update(ended=sum(state.is_finished() for state in states), status="waiting for other workers")
        return not all(state.is_finished() for state in states)

    def run_batch(self) -> None:
        """Train the queued trials that have the structure of the first, and such as come until there are too few."""
        shared = programs.structure(self.queue[0].config)
        slots = dict(enumerate(self._from_queue(shared)))
        self.display.update(status=f"compiling for {len(slots)} trials side by side", timed=True)
        try:
            self._train(self.make(slots[0].config, len(slots)), slots, shared)
        except UserError as error:
            self._fail(slots, str(error))
        except (RuntimeError, MemoryError) as error:  # such as no memory left on the device
            self._fail(slots, f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")

    def _train(self, bench: Bench, slots: dict[int, _Run], shared: str) -> None:
        """Fill, train and empty the slots; `slots` always holds what is in them."""
        bench.put({slot: one.config for slot, one in slots.items()})
        while slots and not self.interrupted():
            began = time.monotonic()
            rows = bench.advance()
            steps = len(slots) * bench.steps_per_epoch
            evaluated = [slot for slot, one in slots.items() if self._record(one, rows[slot])]
            # All have reported before any is pruned, and the best are asked first: a pruner compares with earlier ones.
            for slot in sorted(slots, key=lambda slot: self._rank(slots[slot]), reverse=True):
                if self._is_over(slots[slot], rows[slot], bench.epochs, evaluated=slot in evaluated):
                    del slots[slot]
            speed = steps / (time.monotonic() - began)
            if len(slots) < bench.slots:
                self._refill(bench, slots, shared)
            under_way = sum(one.epochs for one in slots.values()) / bench.epochs
            self.display.update(
                under_way=under_way, status=f"{len(slots)} running  {speed:,.0f} {self.found.kind.unit}/s"
            )

    def _refill(self, bench: Bench, slots: dict[int, _Run], shared: str) -> None:
        """Put queued trials into empty slots; but a few alone had better have a program of their own size.

        Trials that share a counter begin together.
        """
        if self.found.kind.in_step and slots:
            return
        self.take()
        free = [slot for slot in range(bench.slots) if slot not in slots]
        fitting = [one for one in self.queue if programs.structure(one.config) == shared]
        if not slots and 2 * len(fitting) < bench.slots:
            return
        new = dict(zip(free, self._from_queue(shared, at_most=len(free)), strict=False))
        if new:
            bench.put({slot: one.config for slot, one in new.items()})
            slots.update(new)

    def _record(self, one: _Run, rows: Sequence[Mapping[str, Any]]) -> bool:
        """Take in an epoch of a trial and report an evaluation to Optuna; whether there was one."""
        one.epochs += 1
        if mean(rows, self.found.measure.key) is None:
            return False
        for name, values in one.evaluations.items():
            value = mean(rows, f"eval/{name}")
            if value is not None:
                values.append(value)
        self.ledger.report(one.trial, self._value(one), len(one.evaluations[self.found.measure.name]))
        return True

    def _is_over(self, one: _Run, rows: Sequence[Mapping[str, Any]], epochs: int, *, evaluated: bool) -> bool:
        kind = self.found.kind
        broken = next((told for row in rows for told in faults.broken(row, may_be_nan=kind.may_be_nan).values()), None)
        measured = {name: values[-1] for name, values in one.evaluations.items() if values}
        measured |= {"env_steps": rows[0]["env_steps"]}
        if broken is not None:
            reason = f"{broken} at {rows[0]['env_steps']:,} {kind.unit}"
            self._end(one.trial, None, reason=reason, measured=measured)
        elif one.epochs >= epochs:
            self._end(one.trial, self._value(one), measured=measured)
        elif evaluated and one.trial.should_prune():
            self._end(one.trial, None, pruned=True, measured=measured)
        else:
            return False
        return True

    def _value(self, one: _Run) -> float:
        """The trial's score so far; raises IndexError before its first evaluation."""
        values = one.evaluations[self.found.measure.name]
        return values[-1] if self.found.file.summary == "end" else sum(values) / len(values)

    def _rank(self, one: _Run) -> float:
        """The higher, the better; a trial that was never evaluated is worst."""
        measure = self.found.measure
        return measure.rank(self._value(one) if one.evaluations[measure.name] else None)

    def _from_queue(self, shared: str, at_most: int | None = None) -> list[_Run]:
        """Take trials of this structure out of the queue."""
        taken = [one for one in self.queue if programs.structure(one.config) == shared][:at_most]
        self.queue = [one for one in self.queue if one not in taken]
        return taken

    def _fail(self, slots: Mapping[int, _Run], reason: str) -> None:
        for one in slots.values():
            self._end(one.trial, None, reason=reason)

    def _end(self, trial: Trial, value: float | None, **how: Any) -> None:
        self.ledger.end(trial, value, **how)
        self.holding.drop(trial)
        self.display.update(ended=sum(one.state.is_finished() for one in self.ledger.trials()))


class _Display:
    """A bar with the trials that have ended, on a terminal; nothing elsewhere."""

    def __init__(self, console: Console, trials: int, *, quiet: bool) -> None:
        self._progress = Progress(
            TextColumn("trials"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            Elapsed(),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._ended, self._under_way, self._status = 0, 0.0, ""
        self._since: float | None = None
        self._task = self._progress.add_task("", total=trials, status="", since=None)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(
        self,
        *,
        ended: int | None = None,
        under_way: float | None = None,
        status: str | None = None,
        timed: bool = False,
    ) -> None:
        """Show how many trials have ended and how many more those under way make, in parts of a trial.

        Beside a `timed` status stands the time since it began.
        """
        self._ended = self._ended if ended is None else ended
        self._under_way = self._under_way if under_way is None else under_way
        if status is not None:
            self._status, self._since = status, time.monotonic() if timed else None
        completed = self._ended + self._under_way
        self._progress.update(self._task, completed=completed, status=self._status, since=self._since)


def _row(found: Plan, trial: FrozenTrial) -> dict[str, Any]:
    """A trial as a row of the table."""
    state = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}
    names = [measure.name for measure in found.kind.measures]
    measured = dict.fromkeys((*names, "env_steps")) | trial.user_attrs.get(MEASURED, {})
    seconds = None if trial.duration is None else round(trial.duration.total_seconds(), 1)
    about = {"trial": trial.number, "state": state.get(trial.state, "unfinished"), "value": trial.value}
    return about | found.values(trial.params) | measured | {"wall_s": seconds, "reason": reason(trial)}


def _best(rows: Sequence[dict[str, Any]], measure: Measure) -> dict[str, Any] | None:
    """The first of the best complete trials."""
    complete = [row for row in rows if row["state"] == "complete"]
    return max(complete, key=lambda row: measure.rank(row["value"]), default=None)


def _sampler(file: Sweep, seed: int) -> samplers.BaseSampler:
    if file.sampler == "tpe":
        return samplers.TPESampler(seed=seed)
    if file.sampler == "cmaes":
        return Cmaes(seed=seed)
    return samplers.RandomSampler(seed=seed)  # a grid draws nothing


def _pruner(found: Plan) -> pruners.BasePruner:
    """Optuna's; its steps are evaluations."""
    least, most = found.file.prune_after, found.evaluations
    if found.file.pruner == "asha":
        return pruners.SuccessiveHalvingPruner(min_resource=least, reduction_factor=3)
    if found.file.pruner == "hyperband":
        return pruners.HyperbandPruner(min_resource=least, max_resource=max(most, least), reduction_factor=3)
    if found.file.pruner == "median":
        return pruners.MedianPruner(n_warmup_steps=least)
    return pruners.NopPruner()
