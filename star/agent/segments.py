"""The record of one segment, the l env steps under one subgoal: what every level learns from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from star.abstraction.regions import Box

Policy = Callable[[Float[Array, "*batch state"], Float[Array, "*batch m"]], Float[Array, "*batch act"]]
"""Actions of the level below in states under subgoals."""


class Choice(struct.PyTreeNode):
    """A Tutor's observation and action, and the subgoal that it stands for; without a Tutor the subgoal alone."""

    subgoal: Float[Array, "B m"]
    seen: Any = ()
    action: Any = ()


class Segment(struct.PyTreeNode):
    """A segment of B environments, step by step: leading axes [l, B], or [l + 1, B] with both its ends.

    `alive` is 1 until the environment has ended. `ended` is 1 where an episode ends before its time, `terminated` where
    nothing is to be bootstrapped either, and `arrived` where success ended it. `non_finite` and `overflow` are 1 where
    the simulator failed.
    """

    obs: Float[Array, "l+1 B obs"]
    seen: Float[Array, "l+1 B seen"]
    """The Controller's observations."""
    subgoal: Float[Array, "l+1 B m"]
    action: Float[Array, "l B act"]
    terminated: Float[Array, "l B"]
    ended: Float[Array, "l B"]
    success: Float[Array, "l B"]
    arrived: Float[Array, "l B"]
    distance: Float[Array, "l B"]
    alive: Float[Array, "l B"]
    non_finite: Float[Array, "l B"]
    overflow: Float[Array, "l B"]
    box: Box
    """The target box, [B], under which all of it happened."""
    choice: Choice
    """The Tutor's, [B]."""
    recorded: Any = None
    """The parts that the `Record` given to `play.segment` kept."""

    @property
    def lost(self) -> Float[Array, "B"]:
        """1 where the task was terminated in the segment."""
        return jnp.max(self.terminated * self.alive, axis=0)

    @property
    def over(self) -> Float[Array, "B"]:
        """1 where the episode ended before its time in the segment."""
        return jnp.max(self.ended * self.alive, axis=0)
