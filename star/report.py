"""Figures of a run: the regions over the maze beside the success curve."""

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

from star.state import TrainState

_MAX_PANELS = 5


def summary_figure(
    path: Path, *, state: TrainState, rows: Sequence[Mapping[str, Any]], walls: np.ndarray, seeds: Sequence[int]
) -> None:
    """Draw the abstraction of each seed (leading axis of `state`, first five) and success over env steps.

    `walls` [n, 4] are rectangles (x_low, y_low, x_high, y_high). Regions are coloured by how often the Commander
    chose them of late.
    """
    shown = list(seeds)[:_MAX_PANELS]
    figure = Figure(figsize=(4.6 * (len(shown) + 1), 4.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(shown) + 1))
    for panel, (axis, seed) in enumerate(zip(axes[:-1], shown, strict=True)):
        draw_regions(axis, state, panel, walls)
        axis.set_title(f"regions, seed {seed}")
    share = ScalarMappable(norm=Normalize(0, 1), cmap="viridis")
    figure.colorbar(share, ax=list(axes[:-1]), label="chosen by the Commander (relative to the most chosen)")
    draw_success(axes[-1], rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def draw_regions(axis: Axes, state: TrainState, index: int, walls: np.ndarray) -> None:
    """The first two abstract dimensions of the regions of seed number `index`, over the walls."""
    count = int(state.abstraction.count[index])
    lower = np.asarray(state.abstraction.lower[index][:count])
    upper = np.asarray(state.abstraction.upper[index][:count])
    chosen = np.asarray(state.commander.chosen[index][:count])
    space = np.asarray(state.abstraction.space[index])
    colours = ScalarMappable(norm=Normalize(0, max(float(chosen.max()), 1e-9)), cmap="viridis").to_rgba(chosen)
    for low, high, colour in zip(lower, upper, colours, strict=True):
        width, height = (high - low)[:2]
        axis.add_patch(Rectangle(low[:2], width, height, facecolor=colour, edgecolor="white", linewidth=1.0))
    for x_low, y_low, x_high, y_high in walls:
        axis.add_patch(
            Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, facecolor="0.25", alpha=0.75, linewidth=0)
        )
    axis.set_xlim(space[0, 0], space[1, 0])
    axis.set_ylim(space[0, 1], space[1, 1])
    axis.set_aspect("equal")
    axis.set_xlabel("x")
    axis.set_ylabel("y")


def draw_success(axis: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Both success measures over env steps, mean over seeds, with the range between seeds."""
    for name, style in (("success_any", "--"), ("success_final", "-")):
        key = f"eval/{name}"
        evaluated = [row for row in rows if row.get(key) is not None]
        steps = sorted({row["env_steps"] for row in evaluated})
        curves = [[row[key] for row in evaluated if row["env_steps"] == step] for step in steps]
        if not curves:
            continue
        (line,) = axis.plot(steps, [np.mean(c) for c in curves], style, marker=".", label=name.replace("_", " "))
        low, high = [np.min(c) for c in curves], [np.max(c) for c in curves]
        axis.fill_between(steps, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    axis.set_xlabel("env steps")
    axis.set_ylabel("success on test goals")
    axis.set_ylim(-0.02, 1.02)
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right")
