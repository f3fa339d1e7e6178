"""Figures of evaluations: success by the goal, over checkpoints, and between groups of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from star.agent.episodes import MEASURES
from star.agent.figures import draw_walls, frame
from star.training.figures import literal, save

_MAX_PANELS = 5

Row = Mapping[str, Any]


def goals_figure(path: Path, *, rows: Sequence[Row]) -> None:
    """Draw success_any over a grid of goals, for at most five checkpoints of one run, spread evenly and with the last.

    `rows` are those of `star.agent.exams`, oldest first, with `per_goal` and `walls`.
    """
    kept = np.unique(np.linspace(len(rows) - 1, 0, min(len(rows), _MAX_PANELS)).round().astype(int))
    shown = [sorted(rows, key=lambda row: row["env_steps"])[i] for i in kept]
    figure = Figure(figsize=(4.6 * len(shown), 4.4), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, len(shown))))
    for axis, row in zip(axes, shown, strict=True):
        draw_goals(axis, row["per_goal"], np.asarray(row["walls"]))
        axis.set_title(f"{row['env']} at {row['env_steps'] / 1e6:.3g} M env steps")
    share = ScalarMappable(norm=Normalize(0, 1), cmap="viridis")
    figure.colorbar(share, ax=axes, label="success_any, by the episode's goal")
    save(figure, path)


def draw_goals(axis: Axes, goals: Sequence[Row], walls: np.ndarray) -> None:
    """The `cell` (x_low, y_low, x_high, y_high) of every goal, coloured by its success_any, over the walls."""
    colour = ScalarMappable(norm=Normalize(0, 1), cmap="viridis")
    for goal in goals:
        x_low, y_low, x_high, y_high = goal["cell"]
        axis.add_patch(
            Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, facecolor=colour.to_rgba(goal["success_any"]))
        )
    draw_walls(axis, walls)
    frame(axis, walls[:, :2], walls[:, 2:])


def checkpoints_figure(path: Path, *, runs: Mapping[str, Sequence[Row]]) -> None:
    """Draw success over the env steps of the checkpoints of each run, with 95 % intervals.

    The intervals are those over seeds, or over episodes where there is one seed.
    """
    figure = Figure(figsize=(5.8, 4.4), layout="constrained")
    axis = figure.subplots()
    for number, (name, rows) in enumerate(runs.items()):
        ordered = sorted(rows, key=lambda row: row["env_steps"])
        steps = [row["env_steps"] for row in ordered]
        for measure, style in zip(MEASURES, ("--", "-"), strict=True):
            bands = [row.get(f"{measure}_seeds_interval", row[f"{measure}_interval"]) for row in ordered]
            label = f"{literal(name)} {measure.replace('_', ' ')}"
            axis.plot(steps, [row[measure] for row in ordered], style, marker=".", color=f"C{number}", label=label)
            axis.fill_between(steps, *np.transpose(bands), color=f"C{number}", alpha=0.15, linewidth=0)
    axis.set(xlabel="env steps", ylabel="success of the checkpoint", ylim=(-0.02, 1.02))
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right", fontsize="small")
    save(figure, path)


def profile_figure(path: Path, *, groups: Sequence[Row], taus: np.ndarray) -> None:
    """Draw the performance profile of every group: the share of its seeds with a success above tau, with intervals."""
    figure = Figure(figsize=(10.4, 4.4), layout="constrained")
    for axis, measure in zip(figure.subplots(1, 2, sharey=True), MEASURES, strict=True):
        for number, group in enumerate(groups):
            found = group[measure]
            axis.step(taus, found["profile"], where="post", color=f"C{number}", label=literal(group["name"]))
            axis.fill_between(
                taus, *found["profile_interval"], step="post", color=f"C{number}", alpha=0.15, linewidth=0
            )
        axis.set(xlabel=f"tau ({measure})", ylim=(-0.02, 1.02))
        axis.grid(alpha=0.3)
    axis.figure.axes[0].set_ylabel("share of seeds above tau")
    axis.legend(loc="lower left")
    save(figure, path)
