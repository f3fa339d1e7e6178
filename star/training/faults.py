"""Numbers that are no longer finite: counted on the device in every epoch, named on the host once there are any.

    count(state)        in the jitted epoch: how many numbers of each part of the state are not finite
    broken(row)         on the host: which metrics of an epoch tell of it; they come to the host anyway
    find(table, state)  on the host: which tensors of which seeds, looked for only if some metric does

A kind of experiment says what may be NaN or infinite, and which metrics count what it has repaired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from star.training.state import leaf_name

Row = Mapping[str, Any]
Tree = TypeVar("Tree")

_COUNT = "non_finite"  # ends the name of every metric that counts what is not
_SEEN = "_non_finite"  # ends the name of one that counts them in what passes, such as `env/obs_non_finite`
_SMALL = 2**16  # numbers of a tensor that is copied to be looked through
_RATE = "learning_rate"  # ends the name of every step size


@dataclass(frozen=True)
class Fault:
    """Numbers not finite after so many env steps: for each seed, tensors and metrics with the count of each."""

    env_steps: int
    found: Mapping[int, Mapping[str, int]]

    def __str__(self) -> str:
        """One line: the first of each level, seed by seed."""
        seeds = "; ".join(f"seed {seed}: {_first_of_each_level(names)}" for seed, names in self.found.items())
        return f"not finite after {self.env_steps:,} env steps: {seeds}"


def count(state: Any, *, may_be_nan: Sequence[str] = ()) -> dict[str, jax.Array]:
    """Count of numbers not finite in each part of `state`, as metrics `part/non_finite`."""
    tensors: dict[str, list[jax.Array]] = {}
    for name, leaf in _numbers(state, may_be_nan):
        tensors.setdefault(f"{_level(name)}/{_COUNT}", []).append(leaf.reshape(-1))
    return {key: _not_finite(leaves) for key, leaves in tensors.items()}


def broken(row: Row, *, may_be_nan: Sequence[str] = ()) -> dict[str, str]:
    """The metrics of an epoch that are not finite, then those that count what is not, and what there is to say."""
    values = {key: f"{key} is not finite" for key, x in row.items() if isinstance(x, float) and not isfinite(x)}
    counts = {key: x for key, x in row.items() if key.endswith(_COUNT) and key not in may_be_nan and x > 0}
    return values | {key: f"{key} is {x:g}" for key, x in counts.items()}


def find(table: Sequence[Row], state: Any, *, env_steps: int, may_be_nan: Sequence[str] = ()) -> Fault | None:
    """Numbers not finite after an epoch: `table` has its row of each seed, in the order of the axis of `state`."""
    if not any(broken(row, may_be_nan=may_be_nan) for row in table):
        return None
    names, found = [name for name, _ in _numbers(state, may_be_nan)], {}
    counts = np.asarray(_per_tensor(state, may_be_nan=tuple(may_be_nan)))
    for i, row in enumerate(table):
        if keys := broken(row, may_be_nan=may_be_nan):
            seen = {key.removesuffix(_SEEN): int(row[key]) for key in keys if key.endswith(_SEEN)}
            tensors = {name: int(n) for name, n in zip(names, counts[:, i], strict=True) if n}
            metrics = {key: 1 for key in keys if not key.endswith(_COUNT)}
            found[int(row["seed"])] = seen | tensors | metrics
    return Fault(env_steps, found)


def slower(tree: Tree, factors: Sequence[float]) -> Tree:
    """A state, or the hyperparameters of a `Program`, with the learning rates of each seed times its factor.

    All leaves have the leading axis of seeds.
    """
    by = jnp.asarray(factors, jnp.float32)

    def scaled(path: Any, leaf: Any) -> Any:
        return leaf * by if leaf_name(path).endswith(_RATE) else leaf

    return jax.tree_util.tree_map_with_path(scaled, tree)


def _not_finite(tensors: list[jax.Array]) -> jax.Array:
    """Count of numbers not finite. Small tensors are looked through as one, which compiles sooner."""
    small = [tensor for tensor in tensors if tensor.size <= _SMALL]
    large = [tensor for tensor in tensors if tensor.size > _SMALL]
    together = [jnp.concatenate(small)] if small else []
    counts = [(~jnp.isfinite(tensor)).sum() for tensor in together + large]
    return sum(counts, jnp.zeros((), jnp.int32))


@partial(jax.jit, static_argnames="may_be_nan")
def _per_tensor(state: Any, *, may_be_nan: tuple[str, ...]) -> jax.Array:
    """For each tensor and seed [tensors, seeds], how many numbers are not finite."""
    leaves = [leaf for _, leaf in _numbers(state, may_be_nan)]
    return jnp.stack([(~jnp.isfinite(leaf)).reshape(leaf.shape[0], -1).sum(axis=1) for leaf in leaves])


def _numbers(state: Any, may_be_nan: Sequence[str]) -> list[tuple[str, jax.Array]]:
    """The tensors that have to be finite, with their names such as `controller/params/actor/params/Dense_0/bias`."""
    named = [(leaf_name(path), leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]]
    return [(name, x) for name, x in named if jnp.issubdtype(x.dtype, jnp.floating) and name not in may_be_nan]


def _level(name: str) -> str:
    return name.split("/")[0]


def _first_of_each_level(names: Mapping[str, int]) -> str:
    levels: dict[str, list[str]] = {}
    for name in names:
        levels.setdefault(_level(name), []).append(name)
    return ", ".join(first + (f" and {len(others)} more of it" if others else "") for first, *others in levels.values())
