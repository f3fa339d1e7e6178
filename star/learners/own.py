"""A learner of a user's own, whose mistakes are told in one line each while its functions are traced."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from envs.common import plugins, trees
from envs.common.errors import UserError
from star.learners.protocol import Learner


def find(name: str) -> Learner:
    """The learner `module:name`. Its functions raise `UserError` that names it, for what they raise or give wrongly."""
    own: Any = plugins.Guarded(plugins.find(name, Learner), f"learner {name}")
    return Learner(own.Config, partial(_init, own, name), own.act, partial(_update, own, name), own.shards)


def _init(own: Any, name: str, key: Array, config: Any, *, example: Any) -> Any:
    state = own.init(key, config, example=example)
    size = config.chunk * example.action.shape[-1]
    obs = jax.ShapeDtypeStruct((1, *example.obs.shape), example.obs.dtype)
    for deterministic in (False, True):
        acts = partial(own.act, deterministic=deterministic)
        found = jax.eval_shape(lambda state, obs, key, acts=acts: acts(config, state, obs, key=key), state, obs, key)
        if getattr(found, "shape", None) != (1, size):
            raise UserError(
                f"learner {name}: act gives {trees.described(found)} for observations [1, {example.obs.shape[-1]}]; "
                f"allowed: actions [1, {size}]"
            )
    return state


def _update(own: Any, name: str, config: Any, state: Any, rollout: Any, **more: Any) -> tuple[Any, dict[str, Array]]:
    found = own.update(config, state, rollout, **more)
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[1], Mapping)):
        raise UserError(f"learner {name}: update gives a {type(found).__name__}; allowed: state, {{metric: number}}")
    wrong = trees.difference(state, found[0], began="init")
    if wrong is not None:
        raise UserError(f"learner {name}: update {wrong}")
    for metric, value in found[1].items():
        if jnp.shape(value) != ():
            raise UserError(
                f"learner {name}: update's metric {metric} is {trees.described(value)}; allowed: one number"
            )
    return found
