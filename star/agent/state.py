"""The state of a run: one pytree."""

from __future__ import annotations

from typing import Any

from flax import struct
from jaxtyping import Array, Int

from star.abstraction.forward_model import ForwardModelState
from star.abstraction.refinement import Graph
from star.abstraction.regions import Abstraction
from star.agent.adjacency import AdjacencyState
from star.agent.values import CommanderState
from star.sgim.selection import SgimState


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
