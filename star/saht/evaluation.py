"""The competence of a learner: for every goal of the evaluation, the distance to the nearest outcome in its memory.

Worlds always begin from rest, so without noise a sequence that is executed again has the same outcome: this is the
error of acting by the nearest neighbour.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from envs.worlds import World
from star.saht.memory import FAR, Memory, Piece, Scale, least, squared

NEVER = 5.0
"""The error of a task that was never reached."""
CLOSE = 0.1  # of the diagonal of the goals' box: goals whose nearest outcome is within it are counted as the area


def best(
    memory: Memory, rows: Array | int, scale: Scale, task: int, goals: Float[Array, "n 4"], *, procedures: bool = False
) -> tuple[Float[Array, "n"], Float[Array, "n"], Int[Array, "n"]]:
    """Of the row nearest to each goal of a task: its distance in units of the world, its scaled one, and its number.

    With `procedures` of those rows that are one; where there are none it is any row.
    """
    width = jnp.asarray(scale.width)[task]
    wanted = (goals - jnp.asarray(scale.lower)[task]) / width

    def value(part: Piece) -> Array:
        square = squared(part.outcomes * width[:, None], wanted * width)
        return jnp.where(part.pair >= 0, square, jnp.inf) if procedures else square

    _, row = least(memory, rows, jnp.asarray(task), value, (len(goals),))
    apart = memory.outcomes[task, :, row] - wanted
    scaled = jnp.linalg.norm(apart, axis=-1)
    error = jnp.linalg.norm(apart * width, axis=-1)
    return jnp.where(scaled < FAR / 2, error, NEVER), scaled, row


def errors(
    world: World, scale: Scale, goals: Sequence[np.ndarray], memory: Memory, rows: Array | int, *, key: Array
) -> dict[str, Any]:
    """`error` and `area` of each task, on its goals [n, 4], and the mean error.

    With noise also `executed`: the mean error of the best rows when they are executed once more.
    """
    found: dict[str, Any] = {}
    executed = []
    for task, name in enumerate(world.names):
        wanted = jnp.asarray(goals[task])
        error, scaled, row = best(memory, rows, scale, task, wanted)
        close = CLOSE * float(np.linalg.norm(np.ptp(goals[task], axis=0)))
        found |= {f"error_{name}": error.mean(), f"area_{name}": ((error < close) & (scaled < FAR / 2)).mean()}
        if world.noise:
            again = world.execute(memory.sequences[row], memory.lengths[row], key=jax.random.fold_in(key, task))
            apart = jnp.linalg.norm(again.value[:, task] - wanted, axis=-1)
            executed.append(jnp.where(again.reached[:, task], apart, NEVER).mean())
    mean = sum(found[f"error_{name}"] for name in world.names) / len(world.names)
    return {"error": mean} | found | ({"executed": sum(executed) / len(executed)} if executed else {})
