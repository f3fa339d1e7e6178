"""Errors for a person, in one line."""

from __future__ import annotations

import math
import sysconfig
import traceback
from pathlib import Path
from typing import Any

_OURS = [Path(__file__).parents[2] / package for package in ("envs", "star")]


class UserError(ValueError):
    """An error that a person can mend. The message is one line: the key or path, the value, what is allowed.

    The command line prints it and ends with exit code 2.
    """


class Notice(UserWarning):
    """A warning to a person; nothing is refused. The message is one line, and the command line prints it."""


def shown(value: Any, limit: int = 60) -> str:
    """A value that a user gave, as YAML spells it where Python would not, on one line and cut short."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = "nan" if isinstance(value, float) and math.isnan(value) else repr(value)
    except ValueError:  # Python does not write whole numbers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= limit else text[: limit - 3] + "..."


def where_raised(error: BaseException) -> str:
    """An error in one line: its kind, the first line of what it says, and where its author's own code raised it."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _is_authors(Path(frame.filename))]
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}{place}"


def _is_authors(file: Path) -> bool:
    """True if a file is neither this package's, nor an installed one's, nor Python's."""
    elsewhere = {*_OURS, *(Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib"))}
    return file.is_file() and not elsewhere & set(file.parents) and "dist-packages" not in file.parts
