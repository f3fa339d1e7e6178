"""Subgoals: points set by a Tutor, or the target box itself without one.

Both are relative to the agent and move with it: h(s, g, s') = s + g - s', so that they stay where they are.

Source: points, HIRO (Nachum et al. 2018), section 3.2; boxes, GARA (Zadem, Mover and Nguyen 2023).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from star.abstraction.regions import Box
from star.spec import Spec


class Points(NamedTuple):
    """Displacements of the pose, p numbers."""

    size: int

    def moved(
        self, subgoal: Float[Array, "*batch p"], before: Float[Array, "*batch p"], after: Float[Array, "*batch p"]
    ) -> Float[Array, "*batch p"]:
        """The same subgoal seen from the pose `after` instead of `before`."""
        return subgoal - (after - before)

    def distance(self, subgoal: Float[Array, "*batch p"]) -> Float[Array, "*batch"]:
        """Distance to the subgoal."""
        return jnp.linalg.norm(subgoal, axis=-1)

    def ways(self, subgoal: Float[Array, "*batch p"]) -> Float[Array, "*batch p"]:
        """The subgoal as displacements that can be turned about z."""
        return subgoal

    def middle(self, subgoal: Float[Array, "*batch p"]) -> Float[Array, "*batch p"]:
        """The point itself."""
        return subgoal

    def asking(self, way: Float[Array, "*batch p"]) -> Float[Array, "*batch p"]:
        """The subgoal that asks for the displacement `way`."""
        return way

    def demonstrated(
        self, spec: Spec, state: Float[Array, "M state"], later: Float[Array, "M state"], outcome: Float[Array, "M d"]
    ) -> Float[Array, "M p"]:
        """The subgoal of who came from `state` to the state `later`, on the way to `outcome`."""
        return spec.pose(later) - spec.pose(state)


class Boxes(NamedTuple):
    """Lower and upper corner of a box, 2d numbers."""

    size: int
    margin: float | Array
    """Half-width of the box around a point."""

    def moved(
        self, subgoal: Float[Array, "*batch m"], before: Float[Array, "*batch d"], after: Float[Array, "*batch d"]
    ) -> Float[Array, "*batch m"]:
        """The same box seen from the position `after` instead of `before`."""
        return subgoal - jnp.tile(after - before, 2)

    def distance(self, subgoal: Float[Array, "*batch m"]) -> Float[Array, "*batch"]:
        """Distance to the nearest point of the box."""
        return jnp.linalg.norm(self.nearest(subgoal), axis=-1)

    def ways(self, subgoal: Float[Array, "*batch m"]) -> Float[Array, "*batch m"]:
        """The nearest point of the box and its centre: turned about z, a box is no box."""
        return jnp.concatenate([self.nearest(subgoal), self.middle(subgoal)], axis=-1)

    def middle(self, subgoal: Float[Array, "*batch m"]) -> Float[Array, "*batch d"]:
        """The centre of the box."""
        return jnp.asarray(sum(jnp.split(subgoal, 2, axis=-1))) / 2

    def asking(self, way: Float[Array, "*batch d"]) -> Float[Array, "*batch m"]:
        """The box around where the displacement `way` leads."""
        return Box.around(way, self.margin).corners

    def demonstrated(
        self, spec: Spec, state: Float[Array, "M state"], later: Float[Array, "M state"], outcome: Float[Array, "M d"]
    ) -> Float[Array, "M m"]:
        """The box around the `outcome` of who was in `state`."""
        return self.asking(outcome - spec.abstract(state))

    def nearest(self, subgoal: Float[Array, "*batch m"]) -> Float[Array, "*batch d"]:
        """The point of the box that is nearest to the agent."""
        lower, upper = jnp.split(subgoal, 2, axis=-1)
        return jnp.maximum(lower, 0.0) + jnp.minimum(upper, 0.0)
