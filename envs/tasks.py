"""The registry: one row of data for each task, and `make`, which turns a row into an environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from envs import ant
from envs.arena import Arena, build_model
from envs.maze import Body, Geometry, Goals, MazeEnv
from envs.options import EnvError, Option, choice, count, duration, known, resolve
from envs.physics import INTEGRATORS, SOLVERS, Physics, engines, resolve_engine
from envs.point import Point


@dataclass(frozen=True)
class Task:
    """A row of the registry. `goals` names the sets of goals, the first being the default."""

    arena: Arena
    geometry: Geometry
    goals: Mapping[str, Goals]
    build: Callable[[Arena, str, Mapping[str, Any]], Body]
    engines: tuple[str, ...]
    options: Mapping[str, Option]


MAZE = Arena(rows=("11111", "1r001", "11101", "10001", "11111"), cell=8.0, wall_height=4.0)

MAZE_GEOMETRY = Geometry(
    goal_indices=(0, 1),
    success_radius=5.0,
    abstract_indices=(0, 1),
    space=((-4.0, -4.0), (20.0, 20.0)),
    region_cuts=((8.0,), (8.0,)),
    subgoal_scale=(10.0, 10.0),
)

MAZE_GOALS = {
    "train": Goals(lower=(-4.0, -4.0), upper=(20.0, 20.0)),
    "test": Goals(lower=(0.0, 16.0), upper=(0.0, 16.0)),
}


# `fast` is accurate enough to learn on and several times cheaper; `published` is the paper's integrator with
# MuJoCo's own limits on the solver. All 13 geoms of the ant collide with floor and walls in both.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {"integrator": "implicitfast", "iterations": 10, "ls_iterations": 10},
    "published": {"integrator": "rk4", "iterations": 100, "ls_iterations": 50},
}

ANT_OPTIONS = {
    "episode_length": count(500),
    "preset": choice(*PRESETS),
    "timestep": duration(0.02),
    "frames": count(5),
    "solver": choice(*SOLVERS),
    "integrator": replace(choice(*INTEGRATORS), default=None),  # None: that of the preset
    "iterations": count(None),
    "ls_iterations": count(None),
}


def _point(arena: Arena, engine: str, options: Mapping[str, Any]) -> Body:
    return Point(arena.walls())


def _ant(arena: Arena, engine: str, options: Mapping[str, Any]) -> Body:
    given = {key: value for key, value in options.items() if value is not None}
    chosen = {**PRESETS[options["preset"]], **given}
    model = build_model(
        arena,
        ant.xml(),
        {
            "timestep": chosen["timestep"],
            "integrator": INTEGRATORS[chosen["integrator"]],
            "solver": SOLVERS[chosen["solver"]],
            "iterations": chosen["iterations"],
            "ls_iterations": chosen["ls_iterations"],
        },
    )
    return ant.Ant(Physics(model, engine=resolve_engine(engine), frames=chosen["frames"]))


TASKS: Mapping[str, Task] = {
    "point_maze": Task(
        arena=MAZE,
        geometry=MAZE_GEOMETRY,
        goals=MAZE_GOALS,
        build=_point,
        engines=("auto", "jax"),
        options={"episode_length": count(500)},
    ),
    "ant_maze": Task(
        arena=MAZE,
        geometry=MAZE_GEOMETRY,
        goals=MAZE_GOALS,
        build=_ant,
        engines=engines(),
        options=ANT_OPTIONS,
    ),
}


def names() -> tuple[str, ...]:
    """The names that `make` knows."""
    return tuple(TASKS)


def make(name: str, *, engine: str = "auto", **options: Any) -> MazeEnv:
    """Build a task.

    Args:
      name: one of `names()`.
      engine: the physics engine; `auto` takes the fastest one that this machine has.
      **options: options of the task, see docs/environments.md.

    Raises:
      EnvError: in one line, if a name or value is unknown, or the engine cannot run here.
    """
    if name not in TASKS:
        raise EnvError(f'task "{name}" is unknown; {known(name, TASKS)}')
    task = TASKS[name]
    if engine not in task.engines:
        raise EnvError(f'engine "{engine}" is not one of {name}; {known(engine, task.engines)}')
    chosen = resolve(name, {"goals": choice(*task.goals), **task.options}, options)
    return MazeEnv(
        name,
        task.arena,
        task.build(task.arena, engine, chosen),
        task.goals[chosen["goals"]],
        task.geometry,
        episode_length=chosen["episode_length"],
    )
