"""The environment that a config names: a task of `envs`, or what a function of a user's own makes.

env: {name: ant_maze}           `envs.make`
env: {name: "mine:make"}        make(goals="train" or "test", **options), see `envs.GoalEnv`; `engine` if it takes one
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import envs
from envs import goal_env
from envs.common.errors import where_raised
from envs.options import known
from star.agent.sections import Config
from star.config import plugins
from star.config.section import ConfigError


def make(config: Config, goals: str, **others: Any) -> Any:
    """The task of `config`: on its test goals with "test", as for training with "train"; `others` are options too.

    Raises:
      UserError: in one line, if it cannot be had.
    """
    if goals == "train":
        options = {"goals": goals} | config.env.options | config.env.training | others
    else:
        options = config.env.options | {"goals": goals} | others
    name, engine = config.env.name, config.env.engine
    try:
        if not plugins.is_plugin(name):
            return envs.make(name, engine=engine, **options)
        return goal_env.adapt(_made(name, engine, options), name=name)
    except envs.UserError as error:
        raise ConfigError(f"env: {error}") from None


def engine_of(config: Config, env: Any) -> str:
    """The engine to write down for `env`: that which is used, `auto` where the user's function is not asked for one."""
    name = config.env.name
    if plugins.is_plugin(name) and not _takes(_factory(name), "engine"):
        return "auto"
    return env.engine


def _factory(name: str) -> Callable[..., Any]:
    try:
        found: Any = plugins.find(name, object)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    try:
        inspect.signature(found)
    except (TypeError, ValueError):  # no function, or one in C
        allowed = "allowed: a function that makes an environment"
        raise ConfigError(f"{name}: is a {type(found).__name__}; {allowed}") from None
    return found


def _made(name: str, engine: str, options: dict[str, Any]) -> Any:
    """What the user's function makes."""
    factory = _factory(name)
    if engine != "auto":
        if not _takes(factory, "engine"):
            raise ConfigError(f'engine is "{engine}", but {name} takes no engine; allowed: auto')
        options = options | {"engine": engine}
    for option in options:
        if not _takes(factory, option):
            if option == "goals":
                raise ConfigError(f"{name}: takes no goals; allowed: def make(goals), which is given train or test")
            taken = [p.name for p in inspect.signature(factory).parameters.values()]
            raise ConfigError(f'option "{option}" is not one of {name}; {known(option, taken)}')
    try:
        return factory(**options)
    except envs.UserError as error:
        raise ConfigError(f"{name}: {error}") from None
    except Exception as error:  # whatever its author has done
        raise ConfigError(f"{name}: raises {where_raised(error)}") from error


def _takes(factory: Callable[..., Any], option: str) -> bool:
    """Whether it may be called with this keyword."""
    parameters = inspect.signature(factory).parameters.values()
    return any(p.kind == p.VAR_KEYWORD or (p.name == option and p.kind != p.POSITIONAL_ONLY) for p in parameters)
