"""The look at a world of a user's own before anything runs."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.common.errors import shown, where_raised
from envs.options import EnvError
from envs.worlds.world import WIDTH, Outcomes, World


def check(world: Any) -> None:
    """Raise `EnvError` in one line, unless this is a world that learners can use. Nothing is compiled."""
    if not isinstance(world, World):
        raise EnvError(f"makes {shown(world)}; allowed: an envs.worlds.World")
    for name in ("primitive", "longest"):
        if type(getattr(world, name)) is not int or getattr(world, name) < 1:
            raise EnvError(f"{name} is {shown(getattr(world, name))}; allowed: a whole number from 1")
    if not world.tasks or len(set(world.names)) < len(world.tasks):
        raise EnvError(f"its tasks are called {shown(world.names)}; allowed: one task or more, each with its own name")
    for task in world.tasks:
        bounds = np.shape(task.lower), np.shape(task.upper)
        if bounds[0] != bounds[1] or len(bounds[0]) != 1 or not 1 <= bounds[0][0] <= WIDTH:
            raise EnvError(f"bounds of {task.name} have the shapes {bounds}; allowed: 1 to {WIDTH} numbers each")
        if not np.less(task.lower, task.upper).all():
            raise EnvError(f"bounds of {task.name} are {task.lower} and {task.upper}; allowed: lower below upper")
    _check_simulate(world)


def _check_simulate(world: World) -> None:
    sequence, length = jnp.zeros((world.longest, world.primitive)), jnp.int32(1)
    try:
        found, path = jax.eval_shape(world.simulate, sequence, length)
    except Exception as error:  # whatever its author has done
        raise EnvError(f"simulate raises {where_raised(error)}") from error
    tasks = len(world.tasks)
    if not isinstance(found, Outcomes) or (found.value.shape, found.reached.shape) != ((tasks, WIDTH), (tasks,)):
        raise EnvError(f"simulate gives no outcomes of {tasks} tasks; allowed: (envs.worlds.outcomes(...), path)")
    steps = {leaf.shape[:1] for leaf in jax.tree.leaves(path)}
    if len(steps) != 1 or steps == {()} or next(iter(steps))[0] % world.longest:
        raise EnvError(
            f"a path has leading axes {shown(sorted(steps))}; allowed: one, the same number of control steps for each "
            f"of {world.longest} primitives"
        )
