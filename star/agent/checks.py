"""Checks of settings against the task, beyond the settings alone."""

from __future__ import annotations

import math

import numpy as np

from star.abstraction import regions
from star.agent import adjacency
from star.agent.sections import Config
from star.agent.task import first_cuts
from star.spec import Spec


def check(config: Config, spec: Spec) -> None:
    """Raise ValueError in one line if `config` does not fit the environment."""
    _check_periods(config, spec)
    _check_body(config, spec)
    _check_tables(config, spec)


def _check_periods(config: Config, spec: Spec) -> None:
    segments, rest = divmod(spec.episode_length, config.tutor.period)
    if rest:
        raise ValueError(f"tutor.period: {config.tutor.period} does not divide the episode of {spec.episode_length}")
    if segments % config.tutor.unroll:
        raise ValueError(f"tutor.unroll: {config.tutor.unroll} does not divide the {segments} decisions of an episode")
    if config.commander.period > spec.episode_length:
        raise ValueError(f"commander.period: {config.commander.period} exceeds the episode of {spec.episode_length}")


def _check_body(config: Config, spec: Spec) -> None:
    if spec.heading and not spec.orientation:
        raise ValueError(f"tutor.heading: {spec.heading:g}, but the body has no orientation; allowed: null")
    if config.controller.frame == "body" and not (spec.orientation and spec.velocity):
        raise ValueError("controller.frame: body, but the body has no orientation; allowed: world")
    turns = "controller.frame: body" if config.controller.frame == "body" else "tutor.heading" if spec.heading else ""
    if turns and spec.abstract_indices[:2] != (0, 1):
        raise ValueError(
            f"{turns}: turns x and y, which must be the first two numbers of the state and of abstract_indices, "
            f"{list(spec.abstract_indices)}"
        )
    if config.controller.tilt_penalty and not spec.orientation:
        raise ValueError(
            f"controller.tilt_penalty: {config.controller.tilt_penalty:g}, but the body has no orientation; allowed: 0"
        )


def _check_tables(config: Config, spec: Spec) -> None:
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
