"""Figures of what evaluations measure, and how figures are written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from star.config import kinds
from star.config.kinds import Measure
from star.config.run import RunConfig

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Row = Mapping[str, Any]

_STYLES = ("-", "--", ":", "-.")


def measures_figure(rows: Sequence[Row], config: RunConfig) -> Figure:
    """Draw what was measured in `rows`."""
    from matplotlib.figure import Figure  # slow to import: a run need not wait for it to begin

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    kind = kinds.of(config)
    draw_measures(figure.subplots(), rows, kind.measures, unit=kind.unit)
    return figure


def draw_measures(axis: Axes, rows: Sequence[Row], measures: Sequence[Measure], *, unit: str) -> None:
    """The measures over env steps, means over seeds, with the range between seeds.

    Beside shares of episodes others have an axis of their own, on the right.
    """
    from matplotlib.ticker import EngFormatter, MaxNLocator

    shares = [measure for measure in measures if measure.episodes]
    others = [one for one in measures if not one.episodes and any(row.get(one.key) is not None for row in rows)]
    beside = axis.twinx() if shares and others else axis
    lines: list[Line2D] = []
    for measure, style in zip(measures, _STYLES * len(measures), strict=False):
        own = axis if measure.episodes else beside
        evaluated = [row for row in rows if row.get(measure.key) is not None]
        steps = sorted({row["env_steps"] for row in evaluated})
        curves = [[row[measure.key] for row in evaluated if row["env_steps"] == step] for step in steps]
        if not curves:
            continue
        label = literal(measure.name.replace("_", " "))
        colour = f"C{len(lines)}"
        (line,) = own.plot(steps, [np.mean(c) for c in curves], style, marker=".", label=label, color=colour)
        lines.append(line)
        low, high = [np.min(c) for c in curves], [np.max(c) for c in curves]
        own.fill_between(steps, low, high, color=colour, alpha=0.2, linewidth=0)
    axis.set_xlabel(unit)
    axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))  # 50k, 1.5M
    axis.set_ylabel(f"evaluation {measures[0].where}".rstrip())
    if shares:
        axis.set_ylim(-0.02, 1.02)
    if beside is not axis:
        beside.set_ylabel(", ".join(measure.label or literal(measure.name) for measure in others))
        beside.set_ylim(bottom=0)
    axis.grid(alpha=0.3)
    if lines:  # none before the first evaluation
        beside.legend(handles=lines, loc="lower right")


def save(figure: Figure, path: Path) -> None:
    """Write a figure, and the folder it is to be in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def literal(text: str) -> str:
    """A user's text, for a figure.

    Matplotlib would set what is between two $ as a formula, or fail to, and leave a name that begins with _ out of
    legends.
    """
    return " " * text.startswith("_") + text.replace("$", r"\$")
