"""The ant: 8 motors, and the 30 numbers that the paper's agents observe.

    state = qpos[0:15], qvel[0:14], t * .001      t in env steps
    start = qpos0 + U(-.1, .1), N(0, .1^2)        qpos0 has the torso at z = .75 and every joint at 0

qpos is x, y, z in m, a unit quaternion (w, x, y, z), then hip and ankle of legs 1 to 4 in rad; qvel is the velocity
of the torso in m/s (world frame), its angular velocity in rad/s (body frame), then the 8 joint velocities, of which
the last is not observed. Actions follow the order of the joints, 1 standing for 30 N m.
"""

from __future__ import annotations

from importlib import resources

import jax
import jax.numpy as jnp

from envs.physics import Physics, PhysicsState

MAX_TORQUE = 30.0  # N m
START_POSITION = 0.1  # half-range of the start qpos, m and rad
START_SPEED = 0.1  # standard deviation of the start qvel, m/s and rad/s
STEP_SCALE = 0.001  # of the step count in the state
OBSERVED_QPOS = 15
OBSERVED_QVEL = 14


def xml() -> str:
    """The ant's own model, without floor or walls."""
    return resources.files("envs").joinpath("assets", "ant.xml").read_text(encoding="utf-8")


class Ant:
    """The body for `MazeEnv`: state of 30, 8 actions."""

    state_dim = OBSERVED_QPOS + OBSERVED_QVEL + 1

    def __init__(self, physics: Physics):
        """Live in the model of `physics`, whose first 15 qpos, 14 qvel and 8 controls are the ant's."""
        self.physics = physics
        self.model = physics.model
        self.action_size = physics.model.nu
        self.dt = physics.dt
        self.engine = physics.engine
        self._start = jnp.asarray(physics.model.qpos0, jnp.float32)

    def init(self, rng: jax.Array) -> PhysicsState:
        """A noisy start at the origin."""
        qpos_rng, qvel_rng = jax.random.split(rng)
        noise = jax.random.uniform(qpos_rng, self._start.shape, minval=-START_POSITION, maxval=START_POSITION)
        qpos = self._start + noise
        attitude = qpos[3:7] / jnp.linalg.norm(qpos[3:7])
        qvel = START_SPEED * jax.random.normal(qvel_rng, (self.model.nv,))
        return self.physics.init(qpos.at[3:7].set(attitude), qvel)

    def step(self, data: PhysicsState, action: jax.Array) -> PhysicsState:
        """Hold the torques of `action` [8], in [-1, 1], for `dt` seconds."""
        return self.physics.step(data, MAX_TORQUE * action)

    def observe(self, data: PhysicsState, steps: jax.Array) -> jax.Array:
        """The state [30]."""
        clock = STEP_SCALE * steps.astype(jnp.float32)
        return jnp.concatenate([data.qpos[:OBSERVED_QPOS], data.qvel[:OBSERVED_QVEL], clock[None]])
