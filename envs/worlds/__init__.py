"""Worlds for learners of skills: a sequence of primitives goes in, outcomes come out.

>>> from envs import worlds
>>> world = worlds.make("pen")
>>> outcomes = world.execute(sequences, lengths)

See docs/worlds.md for every world, and for a world of your own. Nothing here knows of agents.
"""

from __future__ import annotations

import dataclasses
import importlib
from typing import Any

from envs.common import modes, plugins
from envs.common.errors import shown
from envs.options import EnvError, known, made, number, resolve
from envs.worlds.checks import check
from envs.worlds.world import Decomposition, Outcomes, Task, Trace, World, outcomes

__all__ = ["Decomposition", "Outcomes", "Task", "Trace", "World", "make", "names", "outcomes"]

_HOMES = {name: f"envs.worlds.{name}" for name in ("pen", "throw", "fishing", "table")}
_NOISE = {"noise": number(0.0, 0.0, 1.0)}
_OPTIONS = {
    "fishing": {"scale": number(1.0, 1.0, 100.0)},
    "table": {"links": number(1.0, 0.8, 1.0), "limits": number(1.0, 0.5, 1.0)},
}


def names() -> tuple[str, ...]:
    """The worlds that `make` knows."""
    return tuple(_HOMES)


def make(name: str, *, noise: float = 0.0, **options: Any) -> World:
    """Build a world.

    Args:
      name: one of `names()`, or `module:name`, a function of your own that makes a `World`. Its module is used only if
        `envs.common.plugins` is told to trust it.
      noise: standard deviation of what is added to every number of a primitive when it is executed.
      **options: those of your own function, or of a world that has some: docs/worlds.md.

    Raises:
      EnvError: in one line, if a name, an option or a value is wrong.
      UserError: in one line, if your function cannot be had, or JAX is in a mode that nothing here runs in.
    """
    modes.check()
    if plugins.is_plugin(name):
        resolve(name, _NOISE, {"noise": noise})
        world = made(name, plugins.find_function(name, makes="a world"), options)
        try:
            check(world)
        except EnvError as error:
            raise EnvError(f"{name}: {error}") from error
    elif name in _HOMES:
        own = resolve(name, _NOISE | _OPTIONS.get(name, {}), options | {"noise": noise})
        world = importlib.import_module(_HOMES[name]).make(**{key: float(own[key]) for key in _OPTIONS.get(name, {})})
    else:
        raise EnvError(f"world {shown(name)} is unknown; {known(name, _HOMES)}, or module:name of your own")
    return dataclasses.replace(world, noise=float(noise))
