"""Evaluations afterwards of experiments that have no command of their own for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from star.config.kinds import Kind
from star.config.run import RunConfig
from star.report import statistics
from star.training import checkpoint as saved
from star.training import program as programs

Row = Mapping[str, Any]


def evaluate(config: RunConfig, run_dir: Path, *, checkpoint: str, seed: int) -> list[dict[str, Any]]:
    """For each checkpoint ("last", "best", "all" or its env steps) what was measured: `seeds`, and their mean.

    Each measure has its 95 % interval over seeds, None of one seed. `seed` chooses the random keys.

    Raises:
      UserError: in one line, for whatever cannot be evaluated.
    """
    program = programs.build(config)
    keys = program.evaluation_keys(seed, stream=programs.AFTERWARDS)
    rows = []
    with saved.opened(run_dir) as checkpoints:
        steps = checkpoints.steps()
        if checkpoint != "all" or not steps:
            steps = [saved.choose(checkpoints, run_dir, checkpoint)]
        for step in steps:
            state = saved.restore(program, checkpoints, step, source=run_dir)
            found = program.rows(program.evaluate(state, keys))
            seeds = [{"seed": one} | row for one, row in zip(program.seeds, found, strict=True)]
            row: dict[str, Any] = {"run": str(run_dir), "env_steps": step}
            for measure in program.kind.measures:
                episodes = measure.episodes(config) if measure.episodes else None
                scores = np.asarray([one[measure.key] for one in seeds], float)
                mean, *interval = (float(x) for x in statistics.over_seeds(scores, episodes=episodes))
                row |= {measure.name: mean, f"{measure.name}_seeds_interval": interval if len(seeds) > 1 else None}
            rows.append(row | {"seeds": [{k.removeprefix("eval/"): v for k, v in one.items()} for one in seeds]})
    return rows


def table(rows: Sequence[Row], kind: Kind) -> Table:
    """A line for each seed of each checkpoint, and one for all where there are several.

    Besides the measures there are the parts of the first one: numbers whose names begin with its own.
    """
    shown = Table(box=box.SIMPLE_HEAD)
    shown.add_column("run")
    first = f"{kind.measures[0].name}_"
    parts = [name for name in (rows[0]["seeds"][0] if rows else ()) if name.startswith(first)]
    names = [*(measure.name for measure in kind.measures), *parts]
    for name in (kind.unit, "seed", *names):
        shown.add_column(Text(name), justify="right")
    for row in rows:
        begin: list[Text | str] = [Text(row["run"]), f"{row['env_steps']:,}"]
        for seed in row["seeds"]:
            shown.add_row(*begin, str(seed["seed"]), *(f"{seed[name]:.4g}" for name in names))
        if len(row["seeds"]) > 1:
            shown.add_row(*begin, "all", *(_mean(row, name) for name in names))
    return shown


def _mean(row: Row, name: str) -> Text:
    """The mean over seeds, of a measure with its interval."""
    mean = np.mean([seed[name] for seed in row["seeds"]])
    low, high = row.get(f"{name}_seeds_interval") or (None, None)
    return Text(f"{mean:.4g}" if low is None else f"{mean:.4g} [{low:.4g}, {high:.4g}]")
