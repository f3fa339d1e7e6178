"""Episodes: the clocks of the levels, and how the three of them act together in B environments.

    where the clock is 0:  the Commander chooses a target region
    every l env steps:     the Tutor chooses a subgoal                      one `segment`
    every env step:        the Controller acts, and the subgoal moves with the agent

Clocks restart with every episode. Environments that end early wait until the segment of l env steps is over.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from envs._quiet import State as EnvState
from envs.common.batching import where
from envs.vector import VectorEnv
from star.abstraction.regions import Box
from star.agent import hierarchy, levels
from star.agent.decisions import Memory, Roadmap
from star.agent.hierarchy import Keys
from star.agent.levels import Agent
from star.agent.sections import AgentConfig
from star.agent.segments import Choice, Segment
from star.agent.state import TrainState
from star.sgim.lessons import Marks
from star.spec import Spec

MISHAPS = ("flipped", "fallen", "unhealthy")  # of an environment's metrics


class Episode(struct.PyTreeNode):
    """Running statistics of each environment's episode."""

    success_any: Float[Array, "B"]
    success_final: Float[Array, "B"]
    distance: Float[Array, "B"]
    total: Float[Array, "B"]
    flipped: Float[Array, "B"]
    """1 where the body lies on its back, at the last step."""
    fallen: Float[Array, "B"]
    """The same where it lies in a gap."""
    unhealthy: Float[Array, "B"]
    """The same where it is too low or too high."""
    time_at_goal: Float[Array, "B"]
    """Env steps after which the goal counts as reached."""

    @classmethod
    def start(cls, distance: Float[Array, "B"]) -> Episode:
        """Before the first step, `distance` m from the goal."""
        zero = jnp.zeros_like(distance)
        return cls(**{field.name: zero for field in dataclasses.fields(cls)}).replace(distance=distance)

    def after(self, env_state: EnvState, alive: Float[Array, "B"]) -> Episode:
        """With one more env step, to `env_state`, of those that were `alive`."""
        success, distance = env_state.metrics["success"], env_state.metrics["distance"]
        return Episode(
            success_any=jnp.maximum(self.success_any, success * alive),
            success_final=jnp.where(alive > 0, success, self.success_final),
            distance=jnp.where(alive > 0, distance, self.distance),
            total=self.total + env_state.reward * alive,
            time_at_goal=self.time_at_goal + success * alive,
            **{name: jnp.where(alive > 0, env_state.metrics[name], getattr(self, name)) for name in MISHAPS},
        )


class Streams(struct.PyTreeNode):
    """The B environments, the Commander's memory of each, what SGIM has chosen for it, and how its episode goes."""

    env: EnvState
    memory: Memory
    lesson: Any
    episode: Episode


Record = Callable[[EnvState, Array, Box, Array], Any]
"""The kept part of an env step, given the B environments before it, subgoals [B, m], target boxes, actions [B, act]."""


def evaluate(config: AgentConfig, spec: Spec, env: VectorEnv, state: TrainState, *, key: Array) -> Episode:
    """The statistics of one greedy episode of every environment of `env`; nothing is learnt."""
    return greedy(config, spec, env, state, key=key)[0].episode


def greedy(
    config: AgentConfig,
    spec: Spec,
    env: VectorEnv,
    state: TrainState,
    *,
    goals: Float[Array, "B k"] | None = None,
    record: Record | None = None,
    key: Array,
) -> tuple[Streams, Any]:
    """One greedy episode of every environment of `env`: the streams at its end, and what `record` kept.

    The latter has the leading axis [T] of all env steps of the episode; it is None without `record`. `goals` take the
    place of those that the task draws; the starts stay the same.
    """
    agent = levels.of(config, spec, greedy=True)
    segments = spec.episode_length // config.tutor.period
    reset_key, keys = hierarchy.segment_keys(key, segments)
    streams = start(agent, env, goals=goals, key=reset_key)
    streams = streams.replace(memory=hierarchy.begin(agent, state, spec.abstract(streams.env.obs)))
    state, roadmap = hierarchy.prepare(agent, state)

    def one(streams: Streams, keys: Array) -> tuple[Streams, Any]:
        streams, passed, _ = segment(
            agent, env, state, roadmap, streams, env_steps=None, record=record, keys=(keys[0], keys[1], keys[2])
        )
        memory = agent.commander.tick(config.commander, streams.memory, steps=config.tutor.period)
        return streams.replace(memory=memory), passed.recorded

    streams, recorded = jax.lax.scan(one, streams, keys)
    return streams, jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), recorded)


def start(
    agent: Agent,
    env: VectorEnv,
    *,
    goals: Float[Array, "B k"] | None = None,
    key: Array,
) -> Streams:
    """Fresh environments with their clocks at 0, with `goals` if given."""
    reset_key, _ = jax.random.split(key)  # so that runs stay as they were
    env_state = env.reset(reset_key)
    if goals is not None:
        env_state = env.with_goals(env_state, goals, jnp.ones(env.num_envs, bool))
    memory = agent.commander.begin(agent.task.spec.abstract(env_state.obs))
    return Streams(env=env_state, memory=memory, lesson=(), episode=Episode.start(env_state.metrics["distance"]))


def segment(
    agent: Agent,
    env: VectorEnv,
    state: TrainState,
    roadmap: Roadmap,
    streams: Streams,
    *,
    env_steps: Float[Array, ""] | None,
    record: Record | None = None,
    keys: Keys,
) -> tuple[Streams, Segment, Marks]:
    """Command where a period begins, choose a subgoal, act for l env steps; and what SGIM had to say.

    `env_steps` are those of all environments before the epoch, None in greedy episodes. `keys` are three: of Commander,
    Tutor and Controller.
    """
    memory, lesson, marks, choice, explore = hierarchy.decide(
        agent,
        state,
        roadmap,
        streams.memory,
        streams.lesson,
        streams.env.obs,
        streams.env.metrics["success"],
        env_steps=env_steps,
        keys=keys,
    )
    streams = streams.replace(memory=memory, lesson=lesson)
    streams, passed = rollout(agent, env, state, streams, choice, explore=explore, record=record, key=keys[2])
    return streams, passed, marks


def rollout(
    agent: Agent,
    env: VectorEnv,
    state: TrainState,
    streams: Streams,
    choice: Choice,
    *,
    explore: bool | Bool[Array, "B"],
    record: Record | None = None,
    key: Array,
) -> tuple[Streams, Segment]:
    """L env steps under one subgoal per environment. Environments that end stay as they are in the statistics."""
    length, box = agent.task.spec.episode_length, streams.memory.box

    def step(carry: tuple, inputs: tuple[Array, Array]) -> tuple[tuple, tuple[dict[str, Any], dict[str, Array]]]:
        (before, subgoal, seen, plan, alive, episode), (number, step_key) = carry, inputs
        action, plan = hierarchy.act(agent, state, seen, plan, number=number, explore=explore, key=step_key)
        recorded = record(before, subgoal, box, action) if record else None
        after = env.step(before, action)
        moved = hierarchy.follow(agent, subgoal, before.obs, after.obs)
        ended = after.done * (after.info["steps"] < length)
        steps = {
            "action": action,
            "success": after.metrics["success"],
            "distance": after.metrics["distance"],
            "terminated": _lost(after),
            "ended": ended,
            "arrived": ended * after.metrics["success"] * (1 - _mishap(after)) * (1 - _fault(after)),
            "alive": alive,
            "non_finite": after.metrics["non_finite"],
            "overflow": after.metrics["overflow"],
            "recorded": recorded,
        }
        seen = hierarchy.observe(agent, after.obs, moved)
        ends = {"obs": after.obs, "subgoal": moved, "seen": seen}
        return (after, moved, seen, plan, alive * (1 - after.done), episode.after(after, alive)), (steps, ends)

    seen = hierarchy.observe(agent, streams.env.obs, choice.subgoal)
    plan, numbers = hierarchy.no_plan(agent, len(seen)), jnp.arange(agent.config.tutor.period)
    carry = (streams.env, choice.subgoal, seen, plan, 1 - streams.env.done, streams.episode)
    (env_state, _, _, _, _, episode), (steps, ends) = jax.lax.scan(
        step, carry, (numbers, hierarchy.step_keys(agent, key))
    )
    first = {"obs": streams.env.obs, "subgoal": choice.subgoal, "seen": seen}
    path: dict[str, Array] = jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), first, ends)
    passed = Segment(**path, **steps, box=box, choice=choice)
    return streams.replace(env=env_state, episode=episode), passed


def _lost(after: EnvState) -> Array:
    """1 where the task ended the episode, but not where success alone did: that is bootstrapped like a time limit."""
    return after.done * (1 - after.info["truncation"]) * jnp.maximum(_mishap(after), 1 - after.metrics["success"])


def _mishap(after: EnvState) -> Array:
    return jnp.stack([after.metrics[name] for name in MISHAPS]).max(axis=0)


def _fault(after: EnvState) -> Array:
    """1 where the simulator failed."""
    return jnp.maximum(after.metrics["non_finite"], after.metrics["overflow"])


def restart_ended(agent: Agent, env: VectorEnv, streams: Streams, passed: Segment, *, key: Array) -> Streams:
    """Reset the environments that ended early in this segment, with clocks and statistics at their start.

    What SGIM has chosen for them holds again, from its beginning. Who has been at the goal before stays counted.
    """
    ended = passed.over > 0
    env_state = env.reset_where(streams.env, ended, key)
    lesson, env_state = agent.guide.restart(
        agent.config.sgim, agent.task.spec, env, streams.lesson, env_state, ended, distance=streams.episode.distance
    )
    clock = jnp.where(ended, 0, streams.memory.clock)
    begun = Episode.start(env_state.metrics["distance"]).replace(success_any=streams.episode.success_any)
    episode = where(ended, begun, streams.episode)
    return Streams(env=env_state, memory=streams.memory.replace(clock=clock), lesson=lesson, episode=episode)
