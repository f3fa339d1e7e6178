"""The settings of the regions, of the model that predicts where commands lead, and of refinement."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from star.config.section import Batch, Hidden, Positive, Repeats, Section, setting
from star.learners.sections import BufferedConfig


class AbstractionConfig(Section):
    """The regions the Commander chooses from."""

    max_regions: Annotated[int, Field(ge=1, le=1024)] = setting(
        64, "The table of regions has room for so many.", unit="regions"
    )
    cuts: tuple[tuple[float, ...], ...] | None = setting(
        None,
        "The space is cut here at first, along each abstract dimension; with null as the task says.",
        unit="units of the state",
        allowed="inside the space of the task",
    )
    grid: tuple[Positive, ...] | None = setting(
        None,
        "Instead of cuts: the space has so many equal parts along each dimension at first, 1 where left out.",
        unit="regions",
    )
    min_width: float = setting(1.0, "No region is cut narrower than this.", unit="units of the state", gt=0)

    @model_validator(mode="after")
    def _cut_in_one_way(self) -> Self:
        if self.grid is not None and self.cuts is not None:
            raise ValueError(f"grid: {list(self.grid)}, but there are cuts, too; allowed: one of them")
        return self


class ForwardModelConfig(BufferedConfig):
    """F_k: predicts where k steps under a commanded region lead."""

    hidden: Hidden = setting((32, 32), "The model has ReLU layers of these widths.", unit="units")
    learning_rate: float = setting(1e-3, "Adam takes steps of this size.", unit="", gt=0)
    batch_size: Batch = setting(512, "Each update learns from so many transitions.", unit="transitions")
    buffer_size: Positive = setting(100_000, "The buffer keeps so many transitions.", unit="transitions")
    updates_per_epoch: Repeats = setting(
        200, "The model makes so many gradient updates after each epoch.", unit="updates"
    )
    residual: bool = setting(True, "The model predicts the displacement, not the final state.")
    boxes: Literal["commanded", "reached"] = setting(
        "commanded", "The model trains on the box that was commanded, or on the region that was reached."
    )


class RefinementConfig(Section):
    """When and where a region is split."""

    enabled: bool = setting(True, "With false the initial regions stay.")
    within: bool = setting(True, "The reach of a region to the goals inside it is examined, too.")
    min_transitions: Positive = setting(
        100, "A pair of regions is examined after so many commanded transitions.", unit="transitions"
    )
    error_tolerance: float = setting(
        0.5, "The model's error on a pair is stable once it falls by less than this share an epoch.", unit="", ge=0
    )
    reach_share: float = setting(
        0.7, "A box reaches its target if this share of its hull lies inside (c1).", unit="", gt=0, le=1
    )
    miss_share: float = setting(
        0.1, "A box misses its target if it covers less than this share of it (tau2).", unit="", ge=0, lt=1
    )
    depth: Annotated[int, Field(ge=1, le=12)] = setting(
        8, "Boxes are halved so often at most: 5 makes 1/32 of the region.", unit="halvings"
    )
    parts: Annotated[int, Field(ge=2, le=4096)] = setting(
        32, "A region has so many parts at most; those visited most are halved first.", unit="parts"
    )
    min_visits: Positive = setting(10, "A reaching box needs so many visited start states.", unit="states")
    pairs_per_epoch: Repeats = setting(16, "So many pairs of regions are examined after each epoch.", unit="pairs")
    cuts: Literal["best", "random"] = setting(
        "best", "A region is cut at the best place, or for comparison at a random one."
    )
    cuts_per_pair: Repeats = setting(1, "One examined pair makes so many cuts at most.", unit="cuts")
    separate: bool = setting(True, "A region is cut along a plane that agents do not pass, too.")
    miss_lifetime: Annotated[int, Field(ge=0, lt=2**31)] = setting(
        2, "A verdict that a pair misses is forgotten after so many epochs; with 0 there is none.", unit="epochs"
    )
