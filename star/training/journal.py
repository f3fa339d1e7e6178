"""The journal of a run: JSON lines."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from envs.common import files
from star.config.section import ConfigError


class JsonLines:
    """A file with one object a line, flushed at once. A row that cannot be written raises `UserError`.

    With `muted` it is only read: somebody else writes it.
    """

    def __init__(self, path: Path, *, muted: bool = False) -> None:
        self.path = path
        self._muted = muted

    def write(self, *rows: Mapping[str, Any]) -> None:
        """Append a line for each row, all or none of them; numbers that JSON cannot hold become null."""
        if self._muted or not rows:
            return
        lines = "".join(json.dumps(_clean(row)) + "\n" for row in rows)
        try:
            before = self.path.stat().st_size if self.path.exists() else 0
            try:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(lines)
            except OSError:
                with contextlib.suppress(OSError):  # half a line, on a disk that is full
                    os.truncate(self.path, before)
                raise
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be written: {error.strerror}") from None

    def read(self) -> list[dict[str, Any]]:
        """All complete lines so far; raises `UserError` in one line that says which is none of ours."""
        if not self.path.exists():
            return []
        try:
            lines = self.path.read_bytes().splitlines(keepends=True)
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror}") from None
        return [self._parsed(line, number) for number, line in enumerate(lines, 1) if line.endswith(b"\n")]

    def _parsed(self, line: bytes, number: int) -> dict[str, Any]:
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        if not isinstance(row, dict):
            raise ConfigError(f"{self.path}: line {number} is not a JSON object")
        return row

    def keep_until(self, env_steps: int) -> None:
        """Drop what was written after `env_steps`, for a run that goes on from there."""
        if self._muted or not self.path.exists():
            return
        self._replace([row for row in self.read() if row["env_steps"] <= env_steps])

    def mend(self) -> None:
        """Drop the last line if it is incomplete, as of a process that was killed."""
        if not self._muted and self.path.exists():
            self._replace(self.read())

    def _replace(self, rows: Sequence[Mapping[str, Any]]) -> None:
        with files.whole(self.path) as path:
            path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")

    def sync(self) -> None:
        """Have all lines survive a loss of power."""
        if not self._muted:
            with contextlib.suppress(FileNotFoundError):
                files.sync(self.path)


@dataclass(frozen=True)
class Journal:
    """The journal of a run.

    `metrics.jsonl` has a line for each epoch and seed, `<tables>.jsonl` for each evaluation and seed,
    `provenance.jsonl` for each time that the run began or went on, with the `settings` that were not those of
    `config.yaml` then, and `faults.jsonl` for each time that numbers of a seed were not finite.
    """

    metrics: JsonLines
    tables: JsonLines
    provenance: JsonLines
    faults: JsonLines

    @classmethod
    def of(cls, run_dir: Path, *, tables: str, muted: bool = False) -> Journal:
        """That of a run directory, with the `tables` of its kind of experiment; `muted` as in `JsonLines`."""
        names = ("metrics", tables, "provenance", "faults")
        return cls(*(JsonLines(run_dir / f"{name}.jsonl", muted=muted) for name in names))

    def keep_until(self, env_steps: int) -> None:
        """Drop what was measured after `env_steps`, for a run that goes on from there."""
        self.metrics.keep_until(env_steps)
        self.tables.keep_until(env_steps)
        self.provenance.mend()
        self.faults.mend()

    def sync(self) -> None:
        """Have all lines survive a loss of power."""
        for lines in (self.metrics, self.tables, self.provenance, self.faults):
            lines.sync()


def _clean(row: Mapping[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def of_epoch(metrics: dict[str, jax.Array], seeds: list[int]) -> list[dict[str, Any]]:
    """One row per seed of the `metrics` of an epoch, arrays with a leading axis of seeds."""
    host = {name: values.tolist() for name, values in jax.device_get(metrics).items()}
    return [dict(zip(("seed", *host), row, strict=True)) for row in zip(seeds, *host.values(), strict=True)]


def by_step(rows: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """The rows of each moment, by their env steps, in the order of time."""
    found: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["env_steps"], []).append(row)
    return [found[step] for step in sorted(found)]


def mean(rows: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Mean of `key` over the rows that have it."""
    values = [float(row[key]) for row in rows if row.get(key) is not None]
    return sum(values) / len(values) if values else None
