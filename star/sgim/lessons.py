"""The life of a lesson: what SGIM has chosen for an epoch, what it says of each decision, and what came of it.

    begin       goals, strategies and teachers for all environments
    mark        at every decision of the Tutor: the waypoints that are passed, and what levels have to know
    restart     where an episode ended early, the lesson begins anew
    end         competences are taken down, and SGIM learns which progress was made
    follow      regions that were cut

The competence of an episode is c = 1 - min(1, d_T / d_0), d the distance to the ball of success around the goal.
`star.sgim.unguided` has the same functions for an agent without SGIM.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs._quiet import State as EnvState
from envs.vector import VectorEnv
from star import devices
from star.abstraction import refinement, regions
from star.abstraction.refinement import Graph
from star.abstraction.regions import Abstraction, Change
from star.sgim import cuts, selection, strategies
from star.sgim.sections import SgimConfig
from star.sgim.selection import SgimState
from star.sgim.strategies import Lesson
from star.sgim.teachers import Demonstrations
from star.spec import Spec

Metrics = dict[str, Array]


class Way(struct.PyTreeNode):
    """Lessons of B environments."""

    target: Int[Array, "B"]
    """The region to command; -1 where that is the Commander's business."""
    aside: Bool[Array, "B"]
    """True if the Tutor is given the box around `point`, not the region."""
    point: Float[Array, "B d"]
    """The next waypoint."""
    led: Bool[Array, "B"] | None
    """True if a teacher sets the subgoal, straight to `point`; None if none ever does."""


class Marks(struct.PyTreeNode):
    """SGIM's part in one decision of each environment; None where it never says anything."""

    own: Bool[Array, "B"] | None = None
    """True if subgoals are the Tutor's own or his teacher's, not random."""
    shown: Bool[Array, "B"] | None = None
    """True if a teacher chooses the target."""
    way: Way | None = None

    @property
    def led(self) -> Bool[Array, "B"] | None:
        """True where a teacher sets the subgoal."""
        return None if self.way is None else self.way.led


class Shown(struct.PyTreeNode):
    """M demonstrated actions, the states they were done in, those l steps later at most, and the outcomes."""

    state: Float[Array, "M state"]
    later: Float[Array, "M state"]
    action: Float[Array, "M act"]
    outcome: Float[Array, "M d"]
    weight: Float[Array, "M"]


init = strategies.init


def begin(
    config: SgimConfig,
    spec: Spec,
    env: VectorEnv,
    state: SgimState,
    graph: Graph,
    teachers: Sequence[Demonstrations],
    env_state: EnvState,
    *,
    key: Array,
) -> tuple[Lesson, EnvState, Graph]:
    """Choose goals, strategies and teachers of all environments.

    Returns the lesson, the environments with its goals, and the graph with what teachers tell of the ways they lead.
    """
    obs = env_state.obs
    position = spec.abstract(obs)
    lesson = strategies.assign(config, state, teachers, start=position, goal=spec.goal_point(obs), key=key)
    env_state = _pursue(spec, env, env_state, lesson, jnp.ones(env.num_envs, bool))
    lesson = lesson.replace(away=jnp.maximum(env_state.metrics["distance"] - spec.success_radius, 0.0))
    if config.detours and config.routes:
        paths, weight = ways(config, lesson, position)
        graph = refinement.tell(graph, state.abstraction, paths, weight)
    return lesson, env_state, graph


def mark(
    config: SgimConfig,
    lesson: Lesson,
    abstraction: Abstraction,
    position: Float[Array, "B d"],
    *,
    due: Bool[Array, "B"],
) -> tuple[Lesson, Marks]:
    """The lesson by now, and what it says of a decision; waypoints are passed where the Commander is `due`."""
    advanced, waypoint, aside = impose(config, lesson, position)
    target = jnp.full(len(due), -1)
    if config.shows_subgoals:  # on a teacher's route the regions that the Commander will have to choose
        region = regions.locate(abstraction, position)
        corners = (corner[region] for corner in (abstraction.lower, abstraction.upper))
        beyond, leaves = onward(advanced, position, *corners)
        leaves &= guided(config, advanced)
        target, aside = jnp.where(leaves, regions.locate(abstraction, beyond), target), aside & ~leaves
    target = jnp.where(aside, regions.locate(abstraction, waypoint), target)
    lesson = lesson.replace(leg=jnp.where(due, advanced.leg, lesson.leg))
    shown = guided(config, lesson)
    led = shown if config.shows_subgoals else None
    return lesson, Marks(~babbles(config, lesson), shown, Way(target, aside, coming(lesson), led))


def restart(
    config: SgimConfig,
    spec: Spec,
    env: VectorEnv,
    lesson: Lesson,
    env_state: EnvState,
    ended: Bool[Array, "B"],
    *,
    distance: Float[Array, "B"],
) -> tuple[Lesson, EnvState]:
    """The lesson anew where an episode `ended` early, `distance` m from its goal, and new episodes with its goals."""
    lesson = grade(lesson, ended, distance, radius=spec.success_radius)
    env_state = _pursue(spec, env, env_state, lesson, ended)
    return lesson.replace(leg=jnp.where(ended, lesson.first, lesson.leg)), env_state


def end(
    config: SgimConfig, spec: Spec, state: SgimState, lesson: Lesson, *, distance: Float[Array, "B"]
) -> tuple[SgimState, Metrics]:
    """SGIM's learning from an epoch whose last episodes ended `distance` m from their goals."""
    over = jnp.ones(distance.shape, bool)
    return learn(config, state, devices.whole(grade(lesson, over, distance, radius=spec.success_radius)))


def follow(state: SgimState, change: Change) -> SgimState:
    """The tables in today's regions."""
    return cuts.follow(state, change)


def demonstrated(
    config: SgimConfig, teachers: Sequence[Demonstrations], lesson: Lesson, *, period: int, key: Array
) -> Shown | None:
    """Actions for the Controller to imitate, as much as environments asked their teachers; None if none show any."""
    batches = []
    for number, (teacher, demos) in enumerate(zip(config.teachers, teachers, strict=True)):
        if teacher.kind == "action":
            drawn = shown(demos, period, size=config.imitation_batch, key=jax.random.fold_in(key, number))
            share = mimicking(config, lesson, number)
            batches.append(drawn.replace(weight=jnp.full(len(drawn.outcome), config.imitation * share)))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *batches) if batches else None


def imitating(config: SgimConfig, led: Bool[Array, "T B"] | None) -> Float[Array, "T B"] | None:
    """The weights with which the Tutor imitates subgoals: those that a teacher has `led` to, of which it is a mean."""
    if led is None:
        return None
    weight = led.astype(jnp.float32)
    return config.imitation * weight / jnp.maximum(weight.mean(), 1e-6)


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
    """The point where the way from `position` by the next waypoints first leaves the box, and True if it does.

    It is looked for at `parts` points on each straight leg.
    """
    to_come = jnp.arange(lesson.waypoints.shape[1]) >= lesson.leg[:, None]
    points = _along(position, jnp.where(to_come[..., None], lesson.waypoints, position[:, None]), parts)
    outside = jnp.any((points < lower[:, None]) | (points >= upper[:, None]), axis=-1)
    first = jnp.argmax(outside, axis=1)
    return jnp.take_along_axis(points, first[:, None, None], axis=1)[:, 0], outside.any(axis=1)


def babbles(config: SgimConfig, lesson: Lesson) -> Bool[Array, "B"]:
    """Mask of environments that follow random subgoals."""
    if "babbling" not in config.strategies:
        return jnp.zeros(lesson.leg.shape, bool)
    return lesson.choice.strategy == config.strategies.index("babbling")


def guided(config: SgimConfig, lesson: Lesson) -> Bool[Array, "B"]:
    """True where a teacher chooses the Commander's targets now."""
    return (lesson.leg < lesson.waypoints.shape[1]) & (lesson.choice.strategy >= len(config.strategies))


def ways(
    config: SgimConfig, lesson: Lesson, start: Float[Array, "B d"], *, most: int = 64, parts: int = 16
) -> tuple[Float[Array, "N T d"], Float[Array, "N"]]:
    """The ways that teachers lead from `start`, at most so many, and which of them are some (1, else 0).

    They are given as points, `parts` on each straight leg.
    """
    weight, which = jax.lax.top_k(guided(config, lesson).astype(jnp.float32), min(most, len(start)))
    return _along(start[which], lesson.waypoints[which], parts), weight


def grade(lesson: Lesson, over: Bool[Array, "B"], distance: Float[Array, "B"], *, radius: float) -> Lesson:
    """Take down the competence of those first episodes that are `over`, `distance` m from their goals."""
    away = jnp.maximum(distance - radius, 0.0)
    competence = jnp.where(away > 0, 1 - jnp.minimum(1.0, away / jnp.maximum(lesson.away, 1e-6)), 1.0)
    return lesson.replace(competence=jnp.where(over & jnp.isinf(lesson.competence), competence, lesson.competence))


def learn(config: SgimConfig, state: SgimState, lesson: Lesson) -> tuple[SgimState, Metrics]:
    """Take in an epoch whose episodes are all graded."""
    after = selection.update(config.selection, state, lesson.choice, lesson.competence)
    metrics = {"competence": lesson.competence.mean()}
    for number, name in enumerate(config.names):
        metrics[f"share_{name}"] = jnp.mean(lesson.choice.strategy == number)
    for number, teacher in enumerate(config.teachers, len(config.strategies)):
        metrics[f"queries_{teacher.name}"] = after.episodes[:, number].sum()
    return after, metrics | {"refused": after.refused}


def attraction(config: SgimConfig, state: SgimState) -> Float[Array, "R"] | None:
    """Weights of the Commander's random targets: as regions to practise are; None if evenly."""
    if not config.exploration:
        return None
    return selection.probabilities(config.selection, state).sum(axis=-1)


def urgency(config: SgimConfig, state: SgimState) -> Float[Array, "R"] | float:
    """Interest in examining edges that lead to each region, from 0 to 1.

    Most where it is reached half of the time and no progress is made; a tenth of that where nothing is to be expected.
    """
    if not config.refinement:
        return 1.0
    mastery = selection.competence(state)
    standing = 1 - jnp.minimum(jnp.abs(selection.progress(state)), 1.0)
    return 0.1 + 0.9 * 4 * mastery * (1 - mastery) * standing


def mimicking(config: SgimConfig, lesson: Lesson, teacher: int) -> Float[Array, ""]:
    """Share of the environments that imitate the actions of the teacher with this number."""
    return jnp.mean(lesson.choice.strategy == len(config.strategies) + teacher)


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
        weight=jnp.ones(size),
    )


def _pursue(spec: Spec, env: VectorEnv, env_state: EnvState, lesson: Lesson, mask: Bool[Array, "B"]) -> EnvState:
    """`env_state` with the goals of the lesson where an episode has just begun (`mask`)."""
    goals = spec.with_goal_point(spec.goal(env_state.obs), lesson.choice.goal)
    return env.with_goals(env_state, goals, mask)


def _along(start: Float[Array, "N d"], waypoints: Float[Array, "N L d"], parts: int) -> Float[Array, "N P d"]:
    """Points on the way from `start` by the waypoints, `parts` on each straight leg, both its ends included."""
    corners = jnp.concatenate([start[:, None], waypoints], axis=1)
    share = jnp.linspace(0.0, 1.0, parts)[:, None]
    points = corners[:, :-1, None] + share * (corners[:, 1:] - corners[:, :-1])[:, :, None]
    return points.reshape(len(start), -1, start.shape[-1])
