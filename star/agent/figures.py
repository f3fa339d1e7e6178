"""STAR's figures: the regions over the maze, as they are and as they grew, and what SGIM chose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from star.agent.kind import STAR
from star.agent.region_rows import flat
from star.training.figures import draw_measures

_MAX_PANELS = 5
_GROWTH_PANELS = 4
OUTLINE = "tab:purple"  # of regions without a value
WALL = (0.25, 0.25, 0.25, 0.75)

Row = Mapping[str, Any]


def summary_figure(*, regions: Sequence[Row], rows: Sequence[Row], walls: np.ndarray) -> Figure:
    """Draw the last abstraction of each of the first five seeds in `regions`, and the success in `rows`.

    `walls` [n, 4] are rectangles (x_low, y_low, x_high, y_high). Regions are coloured by how often the Commander
    chose them of late.
    """
    last = {row["seed"]: row for row in regions}
    shown = list(last.values())[:_MAX_PANELS]
    figure = Figure(figsize=(4.6 * (len(shown) + 1), 4.4), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, len(shown) + 1)))
    _draw_panels(axes[:-1], [(row, f"regions, seed {row['seed']}") for row in shown], walls)
    draw_measures(axes[-1], rows, STAR.measures, unit=STAR.unit)
    return figure


def growth_figure(*, regions: Sequence[Row], walls: np.ndarray, moments: Sequence[float] | None = None) -> Figure:
    """Draw the abstraction of the first seed in `regions` at `moments` (env steps), by default quarters of the run.

    Each moment shows the first row at or after it, or the last one; no row is shown twice.
    """
    rows = [row for row in regions if row["seed"] == regions[0]["seed"]]
    if moments is None:
        moments = [rows[-1]["env_steps"] * (i + 1) / _GROWTH_PANELS for i in range(_GROWTH_PANELS)]
    found = [next((row for row in rows if row["env_steps"] >= moment), rows[-1]) for moment in moments]
    shown = list({row["env_steps"]: row for row in found}.values())
    figure = Figure(figsize=(4.6 * len(shown), 4.4), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, len(shown))))
    titles = [f"{len(row['chosen'])} regions at {row['env_steps'] / 1e6:.3g} M env steps" for row in shown]
    _draw_panels(axes, list(zip(shown, titles, strict=True)), walls)
    return figure


def sgim_figure(*, regions: Sequence[Row], rows: Sequence[Row], walls: np.ndarray) -> Figure:
    """Draw what SGIM chose: the share of every strategy and the competence over time, and the last map of interest.

    Shares are means over seeds; the map is that of the first seed in `regions`.
    """
    steps = sorted({row["env_steps"] for row in rows})
    prefix = "sgim/share_"
    names = [key.removeprefix(prefix) for key in rows[0] if key.startswith(prefix)]

    def curve(key: str) -> list[float]:
        return [float(np.mean([row[key] for row in rows if row["env_steps"] == step])) for step in steps]

    last = [row for row in regions if row["seed"] == regions[0]["seed"]][-1] if regions else None
    figure = Figure(figsize=(10.4 if last else 5.8, 4.4), layout="constrained")
    axes = figure.subplots(1, 2 if last else 1, squeeze=False)[0]
    millions = np.asarray(steps) / 1e6
    axes[0].stackplot(millions, [curve(prefix + name) for name in names], labels=names, alpha=0.7)
    axes[0].plot(millions, curve("sgim/competence"), "k--", label="competence")
    axes[0].set(xlabel="million env steps", ylabel="share of episodes", ylim=(0, 1))
    axes[0].legend(loc="upper left", fontsize="small")
    if last:
        draw_regions(axes[1], last, walls, by="drawn")
        most = max([*last["drawn"], 1e-9])
        scale = ScalarMappable(norm=Normalize(0, most), cmap="viridis")
        figure.colorbar(scale, ax=axes[1], label=f"share of choices at {last['env_steps'] / 1e6:.3g} M env steps")
    return figure


def draw_regions(axis: Axes, row: Row, walls: np.ndarray, *, by: str | None = "chosen") -> None:
    """The first two abstract dimensions of the regions of a row, under the walls.

    They are coloured `by` one of the row's values, or with None outlined in `OUTLINE`.
    """
    lower, upper = flat(row["lower"]), flat(row["upper"], height=1.0)
    chosen = np.zeros(len(lower)) if by is None else np.asarray(row[by], float)
    colours = ScalarMappable(norm=Normalize(0, max(float(chosen.max()), 1e-9)), cmap="viridis").to_rgba(chosen)
    for low, high, colour in zip(lower, upper, colours, strict=True):
        width, height = (high - low)[:2]
        look = {"fill": False, "edgecolor": OUTLINE} if by is None else {"facecolor": colour, "edgecolor": "white"}
        axis.add_patch(Rectangle(low[:2], width, height, linewidth=1.0, **look))
    draw_walls(axis, walls)
    frame(axis, lower, upper)


def frame(axis: Axes, lower: np.ndarray, upper: np.ndarray) -> None:
    """Show x and y of all boxes [N, d], to scale."""
    axis.set(xlim=(lower[:, 0].min(), upper[:, 0].max()), ylim=(lower[:, 1].min(), upper[:, 1].max()))
    axis.set(xlabel="x", ylabel="y", aspect="equal")


def draw_walls(axis: Axes, walls: np.ndarray) -> None:
    """Rectangles [n, 4] (x_low, y_low, x_high, y_high)."""
    for x_low, y_low, x_high, y_high in walls:
        axis.add_patch(Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, facecolor=WALL, linewidth=0))


def _draw_panels(axes: Sequence[Axes], panels: Sequence[tuple[Row, str]], walls: np.ndarray) -> None:
    """One abstraction for each of `axes`, with its title, and the scale of their colours."""
    for axis, (row, title) in zip(axes, panels, strict=True):
        draw_regions(axis, row, walls)
        axis.set_title(title)
    if panels:
        share = ScalarMappable(norm=Normalize(0, 1), cmap="viridis")
        label = "chosen by the Commander (relative to the most chosen)"
        axes[0].figure.colorbar(share, ax=list(axes), label=label)
