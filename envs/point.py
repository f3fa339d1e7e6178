"""The point: a square body that slides along walls, in pure JAX.

    v' = .7 v + .3 max_speed a      a in [-1, 1]^2 is the commanded velocity over max_speed
    x' = x + dt v'                  stopped by the walls, first along x, then along y

A wall that stops the body along an axis sets its velocity along that axis to 0. The move along an axis is
limited by the nearest wall ahead, whatever its length, so the body cannot jump through a wall.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

MAX_SPEED = 4.0  # m/s along each axis
RADIUS = 0.5  # m, half the side of the square
RESPONSE = 0.3  # share of the commanded velocity taken on in one step
START_POSITION = 0.1  # m, half-range of the start position
START_SPEED = 0.1  # m/s, standard deviation of the start velocity


@struct.dataclass
class PointState:
    """Position [2] in m and velocity [2] in m/s."""

    position: jax.Array
    velocity: jax.Array


class Point:
    """The body for `MazeEnv`: state (x, y, vx, vy), 2 actions."""

    state_dim = 4
    action_size = 2
    dt = 0.1
    engine = "jax"

    def __init__(self, walls: np.ndarray):
        """Live among `walls` [n, 4], rows of (x_lo, y_lo, x_hi, y_hi) in m."""
        grown = np.asarray(walls) + RADIUS * np.array([-1, -1, 1, 1])
        self._lower = np.asarray(grown[:, :2], np.float32)
        self._upper = np.asarray(grown[:, 2:], np.float32)

    def init(self, rng: jax.Array) -> PointState:
        """A start near the origin, nearly at rest."""
        position_rng, velocity_rng = jax.random.split(rng)
        return PointState(
            position=jax.random.uniform(position_rng, (2,), minval=-START_POSITION, maxval=START_POSITION),
            velocity=START_SPEED * jax.random.normal(velocity_rng, (2,)),
        )

    def step(self, data: PointState, action: jax.Array) -> PointState:
        """Move for `dt` seconds; `action` [2] in [-1, 1]."""
        velocity = (1 - RESPONSE) * data.velocity + RESPONSE * MAX_SPEED * action
        aim = data.position + self.dt * velocity
        x = self._advance(0, data.position[0], data.position[1], aim[0])
        y = self._advance(1, data.position[1], x, aim[1])
        position = jnp.stack([x, y])
        return PointState(position=position, velocity=jnp.where(position == aim, velocity, 0.0))

    def observe(self, data: PointState, steps: jax.Array) -> jax.Array:
        """The state [4]: x, y in m, vx, vy in m/s."""
        return jnp.concatenate([data.position, data.velocity])

    def _advance(self, axis: int, here: jax.Array, across: jax.Array, aim: jax.Array) -> jax.Array:
        """Where a move along `axis` from `here` to `aim` ends, the other coordinate being `across`."""
        beside = (across > self._lower[:, 1 - axis]) & (across < self._upper[:, 1 - axis])
        ahead = jnp.where(beside & (here <= self._lower[:, axis]), self._lower[:, axis], jnp.inf)
        behind = jnp.where(beside & (here >= self._upper[:, axis]), self._upper[:, axis], -jnp.inf)
        return jnp.clip(aim, behind.max(), ahead.min())
