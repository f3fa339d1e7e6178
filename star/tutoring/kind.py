"""Tutoring as a kind of experiment: its settings, measures and commands. Light: nothing heavy is imported."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from star.config.kinds import Kind, Measure
from star.tutoring.sections import Config


def _lazily(module: str, name: str) -> Callable[..., Any]:
    """The function `name` of that module of this package, which is imported when it is first called."""
    return lambda *args, **kwargs: getattr(importlib.import_module(f"star.tutoring.{module}"), name)(*args, **kwargs)


TUTORING = Kind(
    Config=Config,
    build=_lazily("experiment", "Tutoring"),
    measures=(
        Measure("level", label="lasting level, Elo points", where="of all skills"),
        Measure("mastered", label="share of skills mastered"),
    ),
    title=lambda config: f"{config.course.skills} skills",
    agent=lambda config: config.teaching.tutor,
    unit="exercises",
    tables="skills",
    row={"level": list, "mastered": list, "practised": list},
    # SGIM's, before the first exercise of a skill
    may_be_nan=("seen/own/mean",),
    commands={"discover": _lazily("discover", "discover")},
)
