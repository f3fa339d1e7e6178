"""The modes of JAX that this project does not run in."""

from __future__ import annotations

import os
from typing import Any

import jax

from envs.common.errors import UserError

KEYS = "threefry2x32"
"""The kind of all keys that runs, checkpoints and seeded environments have, whichever JAX makes by itself."""


def check() -> None:
    """Raise `UserError` in one line that names the mode, if numbers would not be float32, or types not promoted."""
    config: Any = jax.config  # its values are told of by no stub
    if config.jax_enable_x64:
        raise UserError("JAX_ENABLE_X64: is on; all of this computes with float32: switch it off")
    if config.jax_numpy_dtype_promotion != "standard":
        raise UserError("JAX_NUMPY_DTYPE_PROMOTION: is strict; allowed: standard")


def check_learning() -> None:
    """Raise `UserError` in one line that names a mode in which nothing runs that learns, though environments may."""
    check()
    config: Any = jax.config
    if config.jax_debug_infs:
        raise UserError("JAX_DEBUG_INFS: is on; what is not known yet is infinite here: switch it off")
    if config.jax_numpy_rank_promotion == "raise":
        raise UserError("JAX_NUMPY_RANK_PROMOTION: is raise; allowed: allow, warn")


def check_training() -> None:
    """Raise `UserError` in one line that names a mode in which no run can be trained, or go on as it was."""
    config: Any = jax.config
    if not config.jax_threefry_partitionable:
        raise UserError("JAX_THREEFRY_PARTITIONABLE: is off, which changes what is drawn; allowed: on")
    check_learning()


def key(seed: Any) -> jax.Array:
    """The random key of a seed: the same in every mode of JAX that decides about keys."""
    return jax.random.key(seed, impl=KEYS)


def missing_device() -> str | None:
    """The line for a person, if JAX has none of the devices that JAX_PLATFORMS names; None if it has one."""
    try:
        jax.default_backend()
    except (RuntimeError, AssertionError):  # the latter is what JAX raises where CUDA is not installed
        asked = os.environ.get("JAX_PLATFORMS", "")
        return f"JAX_PLATFORMS: {asked!r} is not available here; allowed: cpu, or not set: what JAX finds by itself"
    return None
