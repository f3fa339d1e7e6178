"""Charts of the documentation: docs/images/NAME.png in 128 colours, a third of the bytes.

The octree keeps lines of like colours apart, which the median cut takes for one.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, PngImagePlugin

IMAGES = Path(__file__).parents[2] / "docs" / "images"
COLOURS = 128


def save(figure: Figure, name: str, *, dpi: int, of: str = "") -> None:
    """Draw `figure` as the chart `name`; an older one is replaced. `of` says what is shown, and `shown` reads it."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi)
    chart = Image.open(drawn).convert("RGB").quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    told = PngImagePlugin.PngInfo()
    told.add_text("of", of)
    chart.save(IMAGES / f"{name}.png", optimize=True, pnginfo=told)


def shown(name: str) -> str:
    """The `of` with which the chart `name` was saved."""
    with Image.open(IMAGES / f"{name}.png") as chart:
        return str(chart.info["of"])


def band(
    axis: Axes, points: Sequence[Mapping[str, Any]], key: str, *, over: str = "env_steps", color: str, label: str
) -> None:
    """Mean of `key` over the seeds, and their range, at each number of env steps.

    The axis is `over`: env_steps in millions, or wall_s, the seconds since the start of the run.
    """
    steps = sorted({point["env_steps"] for point in points})
    at = [[point for point in points if point["env_steps"] == step] for step in steps]
    values = [[point[key] for point in seeds] for seeds in at]
    unit = 1e6 if over == "env_steps" else 1.0
    places = [np.mean([point[over] for point in seeds]) / unit for seeds in at]
    axis.plot(places, list(map(np.mean, values)), color=color, label=label)
    axis.fill_between(places, list(map(min, values)), list(map(max, values)), color=color, alpha=0.15, linewidth=0)
    axis.grid(alpha=0.3)
