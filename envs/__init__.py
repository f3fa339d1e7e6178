"""Maze tasks for goal-conditioned agents, as brax environments.

>>> import envs
>>> env = envs.VectorEnv(envs.make("point_maze"), 64)

`envs` knows nothing of agents. See docs/environments.md for every task, option and convention. What needs JAX is
imported when it is first used. Where Gymnasium is installed, its ids of the tasks are registered (docs/gymnasium.md).
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from envs.common.errors import UserError
from envs.options import EnvError
from envs.tasks import names

if importlib.util.find_spec("gymnasium"):
    from envs import registration as registration

if TYPE_CHECKING:
    from envs.build import make
    from envs.maze import MazeEnv
    from envs.vector import VectorEnv

__all__ = ["EnvError", "MazeEnv", "UserError", "VectorEnv", "make", "names"]

_HOMES = {"make": "envs.build", "MazeEnv": "envs.maze", "VectorEnv": "envs.vector"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
