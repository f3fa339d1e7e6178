"""Pytrees that must stay as they began, such as the state of an environment or of a learner."""

from __future__ import annotations

from typing import Any

import jax

from envs.common.errors import shown


def difference(first: Any, after: Any, *, began: str) -> str | None:
    """The first difference in structure, shape or type between two pytrees, in words; None if there is none.

    `began` is what made the `first` one, such as `reset`.
    """
    before, later = (dict(jax.tree_util.tree_flatten_with_path(tree)[0]) for tree in (first, after))
    for path in [*before, *later]:
        leaf = jax.tree_util.keystr(path).lstrip(".")
        if path not in later:
            return f"loses {leaf} of the state; allowed: what {began} gives, with the same shapes"
        if path not in before:
            return f"adds {leaf} to the state; allowed: what {began} gives, with the same shapes"
        if _kind(before[path]) != _kind(later[path]):
            return f"makes {leaf} {described(later[path])}; allowed: {described(before[path])}, as in {began}"
    one, other = jax.tree.structure(first), jax.tree.structure(after)
    if str(one) != str(other) and one != other:  # type: ignore[operator]  # texts may hold addresses
        return f"changes the structure of the state; allowed: that of {began}"
    return None


def described(value: Any) -> str:
    """A value by type and shape if it is an array, as `float32 [3]`."""
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "dtype") else shown(value)


def _kind(leaf: Any) -> Any:
    return (leaf.shape, leaf.dtype) if hasattr(leaf, "dtype") else type(leaf)
