"""The agent learns: an epoch is one pure function of the state of a run.

    epoch(state):
        reset all B environments, clocks at 0
        repeat episode_length / l times                       # one segment: one decision of the Tutor
            act (star/agent/play.py)
            Controller learns from the segment; where the clock reaches k, Commander learns from the period
            every `unroll` segments: Tutor learns
        between episodes: forward model, refinement, and what follows of them

`star.agent.levels` chooses the levels: no Commander is HIRO, no Tutor is GARA, neither is flat.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.vector import VectorEnv
from star import devices
from star.agent import adjacency, levels, play
from star.agent.decisions import Roadmap
from star.agent.levels import Agent
from star.agent.play import Episode, Streams
from star.agent.sections import AgentConfig
from star.agent.segments import Segment
from star.agent.state import TrainState
from star.sgim.teachers import Demonstrations
from star.spec import Spec

Metrics = dict[str, Array]
Carry = tuple[TrainState, Streams]


class _Fixed(NamedTuple):
    """All that an epoch does not change."""

    agent: Agent
    env: VectorEnv
    teachers: Sequence[Demonstrations]
    roadmap: Roadmap
    env_steps: Float[Array, ""]


def epoch(
    config: AgentConfig, spec: Spec, env: VectorEnv, state: TrainState, teachers: Sequence[Demonstrations] = ()
) -> tuple[TrainState, Metrics]:
    """One episode of all environments, its updates, one refinement. `teachers` are those of `config.sgim.teachers`."""
    agent, state = levels.of(config, spec), state.renewed()
    guide = agent.guide
    key, reset_key, scan_key, end_key, lesson_key = jax.random.split(state.key, 5)
    env_steps = state.epoch.astype(jnp.float32) * (spec.episode_length * env.num_envs)
    known = state.commander
    streams = devices.share(play.start(agent, env, key=reset_key))
    lesson, env_state, graph = guide.begin(
        config.sgim, spec, env, state.sgim, state.graph, teachers, streams.env, key=lesson_key
    )
    state, streams = state.replace(graph=graph, key=key), streams.replace(env=env_state, lesson=lesson)
    attraction = guide.attraction(config.sgim, state.sgim)
    roadmap = Roadmap.of(config.commander, state.abstraction, graph, attraction=attraction)
    segments = spec.episode_length // config.tutor.period
    blocks = (segments // config.tutor.unroll, config.tutor.unroll)
    (state, streams), (finished, metrics, counts) = jax.lax.scan(
        partial(_block, _Fixed(agent, env, teachers, roadmap, env_steps)),
        (state, streams),
        (jax.random.split(scan_key, blocks[0]), jnp.arange(segments).reshape(blocks)),
    )
    metrics = jax.tree.map(jnp.mean, metrics) | jax.tree.map(jnp.sum, counts)
    metrics |= _episode_metrics("train", streams.episode)
    learnt, more = guide.end(config.sgim, spec, state.sgim, streams.lesson, distance=streams.episode.distance)
    state, metrics = state.replace(sgim=learnt), metrics | _prefix("sgim", more)
    if state.adjacency is not None:
        end_key, near_key = jax.random.split(end_key)
        near, more = adjacency.train(config.tutor.adjacency, state.adjacency, spec.space, key=near_key)
        state, metrics = state.replace(adjacency=near), metrics | _prefix("adjacency", more)
    finished = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), devices.whole(finished))
    state, more = agent.between_episodes(
        config,
        spec,
        guide,
        state,
        known=known,
        finished=finished,
        num_envs=env.num_envs,
        env_steps=env_steps,
        key=end_key,
    )
    return state.replace(epoch=state.epoch + 1), metrics | more


def _block(fixed: _Fixed, carry: Carry, inputs: tuple[Array, Array]) -> tuple[Carry, tuple[Any, Metrics, Metrics]]:
    """`tutor.unroll` segments, whose numbers are given, then one update of the Tutor."""
    agent, config, task = fixed.agent, fixed.agent.config, fixed.agent.task
    scan_key, update_key = jax.random.split(inputs[0])
    (state, streams), (decisions, led, finished, metrics, counts) = jax.lax.scan(
        partial(_segment, fixed),
        carry,
        (jax.random.split(scan_key, config.tutor.unroll), inputs[1]),
    )
    learnt, more = agent.tutor.learn(
        config.tutor,
        task,
        state.tutor,
        decisions,
        below=agent.controller.policy(config.controller, task, state.controller, key=state.key),
        penalty=adjacency.price(config.tutor, task, state.adjacency),
        imitate=agent.guide.imitating(config.sgim, led),
        key=update_key,
    )
    metrics = jax.tree.map(jnp.mean, metrics) | _prefix("tutor", more)
    return (state.replace(tutor=learnt), streams), (finished, metrics, counts)


def _segment(
    fixed: _Fixed, carry: Carry, inputs: tuple[Array, Array]
) -> tuple[Carry, tuple[Any, Any, Any, Metrics, Metrics]]:
    """One decision of the Tutor: command, act, let Controller and Commander learn."""
    agent, env, teachers, roadmap, env_steps = fixed
    config, task, (state, streams), (key, number) = agent.config, agent.task, carry, inputs
    command_key, tutor_key, rollout_key, update_key, reset_key, imitation_key = jax.random.split(key, 6)
    streams, passed, marks = play.segment(
        agent, env, state, roadmap, streams, env_steps=env_steps, keys=(command_key, tutor_key, rollout_key)
    )
    period = config.tutor.period
    driven, metrics = agent.controller.learn(
        config.controller,
        task,
        state.controller,
        agent.controller.experience(config.controller, task, passed, env_steps=env_steps),
        shown=agent.guide.demonstrated(config.sgim, teachers, streams.lesson, period=period, key=imitation_key),
        key=update_key,
    )
    memory, finished = agent.commander.experience(config.commander, task, roadmap, streams.memory, passed, marks)
    decision = agent.tutor.experience(config.tutor, task, passed, marks, renewed=agent.commander.renewed(memory))
    periods = config.commander.period // period
    commanding = agent.commander.observe(
        config.commander,
        state.commander,
        roadmap,
        devices.whole(finished.decision),
        due=number % periods == periods - 1,
        margin=config.sgim.margin,
    )
    path, alive = devices.whole((task.spec.abstract(passed.obs), passed.alive))
    near = adjacency.observe(config.tutor.adjacency, state.adjacency, task.spec.space, path, alive)
    state = state.replace(controller=driven, commander=commanding, adjacency=near)
    streams = play.restart_ended(agent, env, streams.replace(memory=memory), passed, key=reset_key)
    return (state, streams), (decision, marks.led, finished, _prefix("controller", metrics), _counts(passed))


def _counts(passed: Segment) -> Metrics:
    """Counts of ended episodes by their reason, and of observations that were not finite."""
    finite = jnp.isfinite(passed.obs).all(axis=-1)
    counted: Mapping[str, Array] = {
        "terminated": passed.terminated,
        "non_finite": passed.non_finite,
        "overflow": passed.overflow,
        "obs_non_finite": ~(finite[:-1] & finite[1:]),
    }
    return {f"env/{name}": (value * passed.alive).sum() for name, value in counted.items()}


def _episode_metrics(name: str, episode: Episode) -> Metrics:
    return {
        f"{name}/success_any": episode.success_any.mean(),
        f"{name}/success_final": episode.success_final.mean(),
        f"{name}/distance": episode.distance.mean(),
        f"{name}/return": episode.total.mean(),
    }


def _prefix(level: str, metrics: Metrics) -> Metrics:
    return {f"{level}/{name}": value for name, value in metrics.items()}
