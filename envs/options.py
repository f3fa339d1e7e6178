"""Options of the tasks: what each may be, presets of them, and the one error that says what was wrong."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from envs.common import plugins
from envs.common.errors import UserError, shown, where_raised
from envs.common.plainly import plain

INTEGRATORS = ("implicitfast", "euler", "rk4")
SOLVERS = ("newton", "cg")
CONES = ("pyramidal", "elliptic")
ENGINES = ("auto", "native", "jax", "warp")
ENDS = ("ignore", "terminate", "truncate")  # what a mishap may do to the episode
CELL_SIZES = (1.5, 100.0)  # m
AT_GOAL = (*ENDS, "new_goal")  # what success may do to it

JAXGCRL = ("jaxgcrl", "jaxgcrl_spring")  # models of its ant, and the presets of the same names
_JAXGCRL: Mapping[str, Any] = {
    "integrator": "euler",
    "iterations": 1,
    "ls_iterations": 4,
    "timestep": 0.01,
    "margin": 0.0,
    "action_scale": 5.0,
    "observe": "untimed",
    "unhealthy": "terminate",
    "episode_length": 1000,
}
# `fast` is accurate enough to learn on and several times cheaper; `published` is the paper's integrator with
# MuJoCo's own limits on the solver. All 13 geoms of the ant collide with floor and walls in both. `jaxgcrl` is the
# ant of JaxGCRL on its backend `mjx` (Bortkiewicz et al. 2025), `jaxgcrl_spring` has the masses and hinges of
# its `spring` and begins on the floor.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    "fast": {"integrator": "implicitfast", "iterations": 10, "ls_iterations": 10},
    "published": {"integrator": "rk4", "iterations": 100, "ls_iterations": 50},
    **{name: {**_JAXGCRL, "model": name} for name in JAXGCRL},
}


class EnvError(UserError):
    """A task, engine or option that cannot be had. The message is one line: key, value, what is allowed."""


@dataclass(frozen=True)
class Option:
    """An option's default, the test of a value, and the words for what passes it."""

    default: Any
    accepts: Callable[[Any], bool]
    allowed: str


def choice(default: str, *others: str) -> Option:
    """One of a few words."""
    words = (default, *others)
    return Option(default, lambda value: isinstance(value, str) and value in words, ", ".join(words))


def count(default: int | None, most: int) -> Option:
    """A whole number from 1 to `most`."""
    return Option(default, lambda value: type(value) is int and 1 <= value <= most, f"a whole number from 1 to {most}")


def duration(default: float | None, most: float) -> Option:
    """A positive number of seconds up to `most`."""
    return Option(
        default,
        lambda value: type(value) in (int, float) and 0 < value <= most,
        f"a number of seconds above 0, up to {most:g}",
    )


def number(default: float | None, low: float, high: float, unit: str = "") -> Option:
    """A number from `low` to `high`."""
    words = f"a number from {low:g} to {high:g}" + (f" {unit}" if unit else "")
    return Option(default, lambda value: type(value) in (int, float) and low <= value <= high, words)


MAP = Option(None, lambda value: isinstance(value, str) and bool(value), "the path of a map, or its rows")

COMMON: Mapping[str, Option] = {
    "episode_length": count(500, 100_000),
    "observe": choice("published", "full"),
    "reward": choice("distance", "sparse"),
    "success_radius": number(None, 0.01, 100.0, "m"),
    "cell": number(None, *CELL_SIZES, "m"),
    "action_scale": number(1.0, 0.01, 10.0),
    "position_noise": number(0.0, 0.0, 1.0, "m"),
    "flip": choice(*ENDS),
    "fall": choice(*ENDS),
    "unhealthy": choice(*ENDS),
    "at_goal": choice(*AT_GOAL),
}

ANT: Mapping[str, Option] = {
    "observe": choice("published", "full", "untimed"),
    "model": choice("published", *JAXGCRL, "gymnasium"),
    "collisions": choice("all", "feet"),
    "margin": number(0.01, 0.0, 0.1, "m"),
    "wall_margin": number(0.0, 0.0, 0.1, "m"),
    "timestep": duration(0.02, 1.0),
    "frames": count(5, 1000),
    "solver": choice(*SOLVERS),
    "cone": choice(*CONES),
    "integrator": replace(choice(*INTEGRATORS), default=None),  # None: that of the preset
    "iterations": count(None, 10_000),
    "ls_iterations": count(None, 10_000),
}


def normal(given: Mapping[str, Any]) -> dict[str, Any]:
    """`given` in the types that YAML has, and a map given as a list of rows as their text."""
    options = {key: plain(value) for key, value in given.items()}
    rows = options.get("map")
    if isinstance(rows, list) and all(isinstance(row, str) for row in rows):
        options["map"] = "\n".join(rows) + "\n"
    return options


def resolve(task: str, options: Mapping[str, Option], given: Mapping[str, Any]) -> dict[str, Any]:
    """The value of every option: as given, else its default.

    Raises:
      EnvError: if a name is unknown or a value is not allowed.
    """
    for key, value in given.items():
        if key not in options:
            raise EnvError(f'option "{key[:60]}" ({shown(value)}) is not one of {task}: {known(key, options)}')
        if not options[key].accepts(value):
            raise EnvError(f'option "{key}" of {task} is {shown(value)}; allowed: {options[key].allowed}')
    return {key: given.get(key, option.default) for key, option in options.items()}


def made(name: str, factory: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """Call a user's own function with these options; errors call it `name`.

    Raises:
      EnvError: in one line, if it does not take one of them, or raises something.
    """
    for option in given:
        if not plugins.takes(factory, option):
            taken = [p.name for p in inspect.signature(factory).parameters.values()]
            raise EnvError(f'option "{option}" is not one of {name}; {known(option, taken)}')
    try:
        return factory(**given)
    except UserError as error:
        raise EnvError(f"{name}: {error}") from None
    except (Exception, SystemExit) as error:  # whatever its author has done
        raise EnvError(f"{name}: raises {where_raised(error)}") from error


def known(word: str, words: Iterable[str]) -> str:
    """The allowed words, with the one nearest to `word` if any is near."""
    words = tuple(words)
    nearest = difflib.get_close_matches(str(word), words, n=1)
    return "allowed: " + ", ".join(words) + (f'; did you mean "{nearest[0]}"?' if nearest else "")
