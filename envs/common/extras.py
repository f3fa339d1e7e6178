"""Installing optional packages: a command that can be pasted, for a clone and for an installed wheel."""

from __future__ import annotations

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

_DISTRIBUTION = "star-rl"
_ROOT = Path(__file__).parents[2]


def install(*extras: str) -> str:
    """`pip install ...` for these extras of `pyproject.toml`.

    From a clone it installs the clone with them. A wheel is on no index, so there it names the packages themselves.
    """
    if (_ROOT / "pyproject.toml").is_file():
        return shlex.join(["pip", "install", f"{_ROOT}[{','.join(extras)}]"])
    return shlex.join(["pip", "install", *(one for extra in extras for one in _packages(extra))])


def _packages(extra: str) -> list[str]:
    """An extra's entry in the wheel's own metadata."""
    try:
        found = requires(_DISTRIBUTION) or []
    except PackageNotFoundError:  # copied, not installed
        found = []
    wanted = re.compile(rf"""extra == ['"]{extra}['"]""")
    return [line.partition(";")[0].strip() for line in found if wanted.search(line)] or [f"{_DISTRIBUTION}[{extra}]"]
