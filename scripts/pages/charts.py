"""Charts of the documentation: docs/images/NAME.png in 128 colours, a third of the bytes."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

IMAGES = Path(__file__).parents[2] / "docs" / "images"
COLOURS = 128


def save(figure: Figure, name: str, *, dpi: int) -> None:
    """Draw `figure` as the chart `name`; an older one is replaced."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dpi)
    chart = Image.open(drawn).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    chart.save(IMAGES / f"{name}.png", optimize=True)
