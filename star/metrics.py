"""Sinks of metrics: JSON lines on disk, and a progress bar or plain lines on the terminal."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from star.config import ConfigError


class JsonLines:
    """A file with one object a line, flushed at once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, row: Mapping[str, Any]) -> None:
        """Append one line; numbers that JSON cannot hold become null."""
        clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(clean) + "\n")

    def read(self) -> list[dict[str, Any]]:
        """All complete lines so far; raises `ConfigError` in one line that says which is none of ours."""
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
        except ValueError:
            row = None
        if not isinstance(row, dict):
            raise ConfigError(f"{self.path}: line {number} is not a JSON object")
        return row

    def keep_until(self, env_steps: int) -> None:
        """Drop what was written after `env_steps`, for a run that goes on from there."""
        if not self.path.exists():
            return
        rows = [row for row in self.read() if row["env_steps"] <= env_steps]
        partial = self.path.with_suffix(".partial")
        partial.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        os.replace(partial, self.path)


@dataclass(frozen=True)
class Journal:
    """What a run writes down.

    `metrics.jsonl` has a line for each epoch and seed, `regions.jsonl` for each evaluation and seed, and
    `provenance.jsonl` for each time that the run began or went on.
    """

    metrics: JsonLines
    regions: JsonLines
    provenance: JsonLines

    @classmethod
    def of(cls, run_dir: Path) -> Journal:
        """That of a run directory."""
        return cls(*(JsonLines(run_dir / f"{name}.jsonl") for name in ("metrics", "regions", "provenance")))


class Display:
    """What a person sees of a run: a live bar on a terminal, one line per evaluation elsewhere."""

    def __init__(self, console: Console, *, total_env_steps: int, done_env_steps: int, quiet: bool = False) -> None:
        self._console = console
        self._total = total_env_steps
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(compact=True),
            console=console,
            disable=quiet or not console.is_terminal,
        )
        self._quiet = quiet
        self._success: float | None = None
        self._task = self._progress.add_task(
            "compiling", total=total_env_steps, completed=done_env_steps, status="", start=False
        )

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, env_steps: int, rows: Sequence[Mapping[str, Any]], *, left_s: float) -> None:
        """Show the rows of one epoch, one per seed."""
        speed = rows[0]["env_steps_per_s"]
        status = f"{speed:,.0f} env steps/s"
        regions = mean(rows, "abstraction/regions")
        if regions is not None:
            status += f"  regions {regions:.0f}"
        success = mean(rows, "eval/success_final")
        if success is not None:
            self._success = success
        if self._success is not None:
            status += f"  success {self._success:.2f}"
        faults = sum(row.get(key, 0.0) for row in rows for key in ("env/non_finite", "env/overflow"))
        if faults:
            status += f"  simulator faults {faults:.0f}"
        self._progress.start_task(self._task)
        self._progress.update(self._task, completed=env_steps, description="training", status=status)
        if success is not None and not self._quiet and not self._console.is_terminal:
            self._console.print(
                f"{env_steps:,} / {self._total:,} env steps  {status}  {left_s:.0f} s left",
                highlight=False,
                soft_wrap=True,
            )


def mean(rows: Sequence[Mapping[str, Any]], key: str) -> float | None:
    """Mean of `key` over the rows that have it."""
    values = [float(row[key]) for row in rows if row.get(key) is not None]
    return sum(values) / len(values) if values else None
