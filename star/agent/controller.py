"""The Controller: moves the body towards the subgoal at every env step, wherever it stands.

    sees      the state without the abstract position, and the relative subgoal g_t; with `frame` body both turned about
              z with the body, so that what was learnt in one direction holds in all; with `frame` map the whole state
              and the subgoal's place
    g_{t+1} = s_t + g_t - s_{t+1}                           the subgoal stays where it is while the agent moves
    reward  = -||s_t + g_t - s_{t+1}||  (`distance`, published)   or   ||g_t|| - ||g_{t+1}||  (`progress`)
              less a penalty for the tilt of the body, and one where the task is terminated

    act         at every env step
    experience  a segment of l env steps under one subgoal, of which it learns at once

Source: STAR (ICLR 2024), section 4.1, after HIRO (Nachum et al. 2018), section 3.2.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from envs.common.batching import where
from star import learners
from star.agent.sections import ControllerConfig
from star.agent.segments import Policy, Segment
from star.agent.task import Task
from star.learners.replay import Imitation, Track, Transition, weighted_mean
from star.sgim.lessons import Shown
from star.spec import Spec

Metrics = dict[str, Array]


def init(key: Array, section: ControllerConfig, task: Task) -> Any:
    """The state of its learner, before it has learnt."""
    return learners.init(key, section, example=example(section, task))


def example(section: ControllerConfig, task: Task) -> Transition:
    """The shapes of one transition."""
    spec, scalar = task.spec, jnp.zeros(())
    seen = observe(section, task, jnp.zeros(spec.state_dim), jnp.zeros(task.subgoals.size))
    return Transition(
        obs=seen,
        action=jnp.zeros(spec.action_size),
        reward=scalar,
        next_obs=seen,
        terminated=scalar,
        cut=scalar,
        weight=scalar,
        extras=_example_extras(section, spec),
    )


def _example_extras(section: ControllerConfig, spec: Spec) -> Any:
    if section.settings.futures:
        return Track(jnp.zeros(len(spec.abstract_indices)), jnp.zeros(()), jnp.zeros(()))
    return jnp.zeros((2, len(spec.scale))) if section.hindsight else ()


def observe(
    section: ControllerConfig, task: Task, state: Float[Array, "*batch state"], subgoal: Float[Array, "*batch m"]
) -> Float[Array, "*batch seen"]:
    """The state without its abstract coordinates, followed by the relative subgoal, both in the axes of `frame`.

    What a full state holds of blocks stays in the world's axes. With `frame` map it is the whole state and the place of
    the subgoal's middle.
    """
    if section.frame == "map":
        place = task.spec.abstract(state)
        return jnp.concatenate([state, place + task.subgoals.middle(subgoal)[..., : place.shape[-1]]], axis=-1)
    if section.frame == "body":
        state, subgoal = task.spec.turned(state, task.subgoals.ways(subgoal))
    kept = np.setdiff1d(np.arange(state.shape[-1]), np.asarray(task.spec.abstract_indices, int))
    return jnp.concatenate([state[..., kept], subgoal], axis=-1)


def act(
    section: ControllerConfig,
    state: Any,
    seen: Float[Array, "*batch seen"],
    *,
    explore: bool | Bool[Array, "*batch"],
    key: Array,
) -> Float[Array, "*batch acts"]:
    """Actions for what is `seen`; the environment clips them to [-1, 1].

    A learner that decides for `chunk` env steps at once gives the actions of all of them, one after another.
    """
    return learners.act(section, state, seen, explore=explore, key=key)


def policy(section: ControllerConfig, task: Task, state: Any, *, key: Array) -> Policy:
    """Its actions in states [..., state] under subgoals [..., m], without exploration; of a chunk the first."""

    def actions(states: Array, subgoals: Array) -> Array:
        decided = act(section, state, observe(section, task, states, subgoals), explore=False, key=key)
        return decided[..., : task.spec.action_size]

    return actions


def experience(
    section: ControllerConfig, task: Task, segment: Segment, *, env_steps: Float[Array, ""] | float
) -> Transition:
    """The transitions of a segment, [l, B]; `env_steps` are those of all environments before the epoch."""
    last = jnp.zeros_like(segment.alive).at[-1].set(1.0)
    before, after = segment.subgoal[:-1], segment.subgoal[1:]
    lost = price(section, task.spec, segment.obs[1:], segment.terminated, env_steps=env_steps)
    return Transition(
        obs=segment.seen[:-1],
        action=segment.action,
        reward=reward(section, task, before, after) - lost,
        next_obs=segment.seen[1:],
        terminated=segment.terminated,
        cut=jnp.maximum(last, segment.ended),
        weight=segment.alive,
        extras=_extras(section, task, segment, env_steps),
    )


def learn(
    section: ControllerConfig, task: Task, state: Any, batch: Transition, *, shown: Shown | None, key: Array
) -> tuple[Any, Metrics]:
    """Learn from a segment, and from the actions that teachers have `shown`."""
    imitation = None
    if shown is not None:
        subgoal = task.subgoals.demonstrated(task.spec, shown.state, shown.later, shown.outcome)
        seen = observe(section, task, shown.state, subgoal)
        imitation = Imitation(obs=seen, action=shown.action, weight=shown.weight)
    relabel = partial(_in_hindsight, section, task) if section.hindsight else None
    state, metrics = learners.update(section, state, batch, relabel=relabel, imitation=imitation, key=key)
    return state, metrics | {"reward": weighted_mean(batch.reward, batch.weight)}


def reward(
    section: ControllerConfig, task: Task, subgoal: Float[Array, "*batch m"], next_subgoal: Float[Array, "*batch m"]
) -> Float[Array, "*batch"]:
    """Reward of one env step from the relative subgoals before and after it."""
    before, after = task.subgoals.distance(subgoal), task.subgoals.distance(next_subgoal)
    return section.reward_scale * (-after if section.reward == "distance" else before - after)


def price(
    section: ControllerConfig,
    spec: Spec,
    next_obs: Float[Array, "*batch obs"],
    terminated: Float[Array, "*batch"],
    *,
    env_steps: Float[Array, ""] | float,
) -> Float[Array, "*batch"]:
    """Penalty on the reward of an env step that led to `next_obs`, whatever the subgoal is.

    The share of `tilt_penalty` rises exponentially over the first `tilt_steps` of `env_steps`, those of all
    environments together.
    """
    lost = section.termination_penalty * terminated
    if not spec.orientation:
        return lost
    share = section.tilt_start ** jnp.maximum(1.0 - env_steps / section.tilt_steps, 0.0)
    return lost + share * section.tilt_penalty * spec.tilt(next_obs)


def _extras(section: ControllerConfig, task: Task, segment: Segment, env_steps: Float[Array, ""] | float) -> Any:
    """The extras of transitions, which replay needs."""
    if section.settings.futures:
        epoch = jnp.broadcast_to(jnp.asarray(env_steps, jnp.float32), segment.ended.shape)
        return Track(task.spec.abstract(segment.obs[:-1]), segment.ended, epoch)
    return _later(task, segment) if section.hindsight else ()


def _later(task: Task, segment: Segment) -> Float[Array, "l B 2 p"]:
    """Place of the agent at the end of the segment, seen from before and from after each of its env steps."""
    pose = task.spec.pose(segment.obs)
    return jnp.stack([pose[-1] - pose[:-1], pose[-1] - pose[1:]], axis=-2)


def _in_hindsight(section: ControllerConfig, task: Task, batch: Transition, key: Array) -> Transition:
    """Half of the replayed transitions as if what the agent reached had been its subgoal (Andrychowicz et al. 2017)."""
    size, reached = task.subgoals.size, task.subgoals.asking(batch.extras)
    before, after = reached[:, 0], reached[:, 1]
    paid = partial(reward, section, task)
    lost = paid(batch.obs[:, -size:], batch.next_obs[:, -size:]) - batch.reward  # does not depend on the subgoal
    replaced = jax.random.bernoulli(key, 0.5, batch.reward.shape)
    relabelled = batch.replace(
        obs=batch.obs.at[:, -size:].set(before),
        next_obs=batch.next_obs.at[:, -size:].set(after),
        reward=paid(before, after) - lost,
    )
    return where(replaced, relabelled, batch)
