"""Tutoring as a kind of experiment: its settings, measures and commands. Light: nothing heavy is imported."""

from __future__ import annotations

from star.config.kinds import Kind, Measure, lazily
from star.tutoring.sections import Config

TUTORING = Kind(
    Config=Config,
    build=lazily("star.tutoring.experiment:Tutoring"),
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
    gone=("teaching.selection.min_side", "teaching.selection.min_width"),
    commands={"discover": lazily("star.tutoring.discover:discover")},
)
