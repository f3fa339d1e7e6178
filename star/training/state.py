"""The state of a run, as training sees it: a pytree whose leaves have names, with random keys in it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from envs.common import modes
from star.config.kinds import Arrays


def leaf_name(path: tuple[Any, ...]) -> str:
    """That of a leaf, such as `tutor/optimizer/1/count`, the same in a state and in what orbax reads without."""
    return jax.tree_util.keystr(path, simple=True, separator="/")


def plain(state: Any) -> Any:
    """Random keys as the integers they are made of, which is what can be written."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, state)


def with_keys(saved: Any, example: Any) -> Any:
    """`saved` with random keys again where `example` has some."""
    return jax.tree.map(
        lambda x, like: jax.random.wrap_key_data(x, impl=modes.KEYS) if _is_key(like) else x, saved, example
    )


def assembled(arrays: Arrays, template: Any) -> Any:
    """`arrays` in the structure of `template`, whose leaves give shape, type and sharding; raises `ValueError`."""

    def leaf(place: tuple[Any, ...], like: jax.ShapeDtypeStruct) -> jax.Array:
        name = leaf_name(place)
        found = arrays.get(name)
        if found is None:
            raise ValueError(f"{name} is missing")
        if (found.shape, found.dtype) != (like.shape, like.dtype):
            raise ValueError(f"{name} is {found.dtype}{list(found.shape)}, not {like.dtype}{list(like.shape)}")
        return jax.device_put(found, like.sharding)

    return jax.tree_util.tree_map_with_path(leaf, template)


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
