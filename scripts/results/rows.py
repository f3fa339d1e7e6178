"""The rows of results tables: the JSON files of scripts/results/reproduce.py below results/."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from scripts.results import digest
from star.report import statistics
from star.training.journal import JsonLines

RESULTS = Path(__file__).parents[2] / "results"
DIGESTS = RESULTS / "digests.json"
MARK = "†"


class Row(NamedTuple):
    """A measured agent: its JSON, and whether its digest is today's."""

    path: str
    report: Mapping[str, Any]
    today: bool

    @property
    def scores(self) -> np.ndarray:
        """success_any of each seed."""
        return np.asarray([seed["success_any"] for seed in self.report["seeds"]])

    @property
    def interval(self) -> tuple[float, float, float]:
        """Mean, low and high over seeds; the three are one number where there is one seed."""
        mean, low, high = statistics.over_seeds(self.scores, episodes=self.report["seeds"][0]["episodes"])
        return float(mean), float(np.nan_to_num(low, nan=mean)), float(np.nan_to_num(high, nan=mean))

    @property
    def mark(self) -> str:
        """The mark behind the name of a row of an older version."""
        return "" if self.today else f" {MARK}"


def read(results: Path = RESULTS) -> dict[str, Row]:
    """All rows below `results`, by their path without ending."""
    kept = results / DIGESTS.name
    today = json.loads(kept.read_text(encoding="utf-8"))["rows"] if kept.exists() else {}
    rows = {}
    for path in sorted(results.rglob("*.json")):
        report = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(report, dict) and {"task", "name", "seeds", "runs"} <= report.keys():
            name = path.relative_to(results).with_suffix("").as_posix()
            same = (digest.same(run.get("digest"), today.get(name)) for run in report["runs"])
            rows[name] = Row(name, report, all(same))
    return rows


def evaluations(row: Path) -> list[dict[str, Any]]:
    """All evaluations in training of the row at `row`, a path without ending."""
    return [point for point in JsonLines(row.parent / "curves.jsonl").read() if point["name"] == row.name]
