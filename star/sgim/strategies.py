"""What SGIM decides about an epoch of B environments: whose goals, whose way, whose help.

    alone    autonomous      the three levels as ever
             babbling        random subgoals instead of the Tutor's
             decomposition   first to what is mastered best in some region, then to the goal
    teacher  outcome         the goal is the demonstrated outcome nearest to it (emulation)
             action          so it is, and the Controller imitates the demonstrated actions (mimicry)
             decomposition   along the demonstrated route, region by region and waypoint by waypoint

The competence of an episode is c = 1 - min(1, d_T / d_0), d the distance to the ball of success around the goal.

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

Metrics = dict[str, Array]


class Lesson(struct.PyTreeNode):
    """What each environment practises in an epoch, and how it went."""

    choice: Choice
    """Region, strategy and goal; the goal [B, d] is an abstract point."""
    taught: Bool[Array, "B"]
    """Where SGIM has a say: not in environments that practise reaching random regions."""
    waypoints: Float[Array, "B L d"]
    first: Int[Array, "B"]
    """The waypoint that an episode begins with; L where the Commander decides alone."""
    leg: Int[Array, "B"]
    """The waypoint that is next; L where all are passed."""
    away: Float[Array, "B"]
    """d_0, in m."""
    competence: Float[Array, "B"]
    """Of the first episode of the epoch; NaN until it is over."""


def init(config: SgimConfig, abstraction: Abstraction) -> SgimState | None:
    """Nothing practised yet; None if nothing is left to SGIM."""
    if not config.enabled:
        return None
    costs = [1.0] * len(config.strategies) + [teacher.cost for teacher in config.teachers]
    return selection.init(config.selection, abstraction, costs)


def assign(
    config: SgimConfig,
    state: SgimState,
    teachers: Sequence[Demonstrations],
    *,
    start: Float[Array, "B d"],
    goal: Float[Array, "B d"],
    taught: Bool[Array, "B"],
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
        drawn = jax.random.categorical(turn_key, jnp.where(present, 0.0, -jnp.inf), shape=taught.shape)
        choice = choice.replace(strategy=drawn)
    elif config.unaided:
        alone = jax.random.uniform(turn_key, taught.shape) < selection.competence(state)[choice.region]
        asks = choice.strategy >= len(config.strategies)
        choice = choice.replace(strategy=jnp.where(asks & alone, 0, choice.strategy))
    choice = _within_budget(config, state, choice, taught)
    return _prepare(config, state, teachers, choice, start=start, taught=taught, key=via_key)


def available(config: SgimConfig, state: SgimState, *, key: Array) -> Bool[Array, "S"]:
    """Which strategies there are in this epoch: all alone, and the teachers who are there and not exhausted."""
    alone, asked = len(config.strategies), state.episodes.sum(axis=0)
    share = jnp.asarray([1.0] * alone + [teacher.availability for teacher in config.teachers])
    return (jax.random.uniform(key, share.shape) < share) & (asked < _budgets(config))


def impose(
    config: SgimConfig, lesson: Lesson, position: Float[Array, "B d"]
) -> tuple[Lesson, Float[Array, "B d"], Bool[Array, "B"]]:
    """The lesson with all waypoints passed that are near to `position`, the next one, and whether there is one."""
    length = lesson.waypoints.shape[1]
    order = jnp.arange(length)
    near = jnp.linalg.norm(lesson.waypoints - position[:, None], axis=-1) < config.waypoint_radius
    met = near & (order >= lesson.leg[:, None])
    leg = jnp.maximum(lesson.leg, jnp.max(jnp.where(met, order + 1, 0), axis=1))
    lesson = lesson.replace(leg=leg)
    return lesson, coming(lesson), leg < length


def coming(lesson: Lesson) -> Float[Array, "B d"]:
    """The next waypoint; the last one where all are passed."""
    leg = jnp.minimum(lesson.leg, lesson.waypoints.shape[1] - 1)
    return jnp.take_along_axis(lesson.waypoints, leg[:, None, None], axis=1)[:, 0]


def onward(
    lesson: Lesson,
    position: Float[Array, "B d"],
    lower: Float[Array, "B d"],
    upper: Float[Array, "B d"],
    *,
    parts: int = 16,
) -> tuple[Float[Array, "B d"], Bool[Array, "B"]]:
    """Where the way from `position` by the waypoints to come first leaves the box, and whether it does.

    It is looked for at `parts` points on each straight leg.
    """
    to_come = jnp.arange(lesson.waypoints.shape[1]) >= lesson.leg[:, None]
    points = _along(position, jnp.where(to_come[..., None], lesson.waypoints, position[:, None]), parts)
    outside = jnp.any((points < lower[:, None]) | (points >= upper[:, None]), axis=-1)
    first = jnp.argmax(outside, axis=1)
    return jnp.take_along_axis(points, first[:, None, None], axis=1)[:, 0], outside.any(axis=1)


def babbles(config: SgimConfig, lesson: Lesson) -> Bool[Array, "B"]:
    """Which environments are to follow random subgoals."""
    if "babbling" not in config.strategies:
        return jnp.zeros(lesson.taught.shape, bool)
    return lesson.taught & (lesson.choice.strategy == config.strategies.index("babbling"))


def guided(config: SgimConfig, lesson: Lesson) -> Bool[Array, "B"]:
    """Where a teacher chooses the Commander's targets now."""
    return (lesson.leg < lesson.waypoints.shape[1]) & (lesson.choice.strategy >= len(config.strategies))


def ways(
    config: SgimConfig, lesson: Lesson, start: Float[Array, "B d"], *, most: int = 64, parts: int = 16
) -> tuple[Float[Array, "N T d"], Float[Array, "N"]]:
    """The ways that teachers lead from `start`, at most so many, and which of them are some (1, else 0).

    They are given as points, `parts` on each straight leg.
    """
    weight, which = jax.lax.top_k(guided(config, lesson).astype(jnp.float32), min(most, len(start)))
    return _along(start[which], lesson.waypoints[which], parts), weight


def begin(lesson: Lesson, distance: Float[Array, "B"], *, radius: float) -> Lesson:
    """The lesson at the start of its episodes, `distance` m from the goals."""
    return lesson.replace(away=jnp.maximum(distance - radius, 0.0))


def grade(lesson: Lesson, over: Bool[Array, "B"], distance: Float[Array, "B"], *, radius: float) -> Lesson:
    """Take down the competence of those first episodes that are `over`, `distance` m from their goals."""
    away = jnp.maximum(distance - radius, 0.0)
    competence = jnp.where(away > 0, 1 - jnp.minimum(1.0, away / jnp.maximum(lesson.away, 1e-6)), 1.0)
    return lesson.replace(competence=jnp.where(over & jnp.isnan(lesson.competence), competence, lesson.competence))


def learn(config: SgimConfig, state: SgimState, lesson: Lesson) -> tuple[SgimState, Metrics]:
    """Take in an epoch whose episodes are all graded."""
    weight = lesson.taught.astype(jnp.float32)
    taught = jnp.maximum(weight.sum(), 1.0)
    after = selection.update(config.selection, state, lesson.choice, lesson.competence, weight=weight)
    metrics = {"competence": jnp.sum(jnp.where(lesson.taught, lesson.competence, 0.0)) / taught}
    for number, name in enumerate(config.names):
        metrics[f"share_{name}"] = jnp.sum(weight * (lesson.choice.strategy == number)) / taught
    for number, teacher in enumerate(config.teachers, len(config.strategies)):
        metrics[f"queries_{teacher.name}"] = after.episodes[:, number].sum()
    return after, metrics | {"refused": after.refused}


def attraction(config: SgimConfig, state: SgimState) -> Float[Array, "R"] | None:
    """How the Commander's random targets are drawn: as regions to practise are; None if evenly."""
    if not config.exploration:
        return None
    return selection.probabilities(config.selection, state).sum(axis=-1)


def urgency(config: SgimConfig, state: SgimState) -> Float[Array, "R"] | float:
    """How much there is to find out by examining edges that lead to each region, from 0 to 1.

    Most where it is reached half of the time and no progress is made; a tenth of that where nothing is to be expected.
    """
    if not config.refinement:
        return 1.0
    mastery = selection.competence(state)
    standing = 1 - jnp.minimum(jnp.abs(selection.progress(state)), 1.0)
    return 0.1 + 0.9 * 4 * mastery * (1 - mastery) * standing


def mimicking(config: SgimConfig, lesson: Lesson, teacher: int) -> Float[Array, ""]:
    """Share of the environments that imitate the actions of the teacher with this number."""
    return jnp.mean(lesson.taught & (lesson.choice.strategy == len(config.strategies) + teacher))


class Shown(struct.PyTreeNode):
    """M demonstrated actions, the states they were done in, those l steps later at most, and the outcomes."""

    state: Float[Array, "M state"]
    later: Float[Array, "M state"]
    action: Float[Array, "M act"]
    outcome: Float[Array, "M d"]


def shown(demos: Demonstrations, period: int, *, size: int, key: Array) -> Shown:
    """`size` steps drawn from the trajectories, each seen as a step towards the end of its segment of `period`."""
    assert demos.states is not None
    assert demos.actions is not None
    assert demos.lengths is not None
    which_key, when_key = jax.random.split(key)
    which = jax.random.randint(which_key, (size,), 0, len(demos.outcomes))
    length = demos.lengths[which]
    when = jnp.floor(jax.random.uniform(when_key, (size,)) * length).astype(int)
    end = jnp.minimum((when // period + 1) * period, length)
    return Shown(
        state=demos.states[which, when],
        later=demos.states[which, end],
        action=demos.actions[which, when],
        outcome=demos.outcomes[which],
    )


def _prepare(
    config: SgimConfig,
    state: SgimState,
    teachers: Sequence[Demonstrations],
    choice: Choice,
    *,
    start: Float[Array, "B d"],
    taught: Bool[Array, "B"],
    key: Array,
) -> Lesson:
    """What the chosen strategies make of goals and ways."""
    length = max([1, *(demos.waypoints.shape[1] for demos in teachers)])
    goal = choice.goal
    waypoints, guided = jnp.repeat(goal[:, None], length, axis=1), jnp.zeros(len(goal), bool)
    if "decomposition" in config.strategies:
        mine = choice.strategy == config.strategies.index("decomposition")
        via = jax.random.randint(key, mine.shape, 0, state.abstraction.count)
        by_way_of = selection.mastered(state)[via]
        waypoints, guided = jnp.where(mine[:, None, None], by_way_of[:, None], waypoints), guided | mine
    for number, (teacher, demos) in enumerate(zip(config.teachers, teachers, strict=True), len(config.strategies)):
        mine = taught & (choice.strategy == number)
        if teacher.kind == "decomposition":
            route = demos.waypoints[nearest(demos, start, choice.goal)]
            route = jnp.pad(route, ((0, 0), (0, length - route.shape[1]), (0, 0)), mode="edge")
            waypoints, guided = jnp.where(mine[:, None, None], route, waypoints), guided | mine
        else:
            shown = demos.outcomes[nearest(demos, start if teacher.kind == "action" else None, choice.goal)]
            goal = jnp.where(mine[:, None], shown, goal)
    first = jnp.where(guided & taught, 0, length)
    return Lesson(
        choice=choice.replace(goal=goal, region=regions.locate(state.abstraction, goal)),
        taught=taught,
        waypoints=waypoints,
        first=first,
        leg=first,
        away=jnp.zeros(len(goal)),
        competence=jnp.full(len(goal), jnp.nan, jnp.float32),
    )


def _along(start: Float[Array, "N d"], waypoints: Float[Array, "N L d"], parts: int) -> Float[Array, "N P d"]:
    """Points on the way from `start` by the waypoints, `parts` on each straight leg, both its ends included."""
    corners = jnp.concatenate([start[:, None], waypoints], axis=1)
    share = jnp.linspace(0.0, 1.0, parts)[:, None]
    points = corners[:, :-1, None] + share * (corners[:, 1:] - corners[:, :-1])[:, :, None]
    return points.reshape(len(start), -1, start.shape[-1])


def _within_budget(config: SgimConfig, state: SgimState, choice: Choice, taught: Bool[Array, "B"]) -> Choice:
    """Where a teacher was asked more often than is allowed, the first strategy instead."""
    asked = jax.nn.one_hot(choice.strategy, len(config.names)) * taught[:, None]
    number = state.episodes.sum(axis=0) + jnp.cumsum(asked, axis=0)
    mine = choice.strategy[:, None]
    over = jnp.take_along_axis(number, mine, axis=1)[:, 0] > _budgets(config)[choice.strategy]
    return choice.replace(strategy=jnp.where(over & taught, 0, choice.strategy))


def _budgets(config: SgimConfig) -> Float[Array, "S"]:
    return jnp.asarray(
        [jnp.inf] * len(config.strategies) + [teacher.max_queries or jnp.inf for teacher in config.teachers]
    )
