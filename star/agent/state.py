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


class Upcoming(struct.PyTreeNode):
    """The parts of a state that change between two epochs, as the next one begins with them."""

    commander: CommanderState
    abstraction: Abstraction
    graph: Graph
    sgim: SgimState | None

    @classmethod
    def of(cls, state: TrainState) -> Upcoming:
        """These parts of a `state`."""
        return cls(commander=state.commander, abstraction=state.abstraction, graph=state.graph, sgim=state.sgim)


class TrainState(struct.PyTreeNode):
    """Everything a run knows between two epochs. Environments are reset by every epoch, so they are not part of it.

    Greedy episodes see the regions that the last epoch was played in. Cuts made since then are in `upcoming`: what
    follows of them is a guess until an epoch has been played with them.
    """

    commander: CommanderState
    tutor: Any
    adjacency: AdjacencyState | None
    controller: Any
    abstraction: Abstraction
    graph: Graph
    forward_model: ForwardModelState
    sgim: SgimState | None
    upcoming: Upcoming
    epoch: Int[Array, ""]
    key: Array

    def renewed(self) -> TrainState:
        """The state with which the next epoch begins: `upcoming` has come."""
        now = self.upcoming
        return self.replace(commander=now.commander, abstraction=now.abstraction, graph=now.graph, sgim=now.sgim)
