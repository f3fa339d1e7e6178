"""The memory that a run needs at least: one that cannot fit is refused before anything is written."""

from __future__ import annotations

import math
import os
from typing import Any

import jax

from star.config.section import ConfigError
from star.training.program import Program
from star.training.state import leaf_name

_NUMBER = 4  # bytes


def check(program: Program, *, copies: int = 1) -> None:
    """Raise `UserError` if so many runs of `program` side by side cannot fit into the memory of the device."""
    found, room = needed(program), available(program.config.trainer.devices)
    total = copies * sum(found.values())
    if total > room:
        largest = max(found, key=lambda name: found[name])
        raise ConfigError(
            f"the run needs at least {_gib(total)} of memory, {_gib(copies * found[largest])} of it for {largest}; "
            f"there are {_gib(room)}"
        )


def needed(program: Program) -> dict[str, int]:
    """Bytes for each part of the state, and for the largest of what comes and goes in an epoch; a lower bound."""
    found: dict[str, int] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(program.example())[0]:
        part = leaf_name(path).partition("/")[0]
        found[part] = found.get(part, 0) + size(leaf)
    passing = program.experiment.scratch(len(program.seeds))
    if passing:
        largest = max(passing, key=lambda name: passing[name])
        found[largest] = found.get(largest, 0) + passing[largest]
    return found


def available(devices: int = 1) -> int:
    """Bytes of the memory of so many devices like the first one here, or of the machines where it does not tell."""
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    if limit:
        return devices * limit
    return jax.process_count() * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def size(tree: Any) -> int:
    """Bytes of arrays, or of shapes."""
    leaves = jax.tree.leaves(tree)
    return sum(math.prod(x.shape) * (x.dtype.itemsize if hasattr(x.dtype, "itemsize") else _NUMBER) for x in leaves)


def _gib(count: int) -> str:
    return f"{count / 2**30:,.1f} GiB"
