"""The part of a state that greedy episodes need: all else is 0, so that little is left of it in a compressed file."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from star.agent.state import TrainState
from star.training.state import leaf_name

_POLICY = ("params/actor", "params/log_std", "normalizer", "updates")
_NEEDED = (
    *("abstraction", "graph", "epoch", "key"),
    *(f"commander/model/{name}" for name in ("led", "lost", "rewards", "visits")),
    *(f"{level}/{name}" for level in ("tutor", "controller") for name in _POLICY),
)
_WITHOUT_MODEL = "commander/q"  # of Q-learning: plans are made anew


def slim(state: TrainState) -> TrainState:
    """`state`, with 0 in all that greedy episodes do not read. It acts as before, and cannot be trained further."""
    needed = _NEEDED if state.commander.model is not None else (*_NEEDED, _WITHOUT_MODEL)

    def kept(path: Any, leaf: jax.Array) -> jax.Array:
        name = leaf_name(path)
        return leaf if any(name == one or name.startswith(f"{one}/") for one in needed) else jnp.zeros_like(leaf)

    return jax.tree_util.tree_map_with_path(kept, state)
