"""The state of a run: one pytree."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Int

from star import learners
from star.abstraction import forward_model, refinement, regions
from star.abstraction.forward_model import ForwardModelState
from star.abstraction.refinement import Graph
from star.abstraction.regions import Abstraction
from star.agent import adjacency, commander, controller
from star.agent.adjacency import AdjacencyState
from star.agent.commander import CommanderState
from star.agent.sections import AgentConfig, Config
from star.agent.tutor import Trace
from star.learners.replay import Transition
from star.sgim import strategies
from star.sgim.selection import SgimState
from star.spec import Spec


class TrainState(struct.PyTreeNode):
    """Everything a run knows between two epochs. Environments are reset by every epoch, so they are not part of it."""

    commander: CommanderState
    tutor: Any
    adjacency: AdjacencyState | None
    controller: Any
    abstraction: Abstraction
    graph: Graph
    forward_model: ForwardModelState
    sgim: SgimState | None
    epoch: Int[Array, ""]
    key: Array


def init(config: AgentConfig, spec: Spec, *, key: Array) -> TrainState:
    """A fresh run."""
    tutor_key, controller_key, model_key, adjacency_key, key = jax.random.split(key, 5)
    adjacent = config.tutor.adjacency
    abstraction = regions.create(spec.space, first_cuts(config, spec), max_regions=config.abstraction.max_regions)
    tutor_example, controller_example = examples(config, spec)
    return TrainState(
        commander=commander.init(config.commander, regions=abstraction.capacity),
        tutor=learners.init(tutor_key, config.tutor, example=tutor_example) if config.tutor.enabled else None,
        adjacency=adjacency.init(adjacency_key, adjacent, spec.space) if adjacent.enabled else None,
        controller=learners.init(controller_key, config.controller, example=controller_example),
        abstraction=abstraction,
        graph=refinement.init(capacity=abstraction.capacity),
        forward_model=forward_model.init(model_key, config.forward_model, space=abstraction.space),
        sgim=strategies.init(config.sgim, abstraction),
        epoch=jnp.zeros((), jnp.int32),
        key=key,
    )


def first_cuts(config: AgentConfig | Config, spec: Spec) -> Sequence[Sequence[float]]:
    """Where the abstract space is cut at first: as the task says, or `abstraction.cuts`, or `abstraction.grid`."""
    if config.abstraction.grid is None:
        return spec.region_cuts if config.abstraction.cuts is None else config.abstraction.cuts
    parts = (*config.abstraction.grid, *[1] * (len(spec.abstract_indices) - len(config.abstraction.grid)))
    return [np.linspace(low, high, n + 1)[1:-1].tolist() for n, low, high in zip(parts, *spec.space, strict=False)]


def check(config: Config, spec: Spec) -> None:
    """Raise ValueError with one line if `config` does not fit the environment."""
    segments, rest = divmod(spec.episode_length, config.tutor.period)
    if rest:
        raise ValueError(f"tutor.period: {config.tutor.period} does not divide the episode of {spec.episode_length}")
    if segments % config.tutor.unroll:
        raise ValueError(f"tutor.unroll: {config.tutor.unroll} does not divide the {segments} decisions of an episode")
    if config.commander.period > spec.episode_length:
        raise ValueError(f"commander.period: {config.commander.period} exceeds the episode of {spec.episode_length}")
    if spec.heading and not spec.orientation:
        raise ValueError(f"tutor.heading: {spec.heading:g}, but the body has no orientation; allowed: null")
    if config.controller.frame == "body" and not (spec.orientation and spec.velocity):
        raise ValueError("controller.frame: body, but the body has no orientation; allowed: world")
    if config.controller.tilt_penalty and not spec.orientation:
        raise ValueError(
            f"controller.tilt_penalty: {config.controller.tilt_penalty:g}, but the body has no orientation; allowed: 0"
        )
    cells = int(np.prod(adjacency.shape(config.tutor.adjacency, spec.space)))
    if config.tutor.adjacency.enabled and cells > adjacency.MAX_CELLS:
        raise ValueError(
            f"tutor.adjacency.cell: {config.tutor.adjacency.cell} makes {cells} cells, more than {adjacency.MAX_CELLS}"
        )
    grid, dimensions = config.abstraction.grid or (), len(spec.abstract_indices)
    if len(grid) > dimensions:
        raise ValueError(
            f"abstraction.grid: {list(grid)} has more parts than there are abstract dimensions, {dimensions}"
        )
    if math.prod(grid) > config.abstraction.max_regions:  # said here, as `first_cuts` would write them all out
        raise ValueError(
            f"abstraction.grid: {math.prod(grid)} initial regions exceed abstraction.max_regions "
            f"{config.abstraction.max_regions}"
        )
    try:
        regions.create(spec.space, first_cuts(config, spec), max_regions=config.abstraction.max_regions)
    except ValueError as error:
        raise ValueError(f"abstraction.{'cuts' if config.abstraction.grid is None else 'grid'}: {error}") from None


def examples(config: AgentConfig, spec: Spec) -> tuple[Transition, Transition]:
    """Shapes of one transition of Tutor and Controller."""
    d, p, l, scalar = len(spec.abstract_indices), len(spec.scale), config.tutor.period, jnp.zeros(())
    rest = {"reward": scalar, "terminated": scalar, "cut": scalar, "weight": scalar}
    seen_by_tutor = jnp.zeros(spec.state_dim + 2 * d)
    extras: Any = ()
    if config.tutor.adjacency.enabled:
        extras = jnp.zeros(p)
    trace = Trace(
        states=jnp.zeros((l, spec.state_dim)),
        actions=jnp.zeros((l, spec.action_size)),
        achieved=jnp.zeros((l + 1, p)),
    )
    if config.tutor.off_policy_correction:
        extras = trace
    subgoal = jnp.zeros(p if config.tutor.enabled else 2 * d)
    seen_by_controller = controller.observe(config.controller, spec, jnp.zeros(spec.state_dim), subgoal)
    return (
        Transition(obs=seen_by_tutor, action=jnp.zeros(p), next_obs=seen_by_tutor, extras=extras, **rest),
        Transition(
            obs=seen_by_controller,
            action=jnp.zeros(spec.action_size),
            next_obs=seen_by_controller,
            extras=jnp.zeros((2, p)) if config.controller.hindsight else (),
            **rest,
        ),
    )


def leaf_name(path: tuple[Any, ...]) -> str:
    """That of a leaf, such as `tutor/optimizer/1/count`, the same in a `TrainState` and in what orbax reads without."""
    return jax.tree_util.keystr(path, simple=True, separator="/")
