"""Runs that are written by hand."""

import pytest

from star.config.loading import parse
from tests.report.by_hand import lines, metrics, strip


@pytest.fixture
def make(tmp_path):
    """Writes a run directory; four epochs, two evaluations and two seeds if not told otherwise.

    `resumed` has (env steps, what else its line of provenance says) of each time that the run went on.
    """

    def write(name="run", *, seeds=(0, 1), rows=None, regions=None, settings=None, resumed=()):
        folder = tmp_path / name
        folder.mkdir(parents=True)
        config = parse({"trainer": {"num_seeds": len(seeds), "total_env_steps": 400}}, settings)
        (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
        lines(folder / "metrics.jsonl", metrics(4, seeds) if rows is None else rows)
        grown = [{"seed": seed, "env_steps": 100 * n} | strip(n // 2) for n in (2, 4) for seed in seeds]
        lines(folder / "regions.jsonl", grown if regions is None else regions)
        start = {"time": "2026-01-02T03:04:05+00:00", "commit": "c0ffee", "device": "abacus", "python": "3.11.0"}
        start |= {"versions": {"jax": "0.10"}}
        lines(folder / "provenance.jsonl", [{"env_steps": n} | start | more for n, more in [(0, {}), *resumed]])
        return folder

    return write
