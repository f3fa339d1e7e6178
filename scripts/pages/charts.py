"""Charts of the documentation: docs/images/NAME.png in 128 colours, a third of the bytes.

The octree keeps lines of like colours apart, which the median cut takes for one.
"""

from __future__ import annotations

import io
from pathlib import Path

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
