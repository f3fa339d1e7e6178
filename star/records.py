"""What a run has measured so far, in memory and in its journal."""

from __future__ import annotations

import time
from typing import Any

from star import report
from star.metrics import Journal, by_step, mean
from star.program import Program
from star.state import TrainState


class Records:
    """Rows of metrics and of regions; what is added is written down too."""

    def __init__(self, program: Program, journal: Journal) -> None:
        self.program, self.journal = program, journal
        self.rows, self.regions = journal.metrics.read(), journal.regions.read()
        self._began = time.monotonic() - (self.rows[-1]["wall_s"] if self.rows else 0.0)

    @property
    def success(self) -> float | None:
        """Mean `eval/success_final` of the latest evaluation."""
        evaluated = [row for row in self.rows if "eval/success_final" in row]
        return mean(by_step(evaluated)[-1], "eval/success_final") if evaluated else None

    def add(self, table: list[dict[str, Any]], *, env_steps: int, speed: float) -> None:
        """An epoch: one row for each seed."""
        for row in table:
            row |= {"env_steps": env_steps, "wall_s": round(time.monotonic() - self._began, 3)}
            row |= {"env_steps_per_s": round(speed)}
            self.journal.metrics.write(row)
        self.rows.extend(table)

    def add_regions(self, state: TrainState, *, env_steps: int, write: bool = True) -> None:
        """The regions of each seed, if it has a Commander."""
        program = self.program
        if not program.config.commander.enabled:
            return
        found = report.region_rows(
            program.config.agent(), state, seeds=program.seeds, env_steps=env_steps, goal=program.goal
        )
        if write:
            for row in found:
                self.journal.regions.write(row)
        self.regions.extend(found)

    def keep_until(self, env_steps: int) -> None:
        """Forget what came after `env_steps`; the journal has been cut already."""
        self.rows = [row for row in self.rows if row["env_steps"] <= env_steps]
        self.regions = [row for row in self.regions if row["env_steps"] <= env_steps]
