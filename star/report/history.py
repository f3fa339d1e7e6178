"""Runs read from disk: rows of metrics and of tables, and their settings.

    read      one run, which may still be going on
    together  runs that differ in their seeds alone, as one

Content that no run writes is refused in one line.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from star.config import command_line, kinds
from star.config.loading import changed, dotted, load, parse
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.training.journal import Journal, JsonLines, by_step

NUMBER = (int, float)

Row = Mapping[str, Any]
Kinds = Mapping[str, type | tuple[type, ...]]
Stretch = tuple[int, Any]  # env steps at its beginning, and what was trained from there on

_OF_SEEDS = frozenset({"trainer.seed", "trainer.num_seeds"})
_METRICS: Kinds = {"seed": int, "env_steps": int, "wall_s": NUMBER, "env_steps_per_s": NUMBER}
_TABLES: Kinds = {"seed": int, "env_steps": int}
_PROVENANCE: Kinds = {
    "env_steps": int, "time": str, "device": str, "python": str, "versions": dict,
    "settings": (dict, type(None)),  # older runs did not note them
}  # fmt: skip
_TOTAL = "trainer.total_env_steps"


class NothingYet(ConfigError):
    """A run without a complete epoch."""


@dataclass(frozen=True)
class Run:
    """The content of a run, or of several `together`.

    `epochs` are the complete ones: a row for each seed, in the order of the seeds. `stretches` and `again`, the
    commands that train the same, have an entry for each of the `paths`.
    """

    paths: tuple[Path, ...]
    name: str
    config: Any
    epochs: list[list[Row]]
    tables: list[Row]
    starts: list[Row]
    stretches: list[list[Stretch]]
    again: list[str]

    @property
    def seeds(self) -> list[int]:
        """The seeds trained side by side."""
        return [row["seed"] for row in self.epochs[0]]

    @property
    def evaluations(self) -> list[list[Row]]:
        """The epochs in which the seeds were evaluated."""
        key = kinds.of(self.config).measures[0].key
        return [rows for rows in self.epochs if all(key in row for row in rows)]


def read(run_dir: Path, config: RunConfig, *, name: str) -> Run:
    """The complete lines of a run, which may still be going on.

    Raises:
      UserError: in one line, if there is no complete epoch yet, or a line is not what a run writes.
    """
    kind = kinds.of(config)
    journal = Journal.of(run_dir, tables=kind.tables)
    seeds = config.trainer.num_seeds
    epochs = _complete(_checked(journal.metrics, _METRICS), seeds)
    if not epochs:
        raise NothingYet(f"{run_dir}: its metrics.jsonl holds no complete epoch, so there is nothing to show yet")
    starts = _checked(journal.provenance, _PROVENANCE)
    stretches = _stretches(starts, config, source=str(journal.provenance.path))
    return Run(
        paths=(run_dir,),
        name=name,
        config=config,
        epochs=epochs,
        tables=[row for rows in _complete(_checked(journal.tables, {**_TABLES, **kind.row}), seeds) for row in rows],
        starts=starts,
        stretches=[stretches],
        again=[_again(run_dir, stretches)],
    )


def together(name: str, runs: Sequence[Run]) -> Run:
    """The seeds of several runs as those of one, as far as all have come.

    Raises:
      UserError: in one line, if they differ in more than their seeds, or two have trained the same seed.
    """
    for run in runs[1:]:
        differ = {row["key"] for row in differences([settings(runs[0]), settings(run)])} - _OF_SEEDS
        if differ:
            raise ConfigError(
                f"--group: {name}: {runs[0].paths[0]} and {run.paths[0]} differ in {min(differ)}; "
                f"allowed: the same settings but for {' and '.join(sorted(_OF_SEEDS))}"
            )
    seeds = [seed for run in runs for seed in run.seeds]
    for seed in seeds:
        if seeds.count(seed) > 1:
            raise ConfigError(f"--group: {name}: seed {seed} is in several of its runs; allowed: once")
    epochs = _complete([row for run in runs for epoch in run.epochs for row in epoch], len(seeds))
    if not epochs:
        raise ConfigError(f"--group: {name}: its runs have no epoch in common, so there is nothing to show yet")
    reached = epochs[-1][0]["env_steps"]
    return Run(
        paths=tuple(path for run in runs for path in run.paths),
        name=name,
        config=runs[0].config,
        epochs=epochs,
        tables=[row for run in runs for row in run.tables if row["env_steps"] <= reached],
        starts=[start for run in runs for start in run.starts],
        stretches=[stretches for run in runs for stretches in run.stretches],
        again=[command for run in runs for command in run.again],
    )


def _stretches(starts: Sequence[Row], config: RunConfig, *, source: str) -> list[Stretch]:
    """Provenance of each start of a run with this `config.yaml`.

    That is nothing if a later one went on from before it, or if all env steps were done already.
    """
    found: list[Stretch] = []
    for start in starts:
        began = start["env_steps"]
        used = parse(config.model_dump(mode="json"), start.get("settings"), source=source, typed=source)
        found = [*(stretch for stretch in found if stretch[0] < began), (began, used)]
    return [(began, used) for began, used in found if began < used.trainer.total_env_steps] or [(0, config)]


def _again(run_dir: Path, stretches: Sequence[Stretch]) -> str:
    """The command that trains a run with this `config.yaml` again, and one for each later change of its settings."""
    tables: list[dict[str, Any]] = []
    for began, used in stretches:
        table = dotted(used)
        if tables and not changed(tables[-1], table).keys() - {_TOTAL}:
            tables.pop()  # longer, but the same
        elif tables:
            tables[-1][_TOTAL] = began
        tables.append(table)
    copy = f"{run_dir}-again"
    commands = [["train", str(run_dir / "config.yaml"), "--run-dir", copy]]
    commands += [["train", "--resume", copy] for _ in tables[1:]]
    noted = [dotted(load(run_dir / "config.yaml"))] + [tables[0]] * (len(tables) - 1)
    for command, before, table in zip(commands, noted, tables, strict=True):
        command += [word for key, value in changed(before, table).items() for word in (f"--{key}", _worded(value))]
    return " && ".join(command_line.of(*words) for words in commands)


def _checked(lines: JsonLines, kinds: Kinds) -> list[Row]:
    """The rows, if all have the keys of `kinds` with values of these kinds; lists must be of one length."""
    rows = lines.read()
    for number, row in enumerate(rows, 1):
        for key, kind in kinds.items():
            if not isinstance(row.get(key), kind):
                raise ConfigError(
                    f"{lines.path}: line {number}: {key} is {_worded(row.get(key))[:60]}, which no run writes"
                )
        if len({len(row[key]) for key, kind in kinds.items() if kind is list}) > 1:
            raise ConfigError(f"{lines.path}: line {number}: its lists differ in length")
    return list(rows)


def _complete(rows: Sequence[Row], seeds: int) -> list[list[Row]]:
    """The rows of each moment that all `seeds` have written; of the last one some may be missing."""
    return [sorted(of_all, key=lambda row: row["seed"]) for of_all in by_step(rows) if len(of_all) == seeds]


def changes(run: Run) -> list[dict[str, Any]]:
    """The settings that were not as before when a run went on or began anew, as {env_steps, key, value}."""
    found = []
    for stretches in run.stretches:
        tables = [dotted(config) for config in (run.config, *(used for _, used in stretches))]
        for (began, _), (before, after) in zip(stretches, pairwise(tables), strict=True):
            new = {key: value for key, value in changed(before, after).items() if key not in _OF_SEEDS}
            found += [{"env_steps": began, "key": key, "value": _worded(value)} for key, value in new.items()]
    return [row for i, row in enumerate(found) if row not in found[:i]]


def settings(run: Run) -> dict[str, str]:
    """The values of all settings in words, with those that were changed later; of the length only the last."""
    table = words(run.config)
    for row in changes(run):
        key, value = row["key"], row["value"]
        table[key] = value if key == _TOTAL else f"{table[key]}, {value} from {row['env_steps']:,} env steps"
    return table


def words(config: RunConfig) -> dict[str, str]:
    """The values of all settings in words, by their dotted keys."""
    return {key: _worded(value) for key, value in dotted(config).items()}


def differences(tables: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """The settings in which runs differ, as {key, values}; for a single run those that differ from the defaults.

    The defaults are the last of the `values` then.
    """
    if len(tables) == 1:
        defaults = kinds.find(tables[0]["experiment"]).Config.model_construct()
        tables = [*tables, words(defaults)]
    keys = {key: None for table in tables for key in table}
    rows = ({"key": key, "values": [table.get(key, "null") for table in tables]} for key in keys)
    return [row for row in rows if len(set(row["values"])) > 1]


def _worded(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def labels(runs: Sequence[Path]) -> list[str]:
    """Short names of runs: their folders', or their whole paths where two folders are called the same."""
    names = [run.resolve().name for run in runs]
    return [name if names.count(name) == 1 else str(run) for name, run in zip(names, runs, strict=True)]
