"""Socially guided intrinsic motivation (SGIM): what to practise, how, and with whose help.

    from star import sgim
    state = sgim.init(sgim.Config(), abstraction, costs=[1.0, 5.0])
    choice = jax.vmap(lambda key: sgim.select(config, state, key=key))(keys)  # [N]
    state = sgim.update(config, state, choice, competences)  # [N]

Source: S. M. Nguyen, habilitation thesis; SGIM-ACTS (Nguyen and Oudeyer 2012), SGIM-PB (Duminy, Nguyen, Duhaut 2021).

Modules that need JAX are imported at their first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from star.sgim.sections import CuttingConfig as Config

if TYPE_CHECKING:
    from star.sgim.cuts import follow, on_split, split
    from star.sgim.selection import (
        Choice,
        SgimState,
        credit,
        init,
        interest,
        probabilities,
        progress,
        remember,
        select,
        update,
    )

__all__ = [
    "Choice",
    "Config",
    "SgimState",
    "credit",
    "follow",
    "init",
    "interest",
    "on_split",
    "probabilities",
    "progress",
    "remember",
    "select",
    "split",
    "update",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'star.sgim' has no attribute {name!r}")
    home = "cuts" if name in ("follow", "on_split", "split") else "selection"
    value = getattr(importlib.import_module(f"star.sgim.{home}"), name)
    globals()[name] = value
    return value
