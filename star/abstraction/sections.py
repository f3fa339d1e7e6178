"""The settings of the regions, of the model that predicts where commands lead, and of refinement."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from star.config.section import Batch, Hidden, Positive, Repeats, Section
from star.learners.sections import BufferedConfig


class AbstractionConfig(Section):
    """The regions the Commander chooses from."""

    max_regions: Annotated[int, Field(ge=1, le=1024)] = Field(64, description="capacity of the table of regions")
    cuts: tuple[tuple[float, ...], ...] | None = Field(
        None, description="initial cut positions per abstract dimension; by default those of the task"
    )
    grid: tuple[Positive, ...] | None = Field(
        None, description="instead of cuts: equal initial parts along each abstract dimension, 1 where left out"
    )
    min_width: float = Field(1.0, gt=0, description="no region is cut narrower than this (units of the state)")
    min_share: float = Field(
        0.0, ge=0, description="no region is cut below this times the space over the regions left; 0: any"
    )


class ForwardModelConfig(BufferedConfig):
    """F_k: predicts where k steps under a commanded region lead."""

    hidden: Hidden = Field((32, 32), description="widths of the ReLU layers")
    learning_rate: float = Field(1e-3, gt=0, description="Adam step size")
    batch_size: Batch = Field(512, description="transitions per update")
    buffer_size: Positive = Field(100_000, description="transitions kept")
    updates_per_epoch: Repeats = Field(200, description="gradient updates after each epoch")
    residual: bool = Field(True, description="predict the displacement instead of the final state")
    boxes: Literal["commanded", "reached"] = Field(
        "commanded", description="train on the box that was commanded, or on the region that was reached"
    )


class RefinementConfig(Section):
    """When and where a region is split."""

    enabled: bool = Field(True, description="false keeps the initial regions")
    within: bool = Field(True, description="examine too whether a region reaches the goals inside it")
    neighbours: bool = Field(
        True, description="cut a region only for targets that touch it; others are reached by way of these"
    )
    min_transitions: Positive = Field(100, description="commanded transitions before a pair is examined")
    error_tolerance: float = Field(
        0.5, ge=0, description="the model's error on a pair is stable once it falls by less than this share an epoch"
    )
    reach_share: float = Field(0.7, gt=0, le=1, description="c1: share of the hull inside the target that reaches")
    miss_share: float = Field(0.1, ge=0, lt=1, description="tau2: share of the target covered below which a box misses")
    depth: Annotated[int, Field(ge=1, le=12)] = Field(
        8, description="boxes are halved this often at most: 5 makes 1/32 of the region"
    )
    parts: Annotated[int, Field(ge=2, le=4096)] = Field(
        32, description="parts of a region at most; each round of halving begins with those visited most"
    )
    min_visits: Positive = Field(10, description="visited start states a reaching box needs")
    pairs_per_epoch: Repeats = Field(16, description="pairs examined after each epoch")
    cuts: Literal["best", "random"] = Field("best", description="where a region is cut; random is for comparison")
    cuts_per_pair: Repeats = Field(1, description="cuts one examined pair may make")
    separate: bool = Field(True, description="cut a region too along a plane that agents do not pass")
    miss_lifetime: Annotated[int, Field(ge=0, lt=2**31)] = Field(
        2, description="a MISSES verdict older than so many epochs is forgotten; with 0 there is none"
    )
