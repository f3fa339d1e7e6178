"""The Commander's decisions: its memory of the period under way, and the finished ones.

It chooses from the `Roadmap`: today's regions, and which may follow which.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.common.batching import where
from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.refinement import Graph
from star.abstraction.regions import Abstraction, Box, Near
from star.agent.sections import CommanderConfig
from star.agent.task import Task


class Journey(struct.PyTreeNode):
    """The ways of B agents towards their goals."""

    best: Float[Array, "B"]
    """The highest value of a region that each has come to."""
    given: Int[Array, "B R"]
    """The target that each was given last in each region, -1 where it was given none."""


class Memory(struct.PyTreeNode):
    """State of each of the B environments in its Commander period."""

    clock: Int[Array, "B"]
    """Env steps since the period began."""
    region: Int[Array, "B"]
    """Region in which the period began."""
    goal_region: Int[Array, "B"]
    target: Int[Array, "B"]
    box: Box
    start: Float[Array, "B d"]
    goal: Float[Array, "B d"]
    """Point of the goal when the target was chosen."""
    reward: Float[Array, "B"]
    aside: Bool[Array, "B"]
    """True if the box is that around a waypoint, not the target region or the goal's."""
    journey: Journey | None = None
    """The way so far, in greedy episodes of a planner."""


class Decision(struct.PyTreeNode):
    """Finished periods of N streams.

    `weight` is 1 where the period really lasted k env steps, `lost` is 1 where the task was terminated in it,
    `aside` is 1 where what was commanded was a waypoint, which tells nothing of its region, and `shown` is 1 where a
    teacher chose the target. The reward is that for the goal, which was at the point `goal` as the target was chosen.
    """

    region: Int[Array, "N"]
    goal_region: Int[Array, "N"]
    target: Int[Array, "N"]
    reward: Float[Array, "N"]
    next_region: Int[Array, "N"]
    weight: Float[Array, "N"]
    lost: Float[Array, "N"]
    aside: Float[Array, "N"]
    goal: Float[Array, "N d"]
    shown: Float[Array, "N"] | None = None

    @property
    def at_goal(self) -> Bool[Array, "N"]:
        """True if the Tutor was given the goal, not the bounds of a region."""
        return (self.target == self.goal_region) & (self.aside == 0)


class Finished(NamedTuple):
    """Periods that came to their end: what was decided, and where it led."""

    decision: Decision | Any
    outcome: Outcome | Any


class Scene(NamedTuple):
    """The Commander's view of the environments."""

    position: Float[Array, "B d"]
    goal: Float[Array, "B d"]
    success: Float[Array, "B"]
    """1 where the goal counts as reached."""


class Successors(struct.PyTreeNode):
    """Mask of the targets that may follow a region: `greedy` for the best choice, `explore` for the random one.

    Besides, the region of a goal may always follow itself.
    """

    near: Near
    """The regions of each row."""
    greedy: Bool[Array, "R S"]
    explore: Bool[Array, "R S"]


class Roadmap(struct.PyTreeNode):
    """The regions, which targets may follow each of them, and what is believed and wanted of them."""

    abstraction: Abstraction
    allowed: Successors
    believed: Bool[Array, "R S"]
    """Pairs whose targets count as reachable as long as nobody has tried."""
    attraction: Float[Array, "R"] | None = None
    """Random targets are drawn in proportion to it; None: evenly."""

    @classmethod
    def of(
        cls,
        section: CommanderConfig,
        abstraction: Abstraction,
        graph: Graph,
        *,
        attraction: Float[Array, "R"] | None = None,
    ) -> Roadmap:
        """The roadmap of `graph`, under `commander.successors`."""
        near, active = regions.near(abstraction, section.nearest), abstraction.active
        allowed = successors(section.successors, near, reaches=graph.reaches, misses=graph.misses, active=active)
        believed = regions.adjacent(abstraction) & (graph.told >= 0)
        if section.successors != "all":
            believed = graph.reaches | (believed & ~graph.misses)
        return cls(abstraction=abstraction, allowed=allowed, believed=near.pairs(believed), attraction=attraction)


def successors(
    mode: Literal["all", "any", "possible", "known"],
    near: Near,
    *,
    reaches: Bool[Array, "R R"],
    misses: Bool[Array, "R R"],
    active: Bool[Array, "R"],
) -> Successors:
    """Targets allowed from each region by what is known of reachability.

    Random choices leave out the targets shown unreachable. Greedy ones are made among all targets (`any`) or among
    those not shown unreachable (`possible`). A region may be its own target. With `known`, as published, both are made
    among others shown reachable, if there are any. With `all` nothing is left out.
    """
    pairs = active[:, None] & active[near.region]
    possible = pairs & (~near.pairs(misses) | near.home)
    if mode == "all":
        return Successors(near=near, greedy=pairs, explore=pairs)
    if mode != "known":
        return Successors(near=near, greedy=pairs if mode == "any" else possible, explore=possible)
    known = pairs & near.pairs(reaches) & ~near.home
    chosen = jnp.where(known.any(axis=1, keepdims=True), known, possible)
    return Successors(near=near, greedy=chosen, explore=chosen)


def target_box(
    task: Task,
    abstraction: Abstraction,
    target: Int[Array, "B"],
    *,
    around: Bool[Array, "B"],
    point: Float[Array, "B d"],
) -> Box:
    """Bounds that the Tutor is given: those of the target region, or `around` a `point`, g* or a waypoint."""
    whole = Box(lower=abstraction.lower[target], upper=abstraction.upper[target])
    return where(around[:, None] & task.spec.in_goal(), task.goal_box(point), whole)
