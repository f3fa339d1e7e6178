"""CHIME as a kind of experiment: settings, measures, its own commands. Light: nothing heavy is imported."""

from __future__ import annotations

from star.config.kinds import Kind, Measure, lazily
from star.saht.chime.sections import Config

_AGENTS = {"emerge": "CHIME", "given": "CHIME, tasks given", "none": "random actions"}

CHIME = Kind(
    Config=Config,
    build=lazily("star.saht.chime.experiment:Chime"),
    measures=(Measure("distance", better="low", label="mean distance of the tests", where="from the goals of tests"),),
    title=lambda config: "room",
    agent=lambda config: _AGENTS[config.chime.tasks],
    unit="actions",
    tables="models",
    row={"models": list, "births": list},
    may_be_nan=("choice/mean",),  # of `update`, which nobody calls here
    pictures=("births", "competence", "hierarchy", "curriculum"),
    commands={name: lazily(f"star.saht.chime.commands:{name}") for name in ("envs", "render", "record")},
)
