"""The measurements of a run so far: in its journal, since in memory the rows of a long run would grow without end."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from star.training.journal import Journal, by_step, mean
from star.training.program import Program


class Recorder:
    """Writes the rows of a run down, and knows of the latest ones."""

    def __init__(self, program: Program, journal: Journal) -> None:
        self.program, self.journal = program, journal
        rows = self.look_back()
        self._began = time.monotonic() - (rows[-1]["wall_s"] if rows else 0.0)

    def look_back(self) -> list[dict[str, Any]]:
        """Take what is latest from the journal, which may have been cut; returns its rows of metrics."""
        self.score: float | None = None
        """Mean over seeds of the first measure in the latest evaluation."""
        rows = self.journal.metrics.read()
        for table in by_step(rows):
            self._notice(table)
        return rows

    def add(self, table: list[dict[str, Any]], *, env_steps: int, speed: float) -> None:
        """An epoch: one row for each seed."""
        for row in table:
            row |= {"env_steps": env_steps, "wall_s": round(time.monotonic() - self._began, 3)}
            row |= {"env_steps_per_s": round(speed)}
        self.journal.metrics.write(*table)
        self._notice(table)

    def add_tables(self, state: Any, *, env_steps: int) -> None:
        """The experiment's records at an evaluation besides metrics."""
        self.journal.tables.write(*self._tables(state, env_steps))

    def tables(self, state: Any, *, env_steps: int) -> list[dict[str, Any]]:
        """All such rows, those of `state` included, if there is one; it may not have been evaluated."""
        rows, found = self.journal.tables.read(), [] if state is None else self._tables(state, env_steps)
        return rows if rows and rows[-1]["env_steps"] == env_steps else rows + found

    def _tables(self, state: Any, env_steps: int) -> list[dict[str, Any]]:
        program = self.program
        found = program.experiment.tables(program.config.hyper(), state, program.seeds)
        return [{"seed": seed, "env_steps": env_steps} | row for seed, row in zip(program.seeds, found, strict=False)]

    def _notice(self, table: Sequence[Mapping[str, Any]]) -> None:
        found = mean(table, self.program.kind.measures[0].key)
        self.score = self.score if found is None else found
