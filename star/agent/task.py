"""The knowledge of the task that all levels share."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from star.abstraction.regions import Box
from star.agent.sections import AgentConfig, Config
from star.agent.subgoals import Boxes, Points
from star.spec import Spec

INSIDE = 0.7  # of the cube inside the ball of success: agents stop at the edge of the box they are sent to


class Task(NamedTuple):
    """The environment, and what is set in it."""

    spec: Spec
    subgoals: Points | Boxes
    """The Controller's subgoals: points by a Tutor, boxes without one."""
    goal_margin: float | Array
    """Half-width of the box around a goal, all of which counts as reached."""

    @classmethod
    def of(cls, config: AgentConfig | Config, spec: Spec) -> Task:
        """The task as the levels of `config` see it."""
        margin = jnp.minimum(config.commander.goal_margin, INSIDE * spec.cube)
        if config.tutor.enabled:
            return cls(spec, Points(len(spec.scale)), margin)
        return cls(spec, Boxes(2 * len(spec.abstract_indices), margin), margin)

    def goal_box(self, point: Float[Array, "*batch d"]) -> Box:
        """The box that stands for a goal at the abstract `point`."""
        return Box.around(point, self.goal_margin)


def first_cuts(config: AgentConfig | Config, spec: Spec) -> list[list[float]]:
    """First cuts of the abstract space: as the task says, or `abstraction.cuts`, or `abstraction.grid`."""
    if config.abstraction.grid is None:
        cuts = spec.region_cuts if config.abstraction.cuts is None else config.abstraction.cuts
        return [list(positions) for positions in cuts]
    parts = (*config.abstraction.grid, *[1] * (len(spec.abstract_indices) - len(config.abstraction.grid)))
    return [np.linspace(low, high, n + 1)[1:-1].tolist() for n, low, high in zip(parts, *spec.space, strict=False)]
