"""SGIM's decisions about an epoch of B environments: whose goals, whose way, whose help.

    alone    autonomous      the three levels as ever
             babbling        random subgoals instead of the Tutor's
             decomposition   first to what is mastered best in some region, then to the goal
    teacher  outcome         the goal is the demonstrated outcome nearest to it (emulation)
             action          so it is, and the Controller imitates the demonstrated actions (mimicry)
             decomposition   along the demonstrated route, region by region and waypoint by waypoint

Source: S. M. Nguyen's habilitation thesis; SGIM-D (Nguyen and Oudeyer 2011), SGIM-ACTS (2012), SGIM-PB (Duminy,
Nguyen, Duhaut 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.abstraction.regions import Abstraction
from star.sgim import selection
from star.sgim.sections import SgimConfig
from star.sgim.selection import Choice, SgimState
from star.sgim.teachers import Demonstrations, nearest


class Lesson(struct.PyTreeNode):
    """The exercise of each environment in an epoch, and its outcome."""

    choice: Choice
    """Region, strategy and goal; the goal [B, d] is an abstract point."""
    waypoints: Float[Array, "B L d"]
    first: Int[Array, "B"]
    """The waypoint that an episode begins with; L where the Commander decides alone."""
    leg: Int[Array, "B"]
    """The waypoint that is next; L where all are passed."""
    away: Float[Array, "B"]
    """d_0, in m."""
    competence: Float[Array, "B"]
    """Of the first episode of the epoch; infinite until it is over."""


def init(config: SgimConfig, abstraction: Abstraction) -> SgimState:
    """Nothing practised yet."""
    costs = [1.0] * len(config.strategies) + [teacher.cost for teacher in config.teachers]
    return selection.init(config.selection, abstraction, costs)


def assign(
    config: SgimConfig,
    state: SgimState,
    teachers: Sequence[Demonstrations],
    *,
    start: Float[Array, "B d"],
    goal: Float[Array, "B d"],
    key: Array,
) -> Lesson:
    """Choose a goal, a strategy and a teacher for each environment; `goal` is the one that the task has drawn."""
    select_key, turn_key, there_key, via_key = jax.random.split(key, 4)
    present = available(config, state, key=there_key)
    keys = jax.random.split(select_key, len(goal))
    if config.goals:
        choice = jax.vmap(lambda key: selection.select(config.selection, state, present, key=key))(keys)
    else:
        region = regions.locate(state.abstraction, goal)
        only = jax.nn.one_hot(region, state.abstraction.capacity, dtype=bool)
        draw = partial(selection.select, config.selection, state, present)
        choice = jax.vmap(lambda only, key: draw(only, key=key))(only, keys).replace(goal=goal)
    if config.ask == "evenly":
        drawn = jax.random.categorical(turn_key, jnp.where(present, 0.0, -jnp.inf), shape=goal.shape[:1])
        choice = choice.replace(strategy=drawn)
    elif config.unaided:
        alone = jax.random.uniform(turn_key, goal.shape[:1]) < selection.competence(state)[choice.region]
        asks = choice.strategy >= len(config.strategies)
        choice = choice.replace(strategy=jnp.where(asks & alone, 0, choice.strategy))
    choice = _within_budget(config, state, choice)
    return _prepare(config, state, teachers, choice, start=start, key=via_key)


def available(config: SgimConfig, state: SgimState, *, key: Array) -> Bool[Array, "S"]:
    """Mask of the strategies of this epoch: all alone, and the teachers who are there and not exhausted."""
    alone, asked = len(config.strategies), state.episodes.sum(axis=0)
    share = jnp.asarray([1.0] * alone + [teacher.availability for teacher in config.teachers])
    return (jax.random.uniform(key, share.shape) < share) & (asked < _budgets(config))


def by_what_is_mastered(
    state: SgimState, *, start: Float[Array, "B d"], goal: Float[Array, "B d"], key: Array
) -> Float[Array, "B d"]:
    """The point mastered best in a region, drawn evenly."""
    via = jax.random.randint(key, goal.shape[:1], 0, state.abstraction.count)
    return selection.mastered(state)[via]


ROUTES = {"decomposition": by_what_is_mastered}
"""Strategies that go to the goal by way of a point: the function that chooses it."""


def _prepare(
    config: SgimConfig,
    state: SgimState,
    teachers: Sequence[Demonstrations],
    choice: Choice,
    *,
    start: Float[Array, "B d"],
    key: Array,
) -> Lesson:
    """Goals and ways by the chosen strategies."""
    length = max([1, *(demos.waypoints.shape[1] for demos in teachers)])
    goal = choice.goal
    waypoints, guided = jnp.repeat(goal[:, None], length, axis=1), jnp.zeros(len(goal), bool)
    for number, name in enumerate(config.strategies):
        if name in ROUTES:
            mine = choice.strategy == number
            via = ROUTES[name](state, start=start, goal=goal, key=key)
            waypoints, guided = jnp.where(mine[:, None, None], via[:, None], waypoints), guided | mine
    for number, (teacher, demos) in enumerate(zip(config.teachers, teachers, strict=True), len(config.strategies)):
        mine = choice.strategy == number
        if teacher.kind == "decomposition":
            route = demos.waypoints[nearest(demos, start, choice.goal)]
            route = jnp.pad(route, ((0, 0), (0, length - route.shape[1]), (0, 0)), mode="edge")
            waypoints, guided = jnp.where(mine[:, None, None], route, waypoints), guided | mine
        else:
            shown = demos.outcomes[nearest(demos, start if teacher.kind == "action" else None, choice.goal)]
            goal = jnp.where(mine[:, None], shown, goal)
    first = jnp.where(guided, 0, length)
    return Lesson(
        choice=choice.replace(goal=goal, region=regions.locate(state.abstraction, goal)),
        waypoints=waypoints,
        first=first,
        leg=first,
        away=jnp.zeros(len(goal)),
        competence=jnp.full(len(goal), jnp.inf, jnp.float32),
    )


def _within_budget(config: SgimConfig, state: SgimState, choice: Choice) -> Choice:
    """The choices, with the first strategy wherever a teacher was asked more often than allowed."""
    asked = jax.nn.one_hot(choice.strategy, len(config.names))
    number = state.episodes.sum(axis=0) + jnp.cumsum(asked, axis=0)
    mine = choice.strategy[:, None]
    over = jnp.take_along_axis(number, mine, axis=1)[:, 0] > _budgets(config)[choice.strategy]
    return choice.replace(strategy=jnp.where(over, 0, choice.strategy))


def _budgets(config: SgimConfig) -> Float[Array, "S"]:
    return jnp.asarray(
        [jnp.inf] * len(config.strategies) + [teacher.max_queries or jnp.inf for teacher in config.teachers]
    )
