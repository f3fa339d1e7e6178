"""The Tutor: chooses, every l env steps, a subgoal on the way to the target region. It never sees g*.

    subgoal  g  = clip(action, -1, 1) * scale           relative to s: to its abstract dimensions, and with a heading
                                                    to the vector ahead of the body
    reward      = -sum over its l steps ||s_t - centre(G)||      (`distance`, published)
             or   ||s_0 - centre(G)|| - ||s_l - centre(G)||      (`progress`)

    act         once a segment
    experience  the segment, as one transition; it learns from `unroll` of them at a time

The box around a goal that is close needs no subgoal on the way to it: with `straight` its centre is the subgoal, in
training and in greedy episodes, and of these decisions nothing is learnt. So agents stay at goals.

If SGIM says so, a teacher sets the subgoal, straight ahead to his waypoint, which the Tutor imitates; or it is
random, of which the Tutor learns nothing.

Source: STAR (ICLR 2024), section 4.1; off-policy correction: HIRO (Nachum et al. 2018), section 3.3.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from star import learners
from star.abstraction.regions import Box
from star.agent.sections import TutorConfig
from star.agent.segments import Choice, Policy, Segment
from star.agent.task import Task
from star.learners.replay import Imitation, Penalty, Transition, flatten, weighted_mean
from star.sgim.lessons import Marks

Metrics = dict[str, Array]

CLOSE = 0.5  # of the farthest subgoal in each dimension: the Controller gets there within a decision or two


class Trace(struct.PyTreeNode):
    """The Controller's observations and actions during one decision of the Tutor, for its off-policy correction."""

    states: Float[Array, "*batch l state"]
    actions: Float[Array, "*batch l act"]
    achieved: Float[Array, "*batch l+1 p"]


def init(key: Array, section: TutorConfig, task: Task) -> Any:
    """The state of its learner, before it has learnt."""
    return learners.init(key, section, example=example(section, task))


def example(section: TutorConfig, task: Task) -> Transition:
    """The shapes of one transition."""
    spec, scalar = task.spec, jnp.zeros(())
    d, p, l = len(spec.abstract_indices), len(spec.scale), section.period
    extras: Any = jnp.zeros(p) if section.adjacency.enabled else ()
    if section.off_policy_correction:
        extras = Trace(
            states=jnp.zeros((l, spec.state_dim)),
            actions=jnp.zeros((l, spec.action_size)),
            achieved=jnp.zeros((l + 1, p)),
        )
    return Transition(
        obs=jnp.zeros(spec.state_dim + 2 * d),
        action=jnp.zeros(p),
        reward=scalar,
        next_obs=jnp.zeros(spec.state_dim + 2 * d),
        terminated=scalar,
        cut=scalar,
        weight=scalar,
        extras=extras,
    )


def observe(section: TutorConfig, task: Task, obs: Float[Array, "*batch obs"], box: Box) -> Float[Array, "*batch seen"]:
    """The state with the bounds of the target box, relative to where the agent is, or as they are."""
    position = task.spec.abstract(obs)
    origin = position if section.relative_bounds else jnp.zeros_like(position)
    return jnp.concatenate([task.spec.state(obs), box.seen_from(origin).corners], axis=-1)


def act(
    section: TutorConfig,
    task: Task,
    state: Any,
    obs: Float[Array, "B obs"],
    box: Box,
    marks: Marks,
    *,
    explore: bool | Bool[Array, "B"],
    key: Array,
) -> Choice:
    """A subgoal for each environment, on the way to its target `box`: drawn to `explore`, else the mean."""
    seen = observe(section, task, obs, box)
    action = learners.act(section, state, seen, explore=explore, key=key)
    if section.straight:
        action = jnp.where(stands_close(task, obs, box)[:, None], _straight(task, obs, box.centre), action)
    if marks.way is not None and marks.way.led is not None:
        action = jnp.where(marks.way.led[:, None], _straight(task, obs, marks.way.point), action)
    if marks.own is not None:
        anything = jax.random.uniform(jax.random.fold_in(key, 1), action.shape, minval=-1.0)
        action = jnp.where(marks.own[:, None], action, anything)
    return Choice(subgoal=subgoal(action, task.spec.scale), seen=seen, action=action)


def stands_close(task: Task, obs: Float[Array, "*batch obs"], box: Box) -> Bool[Array, "*batch"]:
    """True where `box` is no larger than one around a goal, and wholly within half the reach of a subgoal.

    In a dimension in which the agent is between its bounds, it may be larger than that reach.
    """
    half = (box.upper - box.lower) / 2
    small = (half <= 1.01 * task.goal_margin) | ~task.spec.in_goal()  # its corners were rounded
    distance = jnp.abs(box.centre - task.spec.abstract(obs))
    near = (distance + half <= CLOSE * task.spec.scale[: distance.shape[-1]]) | (distance <= half)
    return jnp.all(small & near, axis=-1)


def _straight(task: Task, obs: Float[Array, "*batch obs"], point: Float[Array, "*batch d"]) -> Float[Array, "*batch p"]:
    """The action that aims at an abstract `point`, or as far towards it as a subgoal may lie."""
    return jnp.clip(task.spec.towards(obs, point) / task.spec.scale, -1.0, 1.0)


def subgoal(action: Float[Array, "*batch p"], scale: Float[Array, "p"]) -> Float[Array, "*batch p"]:
    """The relative subgoal that an action in [-1, 1]^p stands for."""
    return jnp.clip(action, -1.0, 1.0) * scale


def experience(
    section: TutorConfig, task: Task, segment: Segment, marks: Marks, *, renewed: Bool[Array, "B"]
) -> Transition:
    """The transition of a segment, [B]; where it is `renewed`, the target box does not outlast the segment."""
    spec = task.spec
    achieved = spec.pose(segment.obs)
    distances = jnp.linalg.norm(spec.abstract(segment.obs) - segment.box.centre, axis=-1)
    lost, over = segment.lost, segment.over
    extras: Any = achieved[0] if section.adjacency.enabled else ()
    if section.off_policy_correction:
        states, actions, path = (
            jnp.swapaxes(x, 0, 1) for x in (spec.state(segment.obs[:-1]), segment.action, achieved)
        )
        extras = Trace(states=states, actions=actions, achieved=path)
    weight = jnp.ones_like(lost)
    if section.straight:
        weight *= ~stands_close(task, segment.obs[0], segment.box)
    if marks.own is not None:
        weight *= marks.own
    if marks.led is not None:  # somebody else's, to be imitated
        weight *= ~marks.led
    return Transition(
        obs=segment.choice.seen,
        action=segment.choice.action,
        reward=reward(section, distances, segment.alive) - section.termination_penalty * lost,
        next_obs=observe(section, task, segment.obs[-1], segment.box),
        terminated=lost,
        cut=jnp.maximum(renewed, over),
        weight=weight,
        extras=extras,
    )


def learn(
    section: TutorConfig,
    task: Task,
    state: Any,
    batch: Transition,
    *,
    below: Policy,
    penalty: Penalty | None,
    imitate: Float[Array, "T B"] | None,
    key: Array,
) -> tuple[Any, Metrics]:
    """Learn from `unroll` segments [T, B].

    `below` is the Controller of today, `penalty` the price of subgoals, and `imitate` the weight of those that teachers
    have set.
    """

    def corrected(replayed: Transition, key: Array) -> Transition:
        return correct(section, replayed, task.spec.scale, below, key=key)

    imitation = None
    if imitate is not None:
        obs, action, weight = flatten((batch.obs, batch.action, imitate))
        imitation = Imitation(obs=obs, action=action, weight=weight)
    relabel = corrected if section.off_policy_correction else None
    state, metrics = learners.update(
        section, state, batch, relabel=relabel, penalty=penalty, imitation=imitation, key=key
    )
    return state, metrics | {"reward": weighted_mean(batch.reward, batch.weight)}


def began(section: TutorConfig, batch: Transition) -> Float[Array, "*batch p"]:
    """The poses in which the subgoals of a batch were set."""
    return batch.extras.achieved[..., 0, :] if section.off_policy_correction else batch.extras


def reward(section: TutorConfig, distances: Float[Array, "states *batch"], alive: Float[Array, "l *batch"]) -> Array:
    """Reward of one decision from the distances to the box's centre before and after each of its env steps.

    `alive` [l, ...] is 0 for steps after the environment had ended; they count for nothing.
    """
    if section.reward == "distance":
        return -section.reward_scale * jnp.sum(distances[1:] * alive, axis=0)
    return section.reward_scale * jnp.sum((distances[:-1] - distances[1:]) * alive, axis=0)


def correct(
    section: TutorConfig, batch: Transition, scale: Float[Array, "p"], below: Policy, *, key: Array
) -> Transition:
    """Replace replayed subgoals by those that make the stored Controller actions most likely today (HIRO).

    Candidates per transition: the stored subgoal, the displacement that happened, and draws from
    N(displacement, (scale / 2)^2), clipped to +-scale. `batch.extras` is a `Trace` [N, l, ...].
    """
    trace: Trace = batch.extras
    moved = (trace.achieved[:, -1] - trace.achieved[:, 0]) / scale
    shape = (section.correction_candidates, *moved.shape)
    drawn = moved + 0.5 * jax.random.normal(key, shape)
    candidates = jnp.clip(jnp.concatenate([batch.action[None], moved[None], drawn]), -1.0, 1.0)

    def log_likelihood(action: Array) -> Float[Array, "N"]:
        path = trace.achieved[:, :1] - trace.achieved[:, :-1]
        goals = action[:, None] * scale + path
        return -0.5 * jnp.sum(jnp.square(trace.actions - below(trace.states, goals)), axis=(-2, -1))

    best = jnp.argmax(jax.vmap(log_likelihood)(candidates), axis=0)
    return batch.replace(action=jnp.take_along_axis(candidates, best[None, :, None], axis=0)[0])
