"""The trained agents that come with this package, by name, as `ant_maze`. Each is a run that only acts, as one file."""

from __future__ import annotations

import atexit
import difflib
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path

_IN_WHEEL = Path(__file__).parents[1] / "agents"
_IN_CLONE = Path(__file__).parents[2] / "results" / "agents"

FOLDER = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CLONE
_places: set[Path] = set()  # of agents that are unpacked


def names() -> list[str]:
    """All of them."""
    return sorted(path.stem for path in FOLDER.glob("*.zip"))


def find(run_dir: Path) -> Path:
    """The folder `run_dir`; where there is none, that of the agent of this name, kept until this process ends."""
    name = run_dir.as_posix()
    return _unpacked(name) if not os.path.lexists(run_dir) and name in names() else run_dir


def is_unpacked(run_dir: Path) -> bool:
    """True if `find` has unpacked an agent there, so that the folder goes with this process."""
    return run_dir in _places


def told(run_dir: Path) -> str:
    """`run_dir` in the words of who gave it: the name of an agent that `find` has unpacked there."""
    return run_dir.name if is_unpacked(run_dir) else str(run_dir)


def near(run_dir: Path) -> str:
    """` (did you mean ...?)` with the name that is most like `run_dir`, or nothing."""
    matches = difflib.get_close_matches(run_dir.as_posix(), names(), n=1, cutoff=0.7)
    return f" (did you mean {matches[0]}?)" if matches else ""


@cache
def _unpacked(name: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="star-agent-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    shutil.unpack_archive(FOLDER / f"{name}.zip", folder / name)
    _places.add(folder / name)
    return folder / name
