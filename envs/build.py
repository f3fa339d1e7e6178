"""`make`: from a row of the registry and options to an environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from envs import ant, point, tasks
from envs.common import modes
from envs.maze import Body, MazeEnv
from envs.options import PRESETS, EnvError, known, normal, resolve
from envs.tasks import TASKS, Task

BODIES: Mapping[str, Callable[[Task, str, Mapping[str, Any]], Body]] = {"ant": ant.build, "point": point.build}


def make(name: str, *, engine: str = "auto", **options: Any) -> MazeEnv:
    """Build a task.

    Args:
      name: one of `names()`.
      engine: the physics engine; `auto` takes the fastest one that this machine has.
      **options: options of the task, see docs/environments.md.

    Raises:
      EnvError: in one line, if a name, value or map is wrong, or the engine cannot run here.
      UserError: in one line that names the mode, if JAX is in one that nothing here runs in.
    """
    modes.check()
    if name not in TASKS:
        raise EnvError(f'task "{name}" is unknown; {known(name, TASKS)}')
    task = TASKS[name]
    if engine not in task.engines:
        raise EnvError(f'engine "{engine}" is not one of {name}; {known(engine, task.engines)}')
    options = normal(options)
    table = task.options()
    chosen = resolve(name, table, options)
    if "preset" in chosen:
        chosen = resolve(name, table, {**PRESETS[chosen["preset"]], **options})
    if chosen.get("map") is not None:
        task = tasks.own(task.body, chosen["map"], cell=chosen["cell"])
        for key, sets in (("goals", task.goals), ("start", task.starts)):
            if chosen[key] not in sets:
                raise EnvError(f'option "{key}" of a map is {chosen[key]!r}; allowed: {", ".join(sets)}')
    elif chosen["cell"] is not None:
        task = task.resized(chosen["cell"])
    radius = chosen["success_radius"]
    return MazeEnv(
        name,
        task,
        BODIES[task.body](task, engine, chosen),
        goals=chosen["goals"],
        start=chosen["start"],
        episode_length=chosen["episode_length"],
        reward=chosen["reward"],
        success_radius=task.success_radius if radius is None else radius,
        flip=chosen["flip"],
        fall=chosen["fall"],
        unhealthy=chosen["unhealthy"],
        at_goal=chosen["at_goal"],
        position_noise=chosen["position_noise"],
    )
