"""No Tutor: the Controller is given the target box itself, as in GARA (Zadem, Mover and Nguyen 2023)."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from star.abstraction.regions import Box
from star.agent.sections import TutorConfig
from star.agent.segments import Choice
from star.agent.task import Task


def init(key: Array, section: TutorConfig, task: Task) -> None:
    """Nothing is learnt, so nothing is known."""


def act(
    section: TutorConfig, task: Task, state: None, obs: Float[Array, "B obs"], box: Box, *_: Any, **__: Any
) -> Choice:
    """The target box as the agent sees it."""
    return Choice(subgoal=box.seen_from(task.spec.abstract(obs)).corners)


def experience(*_: Any, **__: Any) -> None:
    """Segments teach it nothing."""


def learn(*_: Any, **__: Any) -> tuple[None, dict[str, Array]]:
    """It stays as it is."""
    return None, {}
