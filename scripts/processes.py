"""Processes that scripts start."""

from __future__ import annotations

import os
from pathlib import Path


def importing(tree: Path) -> dict[str, str]:
    """PYTHONPATH with `tree` before what it holds, for some machines have their packages there."""
    held = os.environ.get("PYTHONPATH")
    return {"PYTHONPATH": os.pathsep.join([str(tree.resolve()), *([held] if held else [])])}
