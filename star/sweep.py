"""Sweeps: many trials of one experiment, their settings chosen by Optuna, trained side by side where they can be.

    work(sweep, ledger):
        take trials; those of one structure begin together, each in a slot of one program
        repeat an epoch of all slots                          # star/side_by_side.py
            report evaluations; end trials that are finished, pruned or broken
            a slot that is free takes the next trial of its structure
        until the study has all its trials

Any number of workers do this with one study (star/study.py).
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any, Literal, Protocol, Self, get_args

from optuna import pruners, samplers
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.study import get_all_study_names
from optuna.trial import FrozenTrial, Trial, TrialState
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from envs.common import files
from envs.common.errors import UserError, shown
from star import faults, sweep_report
from star import program as programs
from star.agent.sections import Config
from star.config.section import ConfigError, Positive
from star.loading import check_setting, explain, kind, load, parse, read_file
from star.metrics import mean
from star.side_by_side import SideBySide
from star.stopping import interruptible
from star.study import MEASURED, Cmaes, Holding, Ledger, product, reachable, reason, sqlite_url

_MAX_GRID = 100_000  # points
_WAIT_S = 2.0  # between looks at what other workers do
_MEASURES = ("success_any", "success_final")


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Parameter(_Model):
    """The values of one setting that are tried: `choices`, or a range. A list is short for choices."""

    choices: tuple[Any, ...] | None = Field(None, description="values to choose from")
    low: int | float | None = Field(None, description="lowest value of a range")
    high: int | float | None = Field(None, description="highest value of a range")
    log: bool = Field(False, description="draw from the range evenly in the logarithm")
    step: Positive | None = Field(None, description="of a range of whole numbers")

    @model_validator(mode="after")
    def _choices_or_range(self) -> Self:
        if (self.choices is None) == (self.low is None and self.high is None):
            raise ValueError("should have either choices or low and high")
        if self.choices is not None:
            if not self.choices:
                raise ValueError("has no values to choose from")
            if self.log or self.step:
                raise ValueError("log and step belong to a range, not to choices")
            return self
        if self.low is None or self.high is None:
            raise ValueError("should have both low and high")
        if self.low > self.high:
            raise ValueError(f"low {shown(self.low)} is above high {shown(self.high)}")
        if self.log and self.low <= 0:
            raise ValueError(f"low {shown(self.low)} is not above 0, as log needs")
        if self.log and self.step:
            raise ValueError("log and step exclude one another")
        return self

    def as_numbers(self) -> Parameter:
        """With choices like "1e-3" as the number they say."""
        try:
            return self.model_copy(update={"choices": self.choices and tuple(float(one) for one in self.choices)})
        except (TypeError, ValueError):  # said better by the setting itself
            return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """What must be allowed for everything else to be: all choices, or both ends of the range."""
        return (self.low, self.high) if self.choices is None else self.choices


class Sweep(_Model):
    """A sweep file."""

    config: Path = Field(description="config file of all trials, from the folder of this file")
    layers: tuple[Path, ...] = Field((), alias="with", description="files laid over it")
    settings: dict[str, Any] = Field({}, description="dotted settings of all trials")
    parameters: dict[str, Parameter] = Field(min_length=1, description="dotted settings that are searched")
    sampler: Literal["tpe", "cmaes", "random", "grid"] = Field("tpe", description="who chooses")
    pruner: Literal["none", "asha", "hyperband", "median"] = Field("none", description="who stops hopeless trials")
    prune_after: Positive = Field(1, description="evaluations that every trial is given")
    objective: Literal["success_any", "success_final"] = Field("success_final", description="what is maximised")
    summary: Literal["end", "mean"] = Field("end", description="its value at the end, or the mean of all evaluations")
    trials: Positive = Field(32, description="how many; a grid has no more than its points")
    batch: Positive = Field(32, description="trials side by side at most")
    study: str | None = Field(None, min_length=1, description="name in the database; by default that of the file")

    @field_validator("parameters", mode="before")
    @classmethod
    def _lists_are_choices(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        return {key: {"choices": one} if isinstance(one, list) else one for key, one in value.items()}

    @field_validator("parameters")
    @classmethod
    def _numbers_are_numbers(cls, value: dict[str, Parameter]) -> dict[str, Parameter]:
        """YAML reads 1e-3 as text; that of a number is one."""
        return {key: one.as_numbers() if kind(key) is float else one for key, one in value.items()}

    @model_validator(mode="after")
    def _sampler_fits(self) -> Self:
        ranges = [key for key, one in self.parameters.items() if one.choices is None]
        for key in ranges:
            if self.sampler == "grid" and (kind(key) is not int or self.parameters[key].log):
                raise ValueError(f"parameters.{key}: sampler grid needs choices, or a range of whole numbers")
        if self.sampler == "cmaes" and (len(ranges) < 2 or len(ranges) < len(self.parameters)):
            raise ValueError("sampler: cmaes needs two or more parameters, all with low and high")
        return self


class Bench(Protocol):
    """What trains a batch of trials: `star.side_by_side.SideBySide`."""

    slots: int
    epochs: int
    env_steps_per_epoch: int

    def put(self, runs: Mapping[int, Config]) -> None:
        """Begin new runs in these slots."""

    def advance(self) -> list[list[dict[str, Any]]]:
        """Train all slots for an epoch: metrics of each seed, for each slot."""


@dataclass(frozen=True)
class Plan:
    """A sweep that has been checked. `evaluations` is how many a trial has."""

    name: str
    file: Sweep
    base: Config
    distributions: dict[str, BaseDistribution]
    evaluations: int

    @property
    def objective(self) -> str:
        """What is maximised, in words."""
        return self.file.objective + (", mean of all evaluations" if self.file.summary == "mean" else "")

    @property
    def description(self) -> dict[str, Any]:
        """What must be equal for workers to share a study. How many trials, and on what machine, may differ."""
        values = self.base.model_dump(mode="json", exclude={"env": {"engine"}, "trainer": {"device", "devices"}})
        about = self.file.model_dump(
            mode="json", include={"parameters", "sampler", "pruner", "prune_after", "objective", "summary"}
        )
        return about | {"settings": values}

    @property
    def grid(self) -> list[dict[str, Any]] | None:
        """Every point, if it is a grid."""
        if self.file.sampler != "grid":
            return None
        return product({key: _points(one) for key, one in self.distributions.items()})

    @property
    def trials(self) -> int:
        """How many there are to be."""
        return self.file.trials if self.grid is None else min(self.file.trials, len(self.grid))

    def config(self, parameters: Mapping[str, Any]) -> Config:
        """That of a trial; raises `UserError` if these values do not go together."""
        return parse(self.base.model_dump(mode="json"), self.values(parameters), source="trial")

    def values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Settings from what Optuna calls the parameters of a trial."""
        found = {}
        for key, value in parameters.items():
            choices = self.file.parameters[key].choices
            found[key] = value if choices is None else choices[[_label(one) for one in choices].index(value)]
        return found


def plan(path: Path, *, settings: Mapping[str, Any] | None = None, **changes: Any) -> Plan:
    """Read and check a sweep file; raises `UserError`.

    `settings` are laid over those of all trials, and `changes`, such as `trials=8`, over the file's own fields.
    """
    try:
        sweep = Sweep.model_validate(read_file(path) | changes)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error.errors()[0], Sweep)}") from None
    folder = path.parent
    base = load(
        folder / sweep.config, sweep.settings | dict(settings or {}), layers=[folder / layer for layer in sweep.layers]
    )
    if base.trainer.devices > 1 or "trainer.devices" in sweep.parameters:
        raise ConfigError(f"{path}: trainer.devices: a sweep trains on 1; start a worker for each device, with --out")
    for key, parameter in sweep.parameters.items():
        for value in parameter.ends:
            check_setting(base, key, value, source=f"{path}: parameters")
            if key.startswith("env."):
                programs.build(parse(base.model_dump(mode="json"), {key: value}, source=f"{path}: parameters"))
    program = programs.build(base)
    evaluations = -(-program.epochs // base.trainer.eval_every)
    distributions = {key: _distribution(key, one, source=path) for key, one in sweep.parameters.items()}
    if sweep.sampler == "grid" and prod(len(_points(one)) for one in distributions.values()) > _MAX_GRID:
        raise ConfigError(f"{path}: parameters: make a grid of more than {_MAX_GRID:,} points")
    return Plan(sweep.study or path.stem, sweep, base, distributions, evaluations)


def open_ledger(found: Plan, url: str, *, beat_s: int = 15, grace_s: int = 90) -> Ledger:
    """The study of a sweep in the database at `url`; raises `UserError`."""
    return Ledger(
        url,
        found.name,
        description=found.description,
        sampler=lambda seed: _sampler(found.file, seed),
        pruner=_pruner(found),
        grid=found.grid,
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
            trials, shares = ledger.trials(), sweep_report.importance(ledger.study)
    rows = [_row(found, trial) for trial in trials]
    best = _best(rows)
    sweep_report.write(out, rows, parameters=list(found.distributions), objective=found.objective, shares=shares)
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
    make: Callable[[Config, int], Bench] = SideBySide,
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
    """How a sweep stands: a row for each trial, whether all have ended, and the row of the best."""

    rows: list[dict[str, Any]]
    finished: bool
    best: dict[str, Any] | None


@dataclass
class _Run:
    """A trial that this process has."""

    trial: Trial
    config: Config
    epochs: int = 0
    evaluations: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in _MEASURES})


@dataclass
class _Worker:
    """The trials of one process: those that train, and those that wait in its `queue`."""

    found: Plan
    ledger: Ledger
    holding: Holding
    make: Callable[[Config, int], Bench]
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
                self.queue.append(_Run(trial, self.found.config(trial.params)))
            except UserError as error:
                self._end(trial, None, reason=str(error))

    def others_at_work(self) -> bool:
        """Whether the study has trials that have not ended."""
        states = [trial.state for trial in self.ledger.trials()]
        self.display.update(ended=sum(state.is_finished() for state in states), status="waiting for other workers")
        return not all(state.is_finished() for state in states)

    def run_batch(self) -> None:
        """Train the queued trials that have the structure of the first, and such as come until there are too few."""
        shared = programs.structure(self.queue[0].config)
        slots = dict(enumerate(self._from_queue(shared)))
        self.display.update(status=f"compiling for {len(slots)} trials side by side")
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
            steps = len(slots) * bench.env_steps_per_epoch
            evaluated = [slot for slot, one in slots.items() if self._record(one, rows[slot])]
            # All have reported before any is pruned, and the best are asked first: a pruner compares with earlier ones.
            for slot in sorted(slots, key=lambda slot: self._value(slots[slot]), reverse=True):
                if self._is_over(slots[slot], rows[slot], bench.epochs, evaluated=slot in evaluated):
                    del slots[slot]
            speed = steps / (time.monotonic() - began)
            if len(slots) < bench.slots:
                self._refill(bench, slots, shared)
            under_way = sum(one.epochs for one in slots.values()) / bench.epochs
            self.display.update(under_way=under_way, status=f"{len(slots)} running  {speed:,.0f} env steps/s")

    def _refill(self, bench: Bench, slots: dict[int, _Run], shared: str) -> None:
        """Put queued trials into empty slots; but a few alone had better have a program of their own size."""
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
        for name, values in one.evaluations.items():
            value = mean(rows, f"eval/{name}")
            if value is None:
                return False
            values.append(value)
        self.ledger.report(one.trial, self._value(one), len(one.evaluations[self.found.file.objective]))
        return True

    def _is_over(self, one: _Run, rows: Sequence[Mapping[str, Any]], epochs: int, *, evaluated: bool) -> bool:
        broken = next((told for row in rows for told in faults.broken(row).values()), None)
        measured = {name: values[-1] for name, values in one.evaluations.items() if values}
        measured |= {"env_steps": rows[0]["env_steps"]}
        if broken is not None:
            reason = f"{broken} at {rows[0]['env_steps']:,} env steps"
            self._end(one.trial, None, reason=reason, measured=measured)
        elif one.epochs >= epochs:
            self._end(one.trial, self._value(one), measured=measured)
        elif evaluated and one.trial.should_prune():
            self._end(one.trial, None, pruned=True, measured=measured)
        else:
            return False
        return True

    def _value(self, one: _Run) -> float:
        values = one.evaluations[self.found.file.objective] or [0.0]
        return values[-1] if self.found.file.summary == "end" else sum(values) / len(values)

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
            TimeRemainingColumn(compact=True),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._ended, self._under_way, self._status = 0, 0.0, ""
        self._task = self._progress.add_task("", total=trials, status="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, *, ended: int | None = None, under_way: float | None = None, status: str | None = None) -> None:
        """Show how many trials have ended and how many more those under way make, in parts of a trial."""
        self._ended = self._ended if ended is None else ended
        self._under_way = self._under_way if under_way is None else under_way
        self._status = self._status if status is None else status
        self._progress.update(self._task, completed=self._ended + self._under_way, status=self._status)


def _row(found: Plan, trial: FrozenTrial) -> dict[str, Any]:
    """A trial as a row of the table."""
    state = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}
    measured = dict.fromkeys((*_MEASURES, "env_steps")) | trial.user_attrs.get(MEASURED, {})
    seconds = None if trial.duration is None else round(trial.duration.total_seconds(), 1)
    about = {"trial": trial.number, "state": state.get(trial.state, "unfinished"), "value": trial.value}
    return about | found.values(trial.params) | measured | {"wall_s": seconds, "reason": reason(trial)}


def _best(rows: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """The first of the complete trials with the highest value."""
    complete = [row for row in rows if row["state"] == "complete"]
    return max(complete, key=lambda row: row["value"], default=None)


def _label(value: Any) -> Any:
    """A choice as Optuna can store it."""
    return value if value is None or isinstance(value, bool | int | float | str) else json.dumps(value)


def _points(distribution: BaseDistribution) -> Sequence[Any]:
    if isinstance(distribution, IntDistribution):
        return range(distribution.low, distribution.high + 1, distribution.step)
    assert isinstance(distribution, CategoricalDistribution)
    return distribution.choices


def _distribution(key: str, one: Parameter, *, source: Path) -> BaseDistribution:
    if one.choices is not None:
        return CategoricalDistribution([_label(choice) for choice in one.choices])
    assert one.low is not None and one.high is not None
    of = kind(key)
    whole = of is int or (of is None and isinstance(one.low, int) and isinstance(one.high, int))
    if not whole and float not in (of, *get_args(of)) and of is not None:
        raise ConfigError(f"{source}: parameters.{key}: has no range, give choices")
    if whole:
        return IntDistribution(int(one.low), int(one.high), log=one.log, step=one.step or 1)
    if one.step:
        raise ConfigError(f"{source}: parameters.{key}.step: {one.step} is not allowed: the setting is no whole number")
    return FloatDistribution(float(one.low), float(one.high), log=one.log)


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
