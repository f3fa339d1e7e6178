"""SGIM-SAHT as a kind of experiment: settings, measures, its own commands. Light: nothing heavy is imported."""

from __future__ import annotations

from star.config.kinds import Kind, Measure, lazily
from star.saht.sections import Config


def agent(config: Config) -> str:
    """The name of an algorithm, by its abilities."""
    section = config.saht
    kinds = {teacher.kind for teacher in section.teachers}
    if section.ask_every is not None:
        return "SGIM-D"
    if not section.strategies:
        return "mimicry" if kinds == {"action"} else "teachers alone"
    if section.strategies == ("random",):
        return "random"
    if "procedures" in section.strategies:
        return "SGIM-PB" if kinds else "IM-PB"
    return "SGIM-ACTS" if kinds else "SAGG-RIAC"


def _title(config: Config) -> str:
    return config.world.name


def _agent(config: Config) -> str:
    return agent(config) + (", even choice" if config.saht.choice.random == 1 else "")


SAHT = Kind(
    Config=Config,
    build=lazily("star.saht.experiment:Saht"),
    measures=(Measure("error", better="low", label="mean error", where="on goals of the evaluation"),),
    title=_title,
    agent=_agent,
    unit="iterations",
    in_step=True,
    tables="practice",
    row={"lower": list, "upper": list, "interest": list},
    may_be_nan=("tables/choice/mean", "tables/goals/mean"),  # of `update`, which nobody calls here
    pictures=("curriculum", "strategies", "lengths", "hierarchy", "interest"),
    commands={name: lazily(f"star.saht.commands:{name}") for name in ("envs", "render", "record")},
)
