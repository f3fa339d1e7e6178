"""STAR as a kind of experiment: its settings, its measures and its own commands. Light: nothing heavy is imported."""

from __future__ import annotations

from star.agent import notices
from star.agent.migrations import FORMAT, TO_NEXT
from star.agent.sections import Config
from star.config.kinds import Kind, Measure, Notices, lazily


def _episodes(config: Config) -> int:
    return config.trainer.eval_episodes


def _agent(config: Config) -> str:
    """By the levels that there are."""
    if config.commander.enabled:
        return "STAR" if config.tutor.enabled else "GARA"
    if not config.tutor.enabled:
        return "flat"
    return "HRAC" if config.tutor.adjacency.enabled else "HIRO"


STAR = Kind(
    Config=Config,
    build=lazily("star.agent.experiment:Star"),
    measures=(
        Measure("success_final", label="success at the last step", where="on test goals", episodes=_episodes),
        Measure("success_any", label="success at any step", where="on test goals", episodes=_episodes),
        Measure("time_at_goal", label="env steps at the goal", where="on test goals"),
    ),
    title=lambda config: config.env.name,
    agent=_agent,
    unit="env steps",
    tables="regions",
    row={"lower": list, "upper": list, "chosen": list},
    # not known yet; what the environment has repaired
    may_be_nan=("graph/error", "sgim/mean", "upcoming/graph/error", "upcoming/sgim/mean", "env/non_finite"),
    notices=Notices(notices.KEYS, notices.notices),
    levels={
        "commander": ("commander/reward", None, "commander/td_error"),
        "tutor": ("tutor/reward", "tutor/actor_loss", "tutor/critic_loss"),
        "controller": ("controller/reward", "controller/actor_loss", "controller/critic_loss"),
        "forward model": (None, None, "forward_model/loss"),
    },
    format=FORMAT,
    migrations=TO_NEXT,
    harmless=("env.engine",),
    older={"tutor.straight": False, "refinement.separate": False},
    gone=(
        "commander.arrival",
        "commander.practice",
        "commander.retry",
        "commander.trust",
        "refinement.neighbours",
        "abstraction.min_share",
        "sgim.selection.min_side",
        "sgim.selection.min_width",
    ),
    anywhere={"env.engine": "auto"},
    commands={
        "evaluate": lazily("star.agent.commands:evaluate"),
        "render": lazily("star.agent.commands:render"),
        "record": lazily("star.agent.commands:record"),
        "envs": lazily("star.agent.commands:envs"),
        "measure": lazily("star.agent.commands:measure"),
        "load": lazily("star.agent.acting:load"),
        "map": lazily("star.agent.growth_map:growth_map"),
    },
)
