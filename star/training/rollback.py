"""Going back to the last checkpoint where numbers are no longer finite, and on from there with smaller steps.

`faults.jsonl` says how often that has happened to each seed, so that a run which is resumed has the same steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from star import devices
from star.training import faults
from star.training.faults import Fault
from star.training.journal import Journal
from star.training.program import Program


def goes_back(program: Program, journal: Journal, fault: Fault, *, to: int | None, warn: Callable[[str], None]) -> bool:
    """True if the run goes back for a `fault`, which is said; written down it is anyway.

    `to` is the last checkpoint's env steps, None if there is no checkpoint.
    """
    config, rolled = program.config.trainer, _past(journal)
    number = {seed: 1 + sum(row["seed"] == seed for row in rolled) for seed in fault.found}
    back = config.on_non_finite == "rollback" and to is not None and max(number.values()) <= config.rollbacks
    devices.wait("all processes know of the faults before")
    for seed, found in fault.found.items():
        row = {"env_steps": fault.env_steps, "seed": seed, "back_to": to if back else None, "found": found}
        journal.faults.write(row)
    devices.wait("the fault is in the journal")
    if back:
        whose = ", ".join(
            f"{config.rollback_factor**n:g} for seed {seed} ({n} of {config.rollbacks})" for seed, n in number.items()
        )
        warn(f"{fault}; back to {to:,} env steps, learning rates times {whose}")
    return back


def slowed(program: Program, state: Any, journal: Journal, *, env_steps: int) -> tuple[Program, Any]:
    """`program` and the `state` restored at `env_steps`, with smaller learning rates for seeds that were rolled back.

    Seeds have numbers of their own then, so that the others go on as if nothing had happened.
    """
    rolled, config = _past(journal), program.config.trainer
    if not rolled and config.on_non_finite == "stop":
        return program, state

    def factors(rows: list[dict[str, Any]]) -> list[float]:
        return [config.rollback_factor ** sum(row["seed"] == seed for row in rows) for seed in program.seeds]

    hyper = jax.tree.map(lambda x: np.full(len(program.seeds), x, np.float32), program.config.hyper())
    # A step size that is part of the state was made smaller by the rollbacks before its checkpoint.
    since = [row for row in rolled if row["back_to"] >= env_steps]
    return replace(program, hyper=faults.slower(hyper, factors(rolled))), faults.slower(state, factors(since))


def _past(journal: Journal) -> list[dict[str, Any]]:
    return [row for row in journal.faults.read() if row["back_to"] is not None]
