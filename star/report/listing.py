"""The runs in a folder, at a glance: `star ls`. Reads the end of each file alone."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from envs.common.errors import UserError
from star.config import kinds
from star.config.loading import load_run
from star.config.section import ConfigError
from star.training import lock

_TAIL = 2**20  # bytes of metrics.jsonl that are read: some hundred rows
_UNITS = ((86400, "d"), (3600, "h"), (60, "min"), (1, "s"))


@dataclass(frozen=True)
class Entry:
    """A run; what cannot be read of it is empty, and `fault` says why."""

    path: Path
    state: str
    task: str = ""
    agent: str = ""
    seeds: int = 0
    steps: int = 0
    total: int = 0
    measure: str = ""
    score: float | None = None
    """Of the latest evaluation, the mean over seeds."""
    age_s: float = 0.0
    """Since it was last written to."""
    fault: str = ""


def of(folder: Path) -> list[Entry]:
    """The runs in `folder`, the latest first; raises `UserError` if there is no such folder."""
    try:
        places = [place for place in folder.iterdir() if (place / "config.yaml").is_file()]
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be read: {error.strerror}") from None
    return sorted(map(_entry, places), key=lambda one: (one.age_s, one.path))


def table(entries: Sequence[Entry]) -> Table:
    """As people read it."""
    shown = Table(box=None, pad_edge=False)
    for title in ("run", "task", "agent"):
        shown.add_column(title, no_wrap=title == "run")
    for title in ("seeds", "score", "steps", "age"):
        shown.add_column(title, justify="right")
    shown.add_column("state")
    for one in entries:
        score = "" if one.score is None else f"{one.measure} {one.score:.2f}"
        steps = _count(one.steps) + (f" of {_count(one.total)}" if one.steps < one.total else "")
        seeds = str(one.seeds) if one.seeds else ""
        shown.add_row(*map(Text, (one.path.name, one.task, one.agent, seeds, score, steps, _age(one.age_s), one.state)))
    return shown


def _entry(path: Path) -> Entry:
    metrics = path / "metrics.jsonl"
    age = time.time() - (metrics if metrics.exists() else path / "config.yaml").stat().st_mtime
    try:
        config = load_run(path, {})
        kind = kinds.of(config)
        rows = _last(metrics)
    except UserError as error:
        return Entry(path, state="cannot be read", fault=str(error), age_s=age)
    measure = kind.measures[0]
    steps, total = rows[-1]["env_steps"] if rows else 0, config.trainer.total_env_steps
    return Entry(
        path,
        state=_state(path, done=steps >= total),
        task=kind.title(config),
        agent=kind.agent(config),
        seeds=config.trainer.num_seeds,
        steps=steps,
        total=total,
        measure=measure.name,
        score=_score(rows, measure.key),
        age_s=age,
    )


def _state(path: Path, *, done: bool) -> str:
    if lock.held(path):
        return "training"
    if done:
        return "done"
    faults = path / "faults.jsonl"
    return "not finite" if faults.exists() and faults.stat().st_size else "stopped"


def _last(path: Path) -> list[Mapping[str, Any]]:
    """The rows at the end of a file of metrics; raises `UserError` if they are none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _TAIL))
            lines = file.read().split(b"\n")[file.tell() > _TAIL : -1]  # neither half a row at first, nor at last
        rows = [json.loads(line) for line in lines]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, RecursionError):
        raise ConfigError(f"{path}: cannot be read") from None
    if not all(isinstance(row, dict) and isinstance(row.get("env_steps"), int) for row in rows):
        raise ConfigError(f"{path}: is not what a run writes")
    return rows


def _score(rows: Sequence[Mapping[str, Any]], key: str) -> float | None:
    measured = [row for row in rows if isinstance(row.get(key), int | float)]
    latest = [row[key] for row in measured if row["env_steps"] == measured[-1]["env_steps"]]
    return sum(latest) / len(latest) if latest else None


def _count(steps: int) -> str:
    return f"{steps / 1e6:.1f} M" if steps >= 10**6 else f"{steps / 1e3:.0f} k"


def _age(seconds: float) -> str:
    for unit, name in _UNITS:
        if seconds >= unit:
            return f"{seconds / unit:.0f} {name}"
    return "now"
