"""The part of a state that greedy episodes need: all else is 0, so that little is left of it in a compressed file."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from star.agent.sections import AgentConfig
from star.agent.state import TrainState
from star.training.state import leaf_name

_POLICY = ("params/actor", "params/log_std", "normalizer", "updates")
_NEEDED = (
    *("abstraction", "graph", "epoch", "key"),
    *(f"commander/model/{name}" for name in ("led", "lost", "rewards", "visits")),
    *(f"{level}/{name}" for level in ("tutor", "controller") for name in _POLICY),
)
_VALUES = "commander/q"  # greedy plans for success are made anew, see `planning.settle`


def slim(config: AgentConfig, state: TrainState) -> TrainState:
    """`state`, with 0 in all that greedy episodes do not read. It acts as before, and cannot be trained further.

    A level with a learner of a user's own is kept as it is.
    """
    section, levels = config.commander, {"tutor": config.tutor, "controller": config.controller}
    needed = list(_NEEDED) + [name for name, level in levels.items() if level.learner not in level.built_in]
    if section.learner != "model" or section.reward != "success":
        needed.append(_VALUES)

    def kept(path: Any, leaf: jax.Array) -> jax.Array:
        name = leaf_name(path)
        return leaf if any(name == one or name.startswith(f"{one}/") for one in needed) else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(kept, state)
