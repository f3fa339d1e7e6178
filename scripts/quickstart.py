"""Draw what refinement was worth in two runs on one task, for `make quickstart`.

    python scripts/quickstart.py RUN UNREFINED [--out FILE.png]

UNREFINED is a run whose first regions stay. Writes RUN/figures/worth.png: for each run the regions of its first seed
with start, test goal and the way of a greedy episode, and beside them the success of both over env steps.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from envs.common.errors import UserError
from star.agent import figures, films
from star.config.loading import load_to_act
from star.training.figures import save
from star.training.journal import Journal

NAMES = ("refined", "not refined")


class Shown(NamedTuple):
    """The drawn parts of a run: evaluations, last regions of its first seed, walls [n, 4], greedy way [T, 2] (m)."""

    rows: list[dict[str, Any]]
    regions: dict[str, Any]
    walls: np.ndarray
    way: np.ndarray
    goal: np.ndarray
    arrived: float | None
    """Seconds to the goal; None if the episode does not reach it."""


def read(run: Path) -> Shown:
    """Evaluations and regions of a run, and a greedy episode of its last checkpoint; raises `UserError`."""
    journal = Journal.of(run, tables="regions")
    rows, tables = journal.metrics.read(), journal.tables.read()
    if not rows or not tables:
        raise UserError(f"{run}: is no run with evaluations and regions")
    recording = films.record_run(load_to_act(run, {}), run, checkpoint="last", agent=None, envs=1, steps=None)
    moments, env = recording.moments, recording.env
    success = moments.success[:, 0] > 0
    end = int(np.argmax(success)) if success.any() else len(success) - 1
    return Shown(
        rows=[row for row in rows if "eval/success_any" in row],
        regions=[row for row in tables if row["seed"] == tables[0]["seed"]][-1],
        walls=np.asarray(env.walls),
        way=moments.obs[: end + 1, 0, :2],
        goal=moments.obs[0, 0, env.state_dim :],
        arrived=end * env.dt if success.any() else None,
    )


def figure(runs: list[Shown]) -> Figure:
    """Two maps, and the success of both runs."""
    drawn = Figure(figsize=(12.6, 4.2), layout="constrained")
    *maps, curves = drawn.subplots(1, 3)
    for axis, shown, name in zip(maps, runs, NAMES, strict=True):
        _map(axis, shown, name)
    for number, (shown, name) in enumerate(zip(runs, NAMES, strict=True)):
        steps = sorted({row["env_steps"] for row in shown.rows})
        at = [[row["eval/success_any"] for row in shown.rows if row["env_steps"] == step] for step in steps]
        curves.plot(steps, [np.mean(seeds) for seeds in at], ".-", color=f"C{number}", label=name)
        low, high = [min(seeds) for seeds in at], [max(seeds) for seeds in at]
        curves.fill_between(steps, low, high, color=f"C{number}", alpha=0.15, linewidth=0)
    seeds = len({row["seed"] for row in runs[0].rows})
    curves.set(xlabel="env steps of each seed", ylabel="success on the test goal", ylim=(-0.02, 1.02))
    curves.set_title(f"success: mean and range of {seeds} seed{'s' * (seeds > 1)}")
    curves.grid(alpha=0.3)
    curves.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k
    curves.legend(loc="best")
    return drawn


def _map(axis: Axes, shown: Shown, name: str) -> None:
    """Regions, walls, start, goal and way."""
    figures.draw_regions(axis, shown.regions, shown.walls)
    axis.plot(*shown.way.T, color="tab:red", label="greedy way")
    axis.plot(*shown.way[0], "o", color="white", markeredgecolor="black", label="start")
    axis.plot(*shown.goal[:2], "*", color="tab:green", markeredgecolor="white", ms=14, label="test goal")
    end = "does not arrive" if shown.arrived is None else f"arrives after {shown.arrived:.0f} s"
    axis.set_title(f"{name}: {len(shown.regions['chosen'])} regions, {end}")
    axis.legend(loc="lower right", fontsize="small")


def main(arguments: list[str] | None = None) -> int:
    """Draw the figure and print its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("unrefined", type=Path, metavar="UNREFINED")
    parser.add_argument("--out", type=Path, metavar="FILE.png")
    options = parser.parse_args(arguments)
    out = options.out or options.run / "figures" / "worth.png"
    try:
        save(figure([read(options.run), read(options.unrefined)]), out)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    print(f"{out}: the worth of refinement")
    return 0


if __name__ == "__main__":
    sys.exit(main())
