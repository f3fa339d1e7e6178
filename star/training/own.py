"""An experiment of a user's own, whose mistakes are told in one line each."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp

from envs.common import plugins, trees
from envs.common.errors import shown
from star.config.kinds import Kind
from star.config.section import ConfigError
from star.training.experiment import PARTS


def build(kind: Kind, config: Any) -> Any:
    """The experiment of `config`; raises `UserError` that names it, for what it raises or gives wrongly."""
    name = f"experiment: {config.experiment}"
    made = plugins.Guarded(kind, name).build(config)
    for part in PARTS:
        if part not in dir(made):
            raise ConfigError(f"{name}: has no {part}; all have {', '.join(PARTS)}")
    checked = Checked(made, name, kind)
    steps = checked.steps_per_epoch
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ConfigError(f"{name}: steps_per_epoch is {shown(steps)}; allowed: a whole number above 0")
    return checked


class Checked(plugins.Guarded):
    """An experiment that looks at what the functions of another one give."""

    def __init__(self, value: Any, name: str, kind: Kind) -> None:
        super().__init__(value, name)
        self._measures = [measure.name for measure in kind.measures]

    def init(self, hyper: Any, keys: jax.Array) -> Any:
        """As of the experiment; its state counts epochs, and all of it has the axis of seeds."""
        state = self.__getattr__("init")(hyper, keys)
        if not hasattr(state, "epoch"):
            self._refuse("its state has no `epoch`, which counts them from 0 on")
        seeds = keys.shape[:1]
        for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]:
            if jnp.shape(leaf)[:1] != seeds:
                part = jax.tree_util.keystr(path).lstrip(".")
                self._refuse(f"init makes {part} {trees.described(leaf)}; allowed: an axis of seeds first, @over_seeds")
        if jnp.shape(state.epoch) != seeds or not jnp.issubdtype(jnp.result_type(state.epoch), jnp.integer):
            self._refuse(f"init makes epoch {trees.described(state.epoch)}; allowed: int32 {list(seeds)}")
        return state

    def epoch(self, hyper: Any, data: Any, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        """As of the experiment; the state keeps its shapes, and metrics are a number for each seed."""
        found = self.__getattr__("epoch")(hyper, data, state)
        if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Mapping)):
            self._refuse(f"epoch gives a {type(found).__name__}; allowed: state, {{metric: number}}")
        wrong = trees.difference(state, found[0], began="init")
        if wrong is not None:
            self._refuse(f"epoch {wrong}")
        seeds = jnp.shape(state.epoch)
        for metric, value in found[1].items():
            if not hasattr(value, "dtype") or value.shape != seeds:
                self._refuse(f"epoch's {metric} is {trees.described(value)}; allowed: a number for each seed")
        return found

    def rows(self, evaluated: Any) -> list[dict[str, Any]]:
        """As of the experiment; numbers by their names, and all measures among them."""
        found = self.__getattr__("rows")(evaluated)
        seeds = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(evaluated)}
        if not (
            isinstance(found, list | tuple)
            and all(isinstance(row, Mapping) for row in found)
            and (len(seeds) != 1 or (len(found),) in seeds)
        ):
            self._refuse(f"rows gives {shown(found)}; allowed: a list with a mapping for each seed")
        for row in found:
            for measure in self._measures:
                if measure not in row:
                    self._refuse(f"rows lacks {measure}, a measure of its Kind; it has {', '.join(map(str, row))}")
            for key, value in row.items():
                if isinstance(value, bool) or not isinstance(value, Real):
                    self._refuse(f"rows gives {key} {shown(value)}; allowed: a number")
        return list(found)

    def _refuse(self, what: str) -> None:
        raise ConfigError(f"{self._name}: {what}")
