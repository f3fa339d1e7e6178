"""The levels of an agent: all of them, or others in their place. The one place where this is chosen."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from star.abstraction import forward_model, refinement, regions
from star.agent import adjacency, between_episodes, commander, controller, goal_only, passing, tutor
from star.agent.sections import AgentConfig
from star.agent.state import TrainState, Upcoming
from star.agent.task import Task, first_cuts
from star.sgim import lessons, unguided
from star.spec import Spec


class Agent(NamedTuple):
    """Settings, task and levels; each level is a module of pure functions."""

    config: AgentConfig
    task: Task
    commander: ModuleType
    """`commander`, or `goal_only`: HIRO, HRAC and flat."""
    tutor: ModuleType
    """`tutor`, or `passing`: GARA and flat."""
    controller: ModuleType
    guide: ModuleType
    """`lessons`, or `unguided` without SGIM and in greedy episodes."""
    between_episodes: Callable
    """Learning about the regions; nothing without a Commander."""


def of(config: AgentConfig, spec: Spec, *, greedy: bool = False) -> Agent:
    """The agent that `config` describes, for episodes in which it learns or for `greedy` ones."""
    with_regions = config.commander.enabled
    return Agent(
        config=config,
        task=Task.of(config, spec),
        commander=commander if with_regions else goal_only,
        tutor=tutor if config.tutor.enabled else passing,
        controller=controller,
        guide=lessons if config.sgim.enabled and not greedy else unguided,
        between_episodes=between_episodes.learn if with_regions else between_episodes.nothing,
    )


def init(config: AgentConfig, spec: Spec, *, key: Array) -> TrainState:
    """A fresh run."""
    tutor_key, controller_key, model_key, adjacency_key, key = jax.random.split(key, 5)
    agent = of(config, spec)
    abstraction = regions.create(spec.space, first_cuts(config, spec), max_regions=config.abstraction.max_regions)
    graph = refinement.init(capacity=abstraction.capacity, dimensions=abstraction.lower.shape[-1])
    table = agent.commander.init(config.commander, regions=abstraction.capacity)
    sgim = agent.guide.init(config.sgim, abstraction)
    return TrainState(
        commander=table,
        tutor=agent.tutor.init(tutor_key, config.tutor, agent.task),
        adjacency=adjacency.init(adjacency_key, config.tutor.adjacency, spec.space),
        controller=controller.init(controller_key, config.controller, agent.task),
        abstraction=abstraction,
        graph=graph,
        forward_model=forward_model.init(model_key, config.forward_model, space=abstraction.space),
        sgim=sgim,
        upcoming=Upcoming(commander=table, abstraction=abstraction, graph=graph, sgim=sgim),
        epoch=jnp.zeros((), jnp.int32),
        key=key,
    )
