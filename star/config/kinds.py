"""Kinds of experiments: `experiment` in a config names one, `star` or `module:name` of a user's own.

A kind says what an experiment is called and how it is measured, and makes it from a config; the functions of the
experiment itself are those of `star.training.experiment.Experiment`.
"""

from __future__ import annotations

import difflib
import importlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from envs.common import plugins
from envs.common.errors import UserError, shown
from star.config.run import RunConfig
from star.config.section import ConfigError

OURS: Mapping[str, str] = {
    "star": "star.agent.kind:STAR",
    "saht": "star.saht.kind:SAHT",
    "tutoring": "star.tutoring.kind:TUTORING",
    "chime": "star.saht.chime.kind:CHIME",
}
"""The experiments of this package, imported when they are first needed."""

About = dict[str, Any]
"""A checkpoint's words about itself: `format`, `config` (nested, as in `config.yaml`), the first measure, and more."""
Arrays = dict[str, np.ndarray]
"""A state by the names of its leaves, such as `tutor/params/actor/...`; the leading axis is that of seeds."""


class Measure(NamedTuple):
    """A measure of evaluations: in rows it is called `eval/<name>`."""

    name: str
    better: Literal["high", "low"] = "high"
    label: str = ""
    """The name for people, such as `success at the last step`; the name if it is empty."""
    where: str = ""
    """The place of measurement, in words, such as `on test goals`."""
    episodes: Callable[[Any], int] | None = None
    """Of a share in [0, 1]: how many episodes of each seed it is a share of, from the config."""

    @property
    def key(self) -> str:
        """That of rows of metrics."""
        return f"eval/{self.name}"

    def rank(self, value: float | None) -> float:
        """The higher, the better; what was not measured is worst."""
        if value is None or math.isnan(value):
            return -math.inf
        return value if self.better == "high" else -value


@dataclass(frozen=True)
class Migration:
    """From one format of checkpoints to the next: what they say of themselves, and their arrays."""

    about: Callable[[About], About] = lambda about: about
    arrays: Callable[[Arrays], Arrays] = lambda arrays: arrays


class Notices(NamedTuple):
    """Notices of a run for a person, while it goes on and when it is over."""

    keys: tuple[str, ...] = ()
    """The metrics that it is drawn from."""
    lines: Callable[[Sequence[Mapping[str, Any]]], Mapping[str, str]] = lambda rows: {}
    """From the rows of one seed so far, of which only `env_steps` and the `keys` are read: lines by their subjects."""


class Kind(NamedTuple):
    """A kind of experiment."""

    Config: type[RunConfig]
    """Its settings; `trainer` and `experiment` are among them."""
    build: Callable[[Any], Any]
    """Makes the `Experiment` of a config; raises `UserError` if it cannot be made on this machine."""
    measures: tuple[Measure, ...]
    """The measures of its evaluations; checkpoints and sweeps rank by the first."""
    title: Callable[[Any], str] = lambda config: config.experiment
    """The experiment's name for people."""
    agent: Callable[[Any], str] = lambda config: ""
    """The learner's name for people, in a list of runs."""
    unit: str = "iterations"
    """The unit that `env_steps` counts, in words."""
    in_step: bool = False
    """True if all seeds share a counter: a sweep then begins no trial among others that have begun."""
    tables: str = "tables"
    """Name of the tables written at each evaluation besides metrics, to `<tables>.jsonl`."""
    row: Mapping[str, type] = {}
    """The keys of such a row, and what their values are."""
    may_be_nan: tuple[str, ...] = ()
    """Names of parts of the state that may be NaN or infinite, and of metrics that count what is no fault."""
    notices: Notices = Notices()
    """Notices given once for each seed and subject, and shown in the report."""
    levels: Mapping[str, tuple[str | None, str | None, str | None]] = {}
    """Rows of the console: the metrics of reward, actor loss and critic loss of each level."""
    format: int = 1
    """Of its checkpoints."""
    migrations: Mapping[int, Migration] = {}
    """For each older format how to make the next one of it."""
    harmless: tuple[str, ...] = ()
    """Beginnings of settings that may differ when a run goes on, besides numbers and those of `trainer`."""
    older: Mapping[str, Any] = {}
    """Values of settings in runs that are older than these and do not name them, where they are not the defaults."""
    gone: Sequence[str] = ()
    """Settings that older runs name and that are no more."""
    anywhere: Mapping[str, Any] = {}
    """Settings of agents that act on another machine than that of their training."""
    pictures: tuple[str, ...] = ()
    """The names of figures that the report shows as they were drawn."""
    commands: Mapping[str, Callable[..., Any]] = {}
    """Its own `evaluate`, `render`, `record`; `envs`, the names of what can be learnt; `map`, what the report draws of
    its tables; and, for programs, `measure`, the rows of `star.evaluate`, and `load`, the agent of `star.load`."""

    def readable(self, number: Any) -> bool:
        """True if checkpoints of the format `number` can be read."""
        return number == self.format or number in self.migrations

    def migrated(self, about: About) -> About:
        """`about` as of this `format`."""
        for number in range(about["format"], self.format):
            about = self.migrations[number].about(about) | {"format": number + 1}
        return about

    def migrated_arrays(self, arrays: Arrays, number: int) -> Arrays:
        """`arrays` of the format `number` as of this `format`."""
        for each in range(number, self.format):
            arrays = self.migrations[each].arrays(arrays)
        return arrays


def find(name: Any) -> Kind:
    """The kind that a config's `experiment` names.

    Raises:
      UserError: in one line, if there is none, or it cannot be used.
    """
    if plugins.is_plugin(name):
        try:
            return _checked(plugins.find(name, Kind))
        except UserError as error:
            raise ConfigError(f"experiment: {name}: {error}") from None
    if not isinstance(name, str) or name not in OURS:
        near = difflib.get_close_matches(str(name), OURS, n=1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ConfigError(
            f"experiment: {shown(name)} is not allowed: should be {', '.join(OURS)} or module:name{meant}"
        )
    module, _, attribute = OURS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def lazily(name: str) -> Callable[..., Any]:
    """The function `name` (`module:name`) of this package, whose module is imported when it is first called."""
    module, _, attribute = name.partition(":")
    return lambda *args, **kwargs: getattr(importlib.import_module(module), attribute)(*args, **kwargs)


def places() -> dict[str, list[str]]:
    """The subjects of this package's experiments: the tasks or worlds of each, by its name."""
    return {name: commands["envs"]() for name in OURS if "envs" in (commands := find(name).commands)}


def of(config: RunConfig) -> Kind:
    """That of a config."""
    return find(config.experiment)


def _checked(kind: Kind) -> Kind:
    """`kind`, if its parts are what they should be; raises `UserError`."""
    if not (isinstance(kind.Config, type) and issubclass(kind.Config, RunConfig)):
        raise ConfigError(f"Config is {shown(kind.Config)}; allowed: a subclass of star.config.run.RunConfig")
    if not callable(kind.build):
        raise ConfigError(f"build is {shown(kind.build)}; allowed: a function from a config to an experiment")
    if not kind.measures or not all(isinstance(one, Measure) for one in kind.measures):
        raise ConfigError(f"measures is {shown(kind.measures)}; allowed: one star.config.kinds.Measure or more")
    return kind
