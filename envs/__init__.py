"""Maze tasks for goal-conditioned agents, as brax environments.

>>> import envs
>>> env = envs.VectorEnv(envs.make("point_maze"), 64)

`envs` knows nothing of agents. See docs/environments.md for every task, option and convention.
"""

from envs import _quiet as _quiet  # first: the import that silences the ones below
from envs.maze import MazeEnv
from envs.options import EnvError
from envs.tasks import make, names
from envs.vector import VectorEnv

__all__ = ["EnvError", "MazeEnv", "VectorEnv", "make", "names"]
