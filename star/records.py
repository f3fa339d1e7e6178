"""What a run has measured so far: in its journal, since in memory the rows of a long run would grow without end."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from star import report
from star.agent.state import TrainState
from star.metrics import Journal, by_step, mean
from star.program import Program


class Records:
    """Writes the rows of a run down, and knows of the latest ones."""

    def __init__(self, program: Program, journal: Journal) -> None:
        self.program, self.journal = program, journal
        rows = self.look_back()
        self._began = time.monotonic() - (rows[-1]["wall_s"] if rows else 0.0)

    def look_back(self) -> list[dict[str, Any]]:
        """Take what is latest from the journal, which may have been cut; returns its rows of metrics."""
        self.success: float | None = None
        """Mean `eval/success_final` of the latest evaluation."""
        rows = self.journal.metrics.read()
        for table in by_step(rows):
            self._notice(table)
        return rows

    def add(self, table: list[dict[str, Any]], *, env_steps: int, speed: float) -> None:
        """An epoch: one row for each seed."""
        for row in table:
            row |= {"env_steps": env_steps, "wall_s": round(time.monotonic() - self._began, 3)}
            row |= {"env_steps_per_s": round(speed)}
            self.journal.metrics.write(row)
        self._notice(table)

    def add_regions(self, state: TrainState, *, env_steps: int) -> None:
        """The regions of each seed, if it has a Commander."""
        for row in self._regions(state, env_steps):
            self.journal.regions.write(row)

    def regions(self, state: TrainState | None, *, env_steps: int) -> list[dict[str, Any]]:
        """All rows of regions, those of `state` included, if there is one; it may not have been evaluated."""
        rows, found = self.journal.regions.read(), [] if state is None else self._regions(state, env_steps)
        return rows if rows and rows[-1]["env_steps"] == env_steps else rows + found

    def _regions(self, state: TrainState, env_steps: int) -> list[dict[str, Any]]:
        program = self.program
        if not program.config.commander.enabled:
            return []
        return report.region_rows(
            program.config.agent(),
            state,
            seeds=program.seeds,
            env_steps=env_steps,
            goal=program.goal,
            episode_length=program.spec.episode_length,
        )

    def _notice(self, table: Sequence[Mapping[str, Any]]) -> None:
        found = mean(table, "eval/success_final")
        self.success = self.success if found is None else found
