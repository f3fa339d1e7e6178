"""A checked sweep file: the settings searched, the sampler and the measure."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Literal, Self, get_args

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from pydantic import Field, ValidationError, field_validator, model_validator

from envs.common.errors import shown
from star.config import kinds, shipped
from star.config.kinds import Kind, Measure
from star.config.loading import check_setting, explain, first_of, flat, load, parse, read_file, type_of
from star.config.run import RunConfig
from star.config.section import ConfigError, Group, Positive
from star.sweeps.ledger import product
from star.training import program as programs

_MAX_GRID = 100_000  # points


class Parameter(Group):
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

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values whose validity implies that of all others: all choices, or both ends of the range."""
        return (self.low, self.high) if self.choices is None else self.choices


class Sweep(Group):
    """A sweep file."""

    config: Path = Field(description="config file of all trials, from the folder of this file")
    layers: tuple[Path, ...] = Field((), alias="with", description="files laid over it")
    settings: dict[str, Any] = Field({}, description="dotted settings of all trials")
    parameters: dict[str, Parameter] = Field(min_length=1, description="dotted settings that are searched")
    sampler: Literal["tpe", "cmaes", "random", "grid"] = Field("tpe", description="who chooses")
    pruner: Literal["none", "asha", "hyperband", "median"] = Field("none", description="who stops hopeless trials")
    prune_after: Positive = Field(1, description="evaluations that every trial is given")
    objective: str | None = Field(None, description="the measure that decides; by default the first of the experiment")
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

    def check(self, model: type[RunConfig]) -> None:
        """Raise ValueError in one line if the sampler cannot choose among these values."""
        ranges = {key: one for key, one in self.parameters.items() if one.choices is None}
        for key, one in ranges.items():
            if self.sampler == "grid" and (type_of(key, model) is not int or one.log):
                raise ValueError(f"parameters.{key}: sampler grid needs choices, or a range of whole numbers")
        if self.sampler == "cmaes" and (len(ranges) < 2 or len(ranges) < len(self.parameters)):
            raise ValueError("sampler: cmaes needs two or more parameters, all with low and high")


@dataclass(frozen=True)
class Plan:
    """A sweep that has been checked. `evaluations` is how many a trial has."""

    name: str
    file: Sweep
    base: Any
    distributions: dict[str, BaseDistribution]
    evaluations: int

    @property
    def kind(self) -> Kind:
        """That of its experiment."""
        return kinds.of(self.base)

    @property
    def measure(self) -> Measure:
        """The measure that ranks trials."""
        return next(one for one in self.kind.measures if self.file.objective in (None, one.name))

    @property
    def objective(self) -> str:
        """The same, in words."""
        return self.measure.name + (", mean of all evaluations" if self.file.summary == "mean" else "")

    @property
    def description(self) -> dict[str, Any]:
        """The part that workers of one study must have in common. Number of trials and machine may differ."""
        values = self.base.model_dump(mode="json", exclude={"env": {"engine"}, "trainer": {"device", "devices"}})
        about = self.file.model_dump(mode="json", include={"parameters", "sampler", "pruner", "prune_after", "summary"})
        return about | {"objective": self.measure.name, "settings": values}

    @property
    def grid(self) -> list[dict[str, Any]] | None:
        """Every point, if it is a grid."""
        if self.file.sampler != "grid":
            return None
        return product({key: points(one) for key, one in self.distributions.items()})

    @property
    def trials(self) -> int:
        """Their wanted number."""
        return self.file.trials if self.grid is None else min(self.file.trials, len(self.grid))

    def config(self, parameters: Mapping[str, Any]) -> Any:
        """That of a trial; raises `UserError` if these values do not go together."""
        return parse(self.base.model_dump(mode="json"), self.values(parameters), source="trial", typed="trial")

    def values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Settings from what Optuna calls the parameters of a trial."""
        found = {}
        for key, value in parameters.items():
            choices = self.file.parameters[key].choices
            found[key] = value if choices is None else choices[[_label(one) for one in choices].index(value)]
        return found


def plan(path: Path, *, settings: Mapping[str, Any] | None = None, **changes: Any) -> Plan:
    """Read and check a sweep file, a path or the name of one that comes with the package; raises `UserError`.

    `settings` are laid over those of all trials, and `changes`, such as `trials=8`, over the file's own fields.
    """
    path = shipped.find(path)
    values = read_file(path)
    if values and not {"config", "parameters"} & set(values):
        raise ConfigError(f"{path}: is no sweep file, which has config: and parameters:; a config is for star train")
    try:
        sweep = Sweep.model_validate(values | changes)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(first_of(error), Sweep)}") from None
    folder = path.parent
    base = load(
        shipped.find(sweep.config, beside=folder),
        flat(sweep.settings),
        layers=[shipped.find(layer, beside=folder) for layer in sweep.layers],
        typed=f"{path}: settings",
    )
    base = parse(base.model_dump(mode="json"), settings, source=str(path))
    try:
        sweep.check(type(base))
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    names = [measure.name for measure in kinds.of(base).measures]
    if sweep.objective not in (None, *names):
        raise ConfigError(f"{path}: objective: {shown(sweep.objective)} is not allowed: should be {' or '.join(names)}")
    if base.trainer.devices > 1 or "trainer.devices" in sweep.parameters:
        raise ConfigError(f"{path}: trainer.devices: a sweep trains on 1; start a worker for each device, with --out")
    for key, parameter in sweep.parameters.items():
        for value in parameter.ends:
            check_setting(base, key, value, source=f"{path}: parameters")
            if key.startswith("env."):
                programs.build(parse(base.model_dump(mode="json"), {key: value}, typed=f"{path}: parameters"))
    program = programs.build(base)
    evaluations = -(-program.epochs // base.trainer.eval_every)
    distributions = {
        key: _distribution(key, one, type_of(key, type(base)), source=path) for key, one in sweep.parameters.items()
    }
    if sweep.sampler == "grid" and prod(len(points(one)) for one in distributions.values()) > _MAX_GRID:
        raise ConfigError(f"{path}: parameters: make a grid of more than {_MAX_GRID:,} points")
    return Plan(sweep.study or path.stem, sweep, base, distributions, evaluations)


def _label(value: Any) -> Any:
    """A choice as Optuna can store it."""
    return value if value is None or isinstance(value, bool | int | float | str) else json.dumps(value)


def points(distribution: BaseDistribution) -> Sequence[Any]:
    """The values of a parameter of a grid."""
    if isinstance(distribution, IntDistribution):
        return range(distribution.low, distribution.high + 1, distribution.step)
    assert isinstance(distribution, CategoricalDistribution)
    return distribution.choices


def _distribution(key: str, one: Parameter, of: Any, *, source: Path) -> BaseDistribution:
    if one.choices is not None:
        return CategoricalDistribution([_label(choice) for choice in one.choices])
    assert one.low is not None and one.high is not None
    whole = of is int or (of is None and isinstance(one.low, int) and isinstance(one.high, int))
    if not whole and float not in (of, *get_args(of)) and of is not None:
        raise ConfigError(f"{source}: parameters.{key}: has no range, give choices")
    if whole:
        return IntDistribution(int(one.low), int(one.high), log=one.log, step=one.step or 1)
    if one.step:
        raise ConfigError(f"{source}: parameters.{key}.step: {one.step} is not allowed: the setting is no whole number")
    return FloatDistribution(float(one.low), float(one.high), log=one.log)
