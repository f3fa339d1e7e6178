"""Teachers as data: what they demonstrate, where it comes from, and the file it is kept in.

A demonstration leads from a start to an outcome: by a route, and by the actions of its teacher if he shows them. A
learner asks for the one `nearest` to what it wants and makes the outcome its own goal (emulation), pursues the
waypoints one after another (decomposition), or repeats the actions (mimicry).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from envs import routes
from envs.arena import FREE, GOAL, ROBOT

STANDING = 0.5  # height of a body above the floor, in m, as in the goals of Ant Fall
MAX_ENDS = 128  # cells of a maze between which routes are shown


class Demonstrations(struct.PyTreeNode):
    """N demonstrations, in the d abstract dimensions (m). `states`, `actions` and `lengths` are None without actions.

    Waypoints leave out the start; they end with the outcome, repeated up to L. A trajectory is `lengths[n]` env steps:
    `actions[n, t]` was done in `states[n, t]`, `states[n, lengths[n]]` is its end, repeated up to T.
    """

    starts: Float[Array, "N d"]
    outcomes: Float[Array, "N d"]
    waypoints: Float[Array, "N L d"]
    states: Float[Array, "N T state"] | None = None
    actions: Float[Array, "N T act"] | None = None
    lengths: Int[Array, "N"] | None = None


def nearest(demos: Demonstrations, start: Float[Array, "*B d"] | None, goal: Float[Array, "*B d"]) -> Int[Array, "*B"]:
    """The demonstration that is nearest: by the squared distances of its start and its outcome, summed.

    Without `start` the outcome alone counts. Of several it is the first.
    """
    squared = _squared(goal, demos.outcomes)
    if start is not None:
        squared += _squared(start, demos.starts)
    return jnp.argmin(squared, axis=-1)


def shortest_paths(env: Any) -> Demonstrations:
    """Routes from every free cell of the map of `env` to every one that can be reached from it, itself included.

    They lead from centre to centre; waypoints are the centres where a shortest way turns (`envs.routes`), at `STANDING`
    above the floor. Of a map with more than `MAX_ENDS` free cells as many serve, evenly spread, and the robot's.
    """
    arena = env.arena
    free = list(arena.cells(FREE + ROBOT + GOAL))
    spread = np.linspace(0, len(free) - 1, min(len(free), MAX_ENDS)).astype(int)
    ends = {free[i] for i in spread} | {arena.origin}
    shown = [
        (arena.centre(start), way)
        for start in sorted(ends)
        for way in routes.routes(arena, start, ends, env.switch).values()
    ]
    longest = max(len(way) for _, way in shown)
    height = arena.floor_height + STANDING

    def abstract(points: list) -> Array:
        flat = np.asarray(points, np.float32)
        whole = np.concatenate([flat, np.full((*flat.shape[:-1], 1), height, np.float32)], axis=-1)
        return jnp.asarray(whole[..., np.asarray(env.abstract_indices)])

    return Demonstrations(
        starts=abstract([start for start, _ in shown]),
        outcomes=abstract([way[-1] for _, way in shown]),
        waypoints=abstract([way + [way[-1]] * (longest - len(way)) for _, way in shown]),
    )


def _squared(points: Float[Array, "*B d"], others: Float[Array, "N d"]) -> Float[Array, "*B N"]:
    """Squared distances, summed one dimension after another: no array [*B, N, d] is made."""
    return sum((jnp.square(points[..., None, i] - others[:, i]) for i in range(others.shape[-1])), jnp.zeros(()))
