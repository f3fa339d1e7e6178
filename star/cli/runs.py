"""The runs that a command line names."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path

from star.config import agents, loading
from star.config.kinds import Kind
from star.config.loading import experiment_of
from star.config.section import ConfigError


def chosen(options: argparse.Namespace) -> tuple[list[tuple[Path, str]], dict[str, list[Path]]]:
    """The (run, checkpoint) to evaluate, and the groups of runs: those given, then each other run by itself."""
    names: dict[Path, Path] = {}
    found: list[tuple[Path, str]] = []

    def add(path: Path) -> Path:
        run, checkpoint = _run_and_checkpoint(path, options.checkpoint)
        run = names.setdefault(run.resolve(), run)
        found.append((run, checkpoint))
        return run

    single = list(dict.fromkeys(add(path) for path in options.runs))
    groups = {name: list(dict.fromkeys(map(add, runs))) for name, runs in groups_of(options.group).items()}
    for name, other in itertools.combinations(groups, 2):
        for run in groups[name]:
            if run in groups[other]:
                raise ConfigError(f"--group: {agents.told(run)} is both in {name} and in {other}")
    grouped = {run for runs in groups.values() for run in runs}
    for run in single:
        if run not in grouped:
            groups[agents.told(run)] = [run]
    return found, groups


def groups_of(texts: Sequence[str]) -> dict[str, list[Path]]:
    """The runs of each NAME=RUN,RUN."""
    groups: dict[str, list[Path]] = {}
    for text in texts:
        name, equals, runs = text.partition("=")
        if not (name and equals and all(runs.split(","))):
            raise ConfigError(f"--group: {text!r} is not of the form NAME=RUN,RUN")
        if name in groups:
            raise ConfigError(f"--group: {name} is given twice")
        groups[name] = [Path(run) for run in runs.split(",")]
    return groups


def _run_and_checkpoint(path: Path, wanted: str) -> tuple[Path, str]:
    """(RUN, STEPS) of a path RUN/checkpoints/STEPS, else the path as a run and what is wanted of it."""
    if path.parent.name == "checkpoints" and path.name.isdecimal():
        return path.parent.parent, path.name
    return agents.find(path), wanted


def kind_of(runs: Sequence[Path], command: str) -> Kind:
    """The kind of experiment of all these runs; raises `UserError` if they differ."""
    names = [experiment_of(run) for run in runs]
    for run, name in zip(runs, names, strict=True):
        if name != names[0]:
            said = f"{agents.told(run)}: is of experiment {name}, {agents.told(runs[0])} of {names[0]}"
            raise ConfigError(f"{said}; star {command} takes one kind")
    return loading.kind_of(runs[0])
