"""The config files that come with this package, by name: `ant_maze`, `agents/hiro`, `sweeps/three_values`."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterator
from pathlib import Path

_IN_WHEEL = Path(__file__).parents[1] / "configs"
_IN_CLONE = Path(__file__).parents[2] / "configs"

FOLDER = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CLONE


def names() -> list[str]:
    """All of them, those of experiments first."""
    found = [path.relative_to(FOLDER).with_suffix("").as_posix() for path in FOLDER.rglob("*.yaml")]
    return sorted(found, key=lambda name: (name.count("/"), name))


def find(path: Path, *, beside: Path = Path()) -> Path:
    """The file `path`, from the folder `beside`; where there is none, the config file of this name, if there is one.

    `configs/ant_maze.yaml` names one too, so that commands for a clone work in any folder.
    """
    there = beside / path
    if os.path.lexists(there) and not there.is_dir():
        return there
    shipped = FOLDER / f"{_name(path)}.yaml"
    return shipped if _name(path) in names() else there


def near(path: Path) -> str:
    """` (did you mean ...?)` with the name that is most like `path`, or nothing."""
    matches = difflib.get_close_matches(_name(path), names(), n=1, cutoff=0.7)
    return f" (did you mean {matches[0]}?)" if matches else ""


def described() -> Iterator[tuple[str, str]]:
    """Each name, and the first sentence of the file."""
    for name in names():
        lines = (FOLDER / f"{name}.yaml").read_text("utf-8").splitlines()
        comment = " ".join(
            line.removeprefix("# ") for line in lines[: next(i for i, x in enumerate(lines) if x[:2] != "# ")]
        )
        yield name, comment.partition(". ")[0].removesuffix(".")


def _name(path: Path) -> str:
    return path.as_posix().removeprefix("configs/").removesuffix(".yaml")
