"""The environment that a config names: a task of `envs`, or what a function of a user's own makes.

env: {name: ant_maze}           `envs.make`
env: {name: "mine:make"}        make(goals="train" or "test", **options), see `envs.GoalEnv`; `engine` if it takes one
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import envs
from envs import goal_env
from envs.common import plugins
from envs.common.errors import shown
from envs.options import made
from star.agent.sections import Config
from star.config.section import ConfigError


def make(config: Config, goals: str, **others: Any) -> Any:
    """The task of `config`: for training with "train", for tests with "test"; `others` are options too.

    With "trained" it is that of tests with the goals of training.

    Raises:
      UserError: in one line, if it cannot be had.
    """
    name, engine, options = config.env.name, config.env.engine, options_of(config, goals) | others
    for key in ("engine",) if plugins.is_plugin(name) else ("engine", "name"):
        if key in options:
            raise ConfigError(f"env: option {key} ({shown(options[key])}) stands beside the options, as env.{key}")
    try:
        if not plugins.is_plugin(name):
            return envs.make(name, engine=engine, **options)
        return goal_env.adapt(_made(name, engine, options), name=name)
    except envs.UserError as error:
        raise ConfigError(f"env: {error}") from None


def options_of(config: Config, goals: str) -> dict[str, Any]:
    """The options of the task of `config`, for `goals` as in `make`."""
    training = {"goals": "train"} | config.env.options | config.env.training
    if goals == "train":
        return training
    return config.env.options | {"goals": training["goals"] if goals == "trained" else goals}


def engine_of(config: Config, env: Any) -> str:
    """The engine to write down for `env`: that which is used, `auto` where the user's function is not asked for one."""
    name = config.env.name
    if plugins.is_plugin(name) and not plugins.takes(_factory(name), "engine"):
        return "auto"
    return env.engine


def _factory(name: str) -> Callable[..., Any]:
    return plugins.find_function(name, makes="an environment")


def _made(name: str, engine: str, options: dict[str, Any]) -> Any:
    """The environment that the user's function makes."""
    factory = _factory(name)
    if engine != "auto":
        if not plugins.takes(factory, "engine"):
            raise ConfigError(f'engine is "{engine}", but {name} takes no engine; allowed: auto')
        options = options | {"engine": engine}
    if "goals" in options and not plugins.takes(factory, "goals"):
        raise ConfigError(f"{name}: takes no goals; allowed: def make(goals), which is given train or test")
    return made(name, factory, options)
