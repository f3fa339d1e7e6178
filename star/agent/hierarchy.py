"""One env step of the hierarchy, whoever moves the body: `play` in simulated environments, `acting` from observations.

prepare   before a greedy episode: the Commander as it acts there, and its roadmap
begin     a greedy episode: the Commander's memory
decide    every l env steps: the Commander's target where a period begins, the Tutor's subgoal, and who explores
follow    after every env step: the subgoal moves with the agent
act       at every env step: the Controller, which may decide for some env steps at once
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from star.agent.decisions import Memory, Roadmap, Scene
from star.agent.levels import Agent
from star.agent.segments import Choice
from star.agent.state import TrainState
from star.sgim.lessons import Marks

Keys = tuple[Array, Array, Array]
"""Those of Commander, Tutor and Controller in one segment."""


def prepare(agent: Agent, state: TrainState) -> tuple[TrainState, Roadmap]:
    """The state as greedy episodes act on it, and what its Commander chooses from."""
    section, length = agent.config.commander, agent.task.spec.episode_length
    roadmap = Roadmap.of(section, state.abstraction, state.graph)
    settled = agent.commander.settle(section, state.commander, roadmap, episode_length=length)
    return state.replace(commander=settled), roadmap


def begin(agent: Agent, state: TrainState, position: Float[Array, "B d"]) -> Memory:
    """The Commander's memory at the start of a greedy episode, of agents at `position`."""
    commander = agent.commander
    return commander.set_out(agent.config.commander, commander.begin(position), capacity=state.abstraction.capacity)


def segment_keys(key: Array, segments: int) -> tuple[Array, Array]:
    """From the key of a greedy episode: the one that begins it, and those of its segments [segments, 3]."""
    begin_key, scan_key = jax.random.split(key)
    return begin_key, jax.vmap(lambda one: jax.random.split(one, 3))(jax.random.split(scan_key, segments))


def step_keys(agent: Agent, key: Array) -> Array:
    """From the Controller's key of a segment: those of its env steps [l]."""
    return jax.random.split(key, agent.config.tutor.period)


def decide(
    agent: Agent,
    state: TrainState,
    roadmap: Roadmap,
    memory: Memory,
    lesson: Any,
    obs: Float[Array, "B obs"],
    success: Float[Array, "B"],
    *,
    env_steps: Float[Array, ""] | None,
    keys: Keys,
) -> tuple[Memory, Any, Marks, Choice, bool | Bool[Array, "B"]]:
    """Command where a period begins, and choose a subgoal; with what SGIM had to say, and its lesson after that.

    Last comes who explores in these l env steps: in training all, in greedy episodes those who stand still short of the
    goal. `success` is 1 where the goal counts as reached; `env_steps` are as for `play.segment`.
    """
    config, task = agent.config, agent.task
    scene = Scene(task.spec.abstract(obs), task.spec.goal_point(obs), success)
    lesson, marks = agent.guide.mark(config.sgim, lesson, roadmap.abstraction, scene.position, due=memory.clock == 0)
    memory = agent.commander.command(
        config.commander, task, state.commander, roadmap, memory, scene, marks, env_steps=env_steps, key=keys[0]
    )
    explore = env_steps is not None or agent.commander.standing(task, memory, scene)
    choice = agent.tutor.act(config.tutor, task, state.tutor, obs, memory.box, marks, explore=explore, key=keys[1])
    return memory, lesson, marks, choice, explore


def observe(agent: Agent, obs: Float[Array, "B obs"], subgoal: Float[Array, "B m"]) -> Float[Array, "B seen"]:
    """The Controller's view."""
    return agent.controller.observe(agent.config.controller, agent.task, agent.task.spec.state(obs), subgoal)


def follow(
    agent: Agent, subgoal: Float[Array, "B m"], before: Float[Array, "B obs"], after: Float[Array, "B obs"]
) -> Float[Array, "B m"]:
    """The subgoal after an env step that led from the observation `before` to `after`."""
    spec = agent.task.spec
    return agent.task.subgoals.moved(subgoal, spec.pose(before), spec.pose(after))


def no_plan(agent: Agent, bodies: int) -> Float[Array, "B chunk act"]:
    """The plans of so many `bodies` before a segment."""
    return jnp.zeros((bodies, agent.config.controller.settings.chunk, agent.task.spec.action_size))


def act(
    agent: Agent,
    state: TrainState,
    seen: Float[Array, "B seen"],
    plan: Float[Array, "B chunk act"],
    *,
    number: Array | int,
    explore: bool | Bool[Array, "B"],
    key: Array,
) -> tuple[Float[Array, "B act"], Float[Array, "B chunk act"]]:
    """The Controller's actions, and its plan after them, given that of the env step before.

    A learner that decides for `chunk` env steps at once does so where `number`, that of the env step in its segment, is
    a multiple of `chunk`. Its actions are then played whatever is `seen`.
    """
    chunk = agent.config.controller.settings.chunk

    def decided() -> Array:
        return agent.controller.act(agent.config.controller, state.controller, seen, explore=explore, key=key)

    if chunk == 1:
        return decided(), plan
    plan = jax.lax.cond(number % chunk == 0, lambda: decided().reshape(plan.shape), lambda: plan)
    return plan[:, 0], jnp.roll(plan, -1, axis=1)
