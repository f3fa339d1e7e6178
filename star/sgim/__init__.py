"""Socially guided intrinsic motivation (SGIM): what to practise, how, and with whose help.

    from star import sgim
    state = sgim.init(sgim.Config(), abstraction, costs=[1.0, 5.0])
    choice = jax.vmap(lambda key: sgim.select(config, state, key=key))(keys)  # [N]
    state = sgim.update(config, state, choice, competences)  # [N]

Source: S. M. Nguyen, habilitation thesis; SGIM-ACTS (Nguyen and Oudeyer 2012), SGIM-PB (Duminy, Nguyen, Duhaut 2021).
"""

from star.config import SelectionConfig as Config
from star.sgim.selection import (
    Choice,
    SgimState,
    init,
    interest,
    on_split,
    probabilities,
    progress,
    select,
    split,
    update,
)

__all__ = [
    "Choice",
    "Config",
    "SgimState",
    "init",
    "interest",
    "on_split",
    "probabilities",
    "progress",
    "select",
    "split",
    "update",
]
