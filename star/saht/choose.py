"""The next exercise of a learner, and its record of the progress made: SGIM's selection, in two tables.

`choice` has the tasks as regions, never split, and all strategies. It decides task and strategy. `goals` has regions of
goals, each of one task, and no strategies. It decides the goal, and splits itself. In one table for both, few blocks
would be left for each pair of a small region and a strategy.

A goal is a point [5] there: the task's number + 1/2, and the goal in units of its bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.saht.sections import ChoiceConfig
from star.sgim import cuts, selection
from star.sgim.selection import SgimState

WIDTH = 4  # numbers of a goal
REACH = 0.2
"""The distance from a goal at which competence is 0."""


class Tables(struct.PyTreeNode):
    """All that is known of progress."""

    choice: SgimState
    goals: SgimState


class Choice(NamedTuple):
    """A task, the number of a strategy, and a goal in units of the task's bounds."""

    task: Int[Array, ""]
    strategy: Int[Array, ""]
    goal: Float[Array, "4"]


def init(config: ChoiceConfig, tasks: int, costs: Sequence[float] | Array) -> Tables:
    """Nothing is known yet; `costs` [strategies] are those of an iteration."""
    section = config.selection
    bounds = [0.0], [float(tasks)]
    whole = [0.0] * (1 + WIDTH), [float(tasks)] + [1.0] * WIDTH
    borders = [float(task) for task in range(1, tasks)]
    capacity = max(config.regions, tasks)
    return Tables(
        choice=selection.init(section, regions.create(bounds, [borders], max_regions=tasks), costs),
        goals=selection.init(section, regions.create(whole, [borders] + [[]] * WIDTH, max_regions=capacity), [1.0]),
    )


def probabilities(
    config: ChoiceConfig, choice: SgimState, available: Bool[Array, "M"]
) -> tuple[Float[Array, "S"], Float[Array, "S M"]]:
    """Of each task, and of each strategy in it, as drawn by interest; strategies not `available` have none."""
    worth = selection.interest(config.selection, choice) * available
    return _shares(worth.max(axis=-1), config.tasks, True), _shares(worth, config.sharpness, available)


def _shares(worth: Float[Array, "*n K"], power: Array | float, mask: Array | bool) -> Float[Array, "*n K"]:
    """In proportion to `worth` to a power; even ones where nothing is worth anything."""
    most = worth.max(axis=-1, keepdims=True)
    weight = jnp.where(most > 0, (worth / jnp.where(most > 0, most, 1.0)) ** power, 1.0) * mask
    return weight / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1e-9)


def draw(
    config: ChoiceConfig, tables: Tables, available: Bool[Array, "M"], dimensions: Bool[Array, "S 4"], *, key: Array
) -> Choice:
    """Task, strategy and goal by interest, or in a share `random` evenly.

    Where a task has no dimension the goal is 0, so that no region is ever cut there.
    """
    dice = jax.random.uniform(key, (4 + WIDTH,))
    even = dice[0] < config.random
    by_task, by_strategy = probabilities(config, tables.choice, available)
    task = drawn(jnp.where(even, 1.0, by_task), dice[1])
    strategy = drawn(jnp.where(even, 1.0 * available, by_strategy[task]), dice[2])
    where = tables.goals.abstraction
    mine = where.active & (where.lower[:, 0] <= task) & (task < where.upper[:, 0])
    volume = jnp.prod(where.upper[:, 1:] - where.lower[:, 1:], axis=-1) * mine
    worth = _shares(selection.interest(config.selection, tables.goals)[:, 0] * mine, 1.0, mine)
    region = drawn(volume * jnp.where(even, 1.0, worth), dice[3])
    lower, upper = where.lower[region, 1:], where.upper[region, 1:]
    goal = lower + (upper - lower) * dice[4:]
    return Choice(task, strategy, jnp.where(dimensions[task], goal, 0.0))


def drawn(weights: Float[Array, "n"], die: Float[Array, ""]) -> Int[Array, ""]:
    """A number in proportion to its weight, by a random number in [0, 1)."""
    heap = jnp.cumsum(weights)
    number = jnp.sum(heap <= die * heap[-1])
    last = len(weights) - 1 - jnp.argmax(weights[::-1] > 0)  # rounding must not lead beyond it
    return jnp.minimum(number, last)


def competence(distance: Array) -> Array:
    """1 where a goal was reached exactly, 0 from a distance of `REACH` on."""
    return 1 - jnp.minimum(distance / REACH, 1.0)


class Progress(NamedTuple):
    """The additions of a block: distances of what is nearest in memory, scaled."""

    before: Float[Array, ""]
    """Of the goal, before the block."""
    after: Float[Array, ""]
    """Of the goal, after it."""
    new: Float[Array, "K S"]
    """Of each outcome of the block, from what was known before it."""
    reached: Bool[Array, "K S"]
    """Mask of the tasks in which each iteration had an outcome."""


def told(config: ChoiceConfig, tables: Tables, choice: Choice, seen: Progress) -> Tables:
    """The tables after a block.

    The goal tells how its competence has grown. So does, with less weight, every outcome reached on the way: as a goal
    it would now have competence 1.
    """
    section = config.selection
    grown = competence(seen.after) - competence(seen.before)
    k, tasks = seen.new.shape
    found = (1 - competence(seen.new)).ravel()
    task = jnp.concatenate([choice.task[None], jnp.tile(jnp.arange(tasks), k)])
    weight = jnp.concatenate([jnp.ones(1), config.reached * seen.reached.ravel()])
    strategy = jnp.broadcast_to(choice.strategy, task.shape)
    known = selection.credit(section, tables.choice, task, strategy, jnp.concatenate([grown[None], found]), weight)
    point = jnp.concatenate([choice.task[None] + 0.5, choice.goal])
    region = regions.locate(tables.goals.abstraction, point)[None]
    one, first = jnp.ones(1), jnp.zeros(1, jnp.int32)
    goals = selection.remember(section, tables.goals, region, point[None], competence(seen.after)[None], one)
    return Tables(known, selection.credit(section, goals, region, first, grown[None], one))


def split(config: ChoiceConfig, tables: Tables) -> Tables:
    """The tables after one region of goals was cut where progress differs most, if there is such a cut."""
    return tables.replace(goals=cuts.split(config.selection, tables.goals)[0])
