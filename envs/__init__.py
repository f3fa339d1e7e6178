"""Maze tasks for goal-conditioned agents, as brax environments.

>>> import envs
>>> env = envs.VectorEnv(envs.make("point_maze"), 64)

`envs` knows nothing of agents. See docs/environments.md for every task, option and convention, and docs/your_robot.md
for environments of your own; `envs.worlds` is for learners of skills (docs/worlds.md). Modules that need JAX are
imported at their first use. Gymnasium knows the tasks by their ids from then on (docs/gymnasium.md).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from envs import registration as registration
from envs.common.errors import UserError
from envs.options import EnvError
from envs.tasks import names

if TYPE_CHECKING:
    from envs.arena import Arena, read_arena
    from envs.build import make
    from envs.goal_env import GoalEnv, adapt
    from envs.maze import Body, MazeEnv
    from envs.physics import Physics
    from envs.robot import Robot
    from envs.vector import VectorEnv

__all__ = [
    "Arena",
    "Body",
    "EnvError",
    "GoalEnv",
    "MazeEnv",
    "Physics",
    "Robot",
    "UserError",
    "VectorEnv",
    "adapt",
    "make",
    "names",
    "read_arena",
]

_HOMES = {
    "Arena": "envs.arena",
    "Body": "envs.maze",
    "GoalEnv": "envs.goal_env",
    "MazeEnv": "envs.maze",
    "Physics": "envs.physics",
    "Robot": "envs.robot",
    "VectorEnv": "envs.vector",
    "adapt": "envs.goal_env",
    "make": "envs.build",
    "read_arena": "envs.arena",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'envs' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
