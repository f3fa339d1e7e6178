"""Tutors: each chooses the next exercise of a student from the scores that this student had so far.

    random      any exercise
    fixed       one skill after another in an order that the graph allows; the next one at a running success > `next`
    zpdes       the zone of proximal development: skills whose prerequisites are validated and that are not mastered;
                in it by the quality of each, its recent gain in success
    progress    a skill by SGIM's interest: where running success grows
    sgim_graph  the same among the skills of that zone

`fixed`, `zpdes` and `sgim_graph` know a graph, and give no exercise that needs a skill with a prerequisite that is not
validated yet, if there is another one. Running success is s <- s + rate (score - s) for each skill that an exercise
needs; a prerequisite is validated above `validated`, a skill mastered above `mastered`.

All functions are of one student; vmap them. n skills, E exercises.

Sources: ZPDES: Clement, Roy, Oudeyer and Lopes, JEDM 2015; interest: `star.sgim.selection`; a tutor by progress on a
graph: S. M. Nguyen's habilitation thesis, chapter 4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import random
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import regions
from star.sgim import selection
from star.sgim.selection import Choice, SgimState
from star.tutoring import graphs
from star.tutoring.sections import TeachingConfig

RECENT = 8  # scores that ZPDES remembers of each skill
KEEPS = 0.75  # share of an old quality that it keeps
EXPLORES = 0.2  # share of its choices that are made evenly


class Plan(struct.PyTreeNode):
    """A tutor's knowledge of a course."""

    needs: Bool[Array, "E n"]
    parents: Bool[Array, "n n"]


class Seen(struct.PyTreeNode):
    """Every tutor's memory of a student."""

    success: Float[Array, "n"]
    """Running success of each skill."""
    own: Any
    """One tutor's own memory."""


class Tutor(NamedTuple):
    """One tutor's choice."""

    init: Callable[[TeachingConfig, int], Any]
    """(settings, n) -> its own memory"""
    choose: Callable[..., Int[Array, ""]]
    """(settings, plan, seen, *, key) -> exercise"""
    learn: Callable[..., Any]
    """(settings, plan, seen before, running success after [n], needed [n], score) -> its own memory"""


def init(config: TeachingConfig, skills: int) -> Seen:
    """Nothing seen yet."""
    return Seen(success=jnp.zeros(skills), own=TUTORS[config.tutor].init(config, skills))


def choose(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    """The next exercise."""
    return TUTORS[config.tutor].choose(config, plan, seen, key=key)


def update(config: TeachingConfig, plan: Plan, seen: Seen, exercise: Int[Array, ""], score: Bool[Array, ""]) -> Seen:
    """The knowledge after an exercise."""
    needed = plan.needs[exercise]
    success = seen.success + jnp.where(needed, config.rate * (score - seen.success), 0.0)
    own = TUTORS[config.tutor].learn(config, plan, seen, success, needed, score)
    return Seen(success=success, own=own)


def locked(config: TeachingConfig, plan: Plan, seen: Seen) -> Bool[Array, "n"]:
    """The skills with a prerequisite that is not validated."""
    return (plan.parents & (seen.success <= config.validated)).any(axis=-1)


def zone(config: TeachingConfig, plan: Plan, seen: Seen) -> Bool[Array, "n"]:
    """The skills to practise: not locked and not mastered; those not locked if all of these are mastered."""
    free = ~locked(config, plan, seen)
    within = free & (seen.success < config.mastered)
    return jnp.where(within.any(), within, free)


def exercise_for(config: TeachingConfig, plan: Plan, seen: Seen, skill: Array, *, key: Array) -> Int[Array, ""]:
    """An exercise that needs `skill`, drawn evenly: of those that need no locked skill, if there is one."""
    needing = plan.needs[:, skill]
    fair = needing & ~(plan.needs & locked(config, plan, seen)).any(axis=-1)
    return _evenly(jnp.where(fair.any(), fair, needing), key=key)


def _evenly(mask: Bool[Array, "k"], *, key: Array) -> Int[Array, ""]:
    return random.categorical(key, jnp.where(mask, 0.0, -jnp.inf))


def _evenly_in_all(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    return random.randint(key, (), 0, len(plan.needs))


def _nothing(config: TeachingConfig, skills: int) -> tuple[()]:
    return ()


def _learn_nothing(config: TeachingConfig, plan: Plan, seen: Seen, *_: Array) -> Any:
    return seen.own


def _first(config: TeachingConfig, skills: int) -> Int[Array, ""]:
    return jnp.zeros((), jnp.int32)


def _in_order(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    """For the skill whose turn it is; after the last one for any skill."""
    turn_key, exercise_key = random.split(key)
    n = len(plan.parents)
    turn = jnp.where(seen.own < n, seen.own, random.randint(turn_key, (), 0, n))
    return exercise_for(config, plan, seen, _order(plan)[turn], key=exercise_key)


def _pass_on(config: TeachingConfig, plan: Plan, seen: Seen, success: Array, *_: Array) -> Int[Array, ""]:
    """Whose turn it is after an exercise: n after all of them."""
    n = len(plan.parents)
    done = success[_order(plan)[jnp.minimum(seen.own, n - 1)]] > config.next
    return seen.own + (done & (seen.own < n))


def _order(plan: Plan) -> Int[Array, "n"]:
    """The skills, each after its prerequisites."""
    return jnp.argsort(graphs.depth(plan.parents))


class Quality(struct.PyTreeNode):
    """ZPDES's memory of each skill."""

    scores: Float[Array, "n RECENT"]
    """The latest scores, the newest last; 0 before the first."""
    quality: Float[Array, "n"]


def _no_quality(config: TeachingConfig, skills: int) -> Quality:
    return Quality(scores=jnp.zeros((skills, RECENT)), quality=jnp.zeros(skills))


def _by_quality(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    """A skill of the zone in proportion to its quality, or evenly with probability `EXPLORES`."""
    skill_key, exercise_key = random.split(key)
    inside = zone(config, plan, seen)
    quality = jnp.where(inside, seen.own.quality, 0.0)
    evenly = inside / inside.sum()
    share = jnp.where(quality.sum() > 0, quality / jnp.maximum(quality.sum(), 1e-9), evenly)
    skill = random.categorical(skill_key, jnp.log((1 - EXPLORES) * share + EXPLORES * evenly))
    return exercise_for(config, plan, seen, skill, key=exercise_key)


def _learn_quality(
    config: TeachingConfig, plan: Plan, seen: Seen, success: Array, needed: Array, score: Array
) -> Quality:
    """Quality follows the gain: the mean of the newer half of the latest scores less that of the older half."""
    scores = jnp.roll(seen.own.scores, -1, axis=-1).at[:, -1].set(score)
    gain = scores[:, RECENT // 2 :].mean(axis=-1) - scores[:, : RECENT // 2].mean(axis=-1)
    quality = KEEPS * seen.own.quality + (1 - KEEPS) * jnp.maximum(gain, 0.0)
    return Quality(
        scores=jnp.where(needed[:, None], scores, seen.own.scores),
        quality=jnp.where(needed, quality, seen.own.quality),
    )


def _no_progress(config: TeachingConfig, skills: int) -> SgimState:
    """One region for each skill, one strategy: to practise."""
    cuts = [[float(i) for i in range(1, skills)]]
    space = regions.create(([0.0], [float(skills)]), cuts, max_regions=skills)
    return selection.init(config.selection, space, [1.0])


def _by_progress(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    """A skill by its interest, whatever the graph."""
    skill_key, exercise_key = random.split(key)
    skill = selection.select(config.selection, seen.own, key=skill_key).region
    return _evenly(plan.needs[:, skill], key=exercise_key)


def _by_progress_in_zone(config: TeachingConfig, plan: Plan, seen: Seen, *, key: Array) -> Int[Array, ""]:
    """A skill of the zone by its interest."""
    skill_key, exercise_key = random.split(key)
    inside = zone(config, plan, seen)
    skill = selection.select(config.selection, seen.own, admissible=inside, key=skill_key).region
    return exercise_for(config, plan, seen, skill, key=exercise_key)


def _learn_progress(
    config: TeachingConfig, plan: Plan, seen: Seen, success: Array, needed: Array, score: Array
) -> SgimState:
    """One block: the competence in each skill needed is its running success."""
    n = len(success)
    none = jnp.zeros(n, jnp.int32)
    choice = Choice(region=jnp.arange(n), strategy=none, goal=jnp.zeros((n, 1)), mode=none, log_prob=jnp.zeros(n))
    return selection.update(config.selection, seen.own, choice, success, weight=needed.astype(jnp.float32))


TUTORS: Mapping[str, Tutor] = {
    "random": Tutor(_nothing, _evenly_in_all, _learn_nothing),
    "fixed": Tutor(_first, _in_order, _pass_on),
    "zpdes": Tutor(_no_quality, _by_quality, _learn_quality),
    "progress": Tutor(_no_progress, _by_progress, _learn_progress),
    "sgim_graph": Tutor(_no_progress, _by_progress_in_zone, _learn_progress),
}
