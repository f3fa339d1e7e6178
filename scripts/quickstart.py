"""Draw what refinement was worth in two runs on one task, for `make quickstart`.

    python scripts/quickstart.py RUN UNREFINED [--out FILE.png]

UNREFINED is a run whose first regions stay. Writes RUN/figures/worth.png: for each run the regions of its first seed
with start, test goal and the way of a greedy episode, and beside them the success of both over env steps. Prints how
many seeds reach the goal: those that do so in most episodes of their last evaluation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import EngFormatter

from envs.common.errors import UserError
from star.agent import figures, films
from star.config.loading import load_to_act, read_file
from star.training.figures import save
from star.training.journal import Journal

ROOT = Path(__file__).parents[1]
NAMES = ("refined", "not refined")
BOXES = "configs/ablations/wrong_boxes.yaml"  # the layer of `make quickstart`
SUCCESS = "tab:green"
BELOW = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.13), "fontsize": "small", "frameon": False}  # the axes


class Shown(NamedTuple):
    """The drawn parts of a run: evaluations, last regions of its first seed, walls [n, 4], greedy way [T, 2] (m)."""

    rows: list[dict[str, Any]]
    regions: dict[str, Any]
    walls: np.ndarray
    way: np.ndarray
    goal: np.ndarray
    arrived: float | None
    """Simulated seconds until success; None if the episode does not reach the goal."""
    radius: float
    """The episode succeeds within so many m of the goal."""
    wrong: bool
    """The run began with the boxes of `BOXES`."""

    @property
    def reached(self) -> list[bool]:
        """Of each seed, whether most episodes of its last evaluation reach the goal."""
        last = {row["seed"]: row["eval/success_any"] for row in self.rows}
        return [share > 0.5 for share in last.values()]


def read(run: Path) -> Shown:
    """Evaluations and regions of a run, and a greedy episode of its last checkpoint; raises `UserError`."""
    journal = Journal.of(run, tables="regions")
    rows, tables = journal.metrics.read(), journal.tables.read()
    if not rows or not tables:
        raise UserError(f"{run}: is no run with evaluations and regions")
    config = load_to_act(run, {})
    recording = films.record_run(config, run, checkpoint="last", agent=None, envs=1, steps=None)
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
        radius=env.success_radius,
        wrong=[list(cuts) for cuts in config.abstraction.cuts or ()] == read_file(ROOT / BOXES)["abstraction"]["cuts"],
    )


def figure(runs: list[Shown]) -> Figure:
    """Two maps, and the success of both runs."""
    drawn = Figure(figsize=(13.2, 5.2), layout="constrained")
    *maps, curves = drawn.subplots(1, 3)
    for axis, shown, name in zip(maps, runs, NAMES, strict=True):
        _map(axis, shown, name)
    _curves(curves, runs)
    if all(shown.wrong for shown in runs):
        drawn.suptitle(f"Both runs begin with boxes that follow no wall of the U-maze, on purpose: {BOXES}")
    return drawn


def _map(axis: Axes, shown: Shown, name: str) -> None:
    """Regions, walls, start, goal with its radius, and way."""
    figures.draw_regions(axis, shown.regions, shown.walls, by=None)
    axis.add_patch(
        Circle(shown.goal[:2], shown.radius, facecolor=SUCCESS, alpha=0.2, label=f"success: within {shown.radius:g} m")
    )
    axis.plot(*shown.way.T, color="tab:red", label="way of a greedy episode")
    axis.plot(*shown.way[0], "o", color="white", markeredgecolor="black", label="start")
    axis.plot(*shown.goal[:2], "*", color=SUCCESS, markeredgecolor="white", ms=14, label="test goal")
    end = "does not arrive" if shown.arrived is None else f"arrives after {shown.arrived:.0f} s of simulated time"
    regions = len(shown.regions["chosen"])
    axis.set_title(f"{name}, seed {shown.regions['seed']}: {regions} regions\n{end}")
    axis.set(xlabel="x (m)", ylabel="y (m)")
    plain = [
        Patch(fill=False, edgecolor=figures.OUTLINE, label="region"),
        Patch(facecolor=figures.WALL, label="wall"),
    ]
    axis.legend(handles=[*axis.get_legend_handles_labels()[0], *plain], ncols=2, **BELOW)


def _curves(axis: Axes, runs: list[Shown]) -> None:
    """Mean and range of the success of all seeds."""
    for number, (shown, name) in enumerate(zip(runs, NAMES, strict=True)):
        steps = sorted({row["env_steps"] for row in shown.rows})
        at = [[row["eval/success_any"] for row in shown.rows if row["env_steps"] == step] for step in steps]
        axis.plot(steps, [np.mean(seeds) for seeds in at], ".-", color=f"C{number}", label=name)
        low, high = [min(seeds) for seeds in at], [max(seeds) for seeds in at]
        axis.fill_between(steps, low, high, color=f"C{number}", alpha=0.15, linewidth=0)
    seeds = len(runs[0].reached)
    axis.set(xlabel="env steps of each seed", ylabel="success on the test goal", ylim=(-0.02, 1.02))
    axis.set_title(f"success: mean and range\nof {seeds} seed{'s' * (seeds > 1)}")
    axis.grid(alpha=0.3)
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))  # 200k
    axis.legend(ncols=2, **BELOW)


def told(runs: list[Shown]) -> str:
    """The seeds that reach the goal, with refinement and without."""
    refined, other = (f"{sum(shown.reached)} of {len(shown.reached)}" for shown in runs)
    return f"{refined} seeds reach the goal with refinement, {other} without"


def main(arguments: list[str] | None = None) -> int:
    """Draw the figure, and print its numbers and its place."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN")
    parser.add_argument("unrefined", type=Path, metavar="UNREFINED")
    parser.add_argument("--out", type=Path, metavar="FILE.png")
    options = parser.parse_args(arguments)
    out = options.out or options.run / "figures" / "worth.png"
    try:
        runs = [read(options.run), read(options.unrefined)]
        save(figure(runs), out)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    print(f"{told(runs)}: {out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
