"""STAR: hierarchical reinforcement learning whose goal space refines itself by reachability.

    import star

    agent = star.load("runs/NAME")   # a trained agent
    action = agent.act(obs)          # one observation or a batch, NumPy in, NumPy out
    star.train("point_maze")         # what `star train` and `star evaluate` print, as plain data
    star.evaluate("runs/NAME")

Modules that need JAX are imported at their first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from star import _neighbour

if TYPE_CHECKING:
    from star.api import evaluate, load, train

__all__ = ["evaluate", "load", "train"]
__version__ = "0.1.0"

_neighbour.check()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'star' has no attribute {name!r}")
    value = getattr(importlib.import_module("star.api"), name)
    globals()[name] = value
    return value
