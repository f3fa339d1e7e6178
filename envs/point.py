"""The point: a square body that slides along walls, in pure JAX.

    v' = .7 v + .3 max_speed a      a in [-1, 1]^2 is the commanded velocity over max_speed
    x' = x + dt v'                  stopped by walls and closed gates, first along x, then along y

Some tasks have numbers other than .7 and .3, and a limit on v: `tasks.Motion`. A stop along an axis sets the velocity
along it to 0. The move along an axis is limited by the nearest wall ahead, whatever its length, so the body cannot jump
through a wall.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.arena import HEIGHT
from envs.tasks import Switch, Task


class PointState(struct.PyTreeNode):
    """Position [2] in m and velocity [2] in m/s; `open` [] is 1.0 once the gates are open."""

    position: jax.Array
    velocity: jax.Array
    open: jax.Array


def build(task: Task, engine: str, options: Mapping[str, Any]) -> Point:
    """The point in the arena of `task`."""
    return Point(task, action_scale=options["action_scale"], full=options["observe"] == "full")


class Point:
    """The body for `MazeEnv`: state (x, y, vx, vy), and 1 for each open gate if `full`; 2 actions."""

    action_size = 2
    orientation: tuple[int, ...] = ()
    velocity: tuple[int, ...] = ()
    engine = "jax"

    def __init__(self, task: Task, *, action_scale: float = 1.0, full: bool = False):
        """Live among the walls and gates of the task's arena."""
        self._motion = task.motion
        self._place_noise, self._start_speed = task.place_noise, task.pose_noise
        self.dt = task.motion.dt
        walls, gates = task.arena.walls(), task.arena.gates()
        grown = np.concatenate([walls, gates]) + task.motion.radius * np.array([-1, -1, 1, 1])
        self._lower = np.asarray(grown[:, :2], np.float32)
        self._upper = np.asarray(grown[:, 2:], np.float32)
        self._is_gate = np.arange(len(grown)) >= len(walls)
        self._gates = len(gates)
        self._arena = task.arena
        self._switch: Switch | None = task.switch
        self._max_speed = action_scale * task.motion.speed
        self._full = full
        self.state_dim = 4 + self._gates * full

    def init(self, rng: jax.Array, position: jax.Array) -> PointState:
        """A start near `position` [2], nearly at rest."""
        position_rng, velocity_rng = jax.random.split(rng)
        noise = jax.random.uniform(position_rng, (2,), minval=-self._place_noise, maxval=self._place_noise)
        return PointState(
            position=position + noise,
            velocity=self._start_speed * jax.random.normal(velocity_rng, (2,)),
            open=jnp.zeros(()),
        )

    def step(self, data: PointState, action: jax.Array) -> PointState:
        """Move for `dt` seconds, then open the gates if it is time; `action` [2] in [-1, 1]."""
        response, limit = self._motion.response, self._motion.limit
        before = jnp.clip(data.velocity, -limit, limit)
        velocity = (1 - response) * before + response * self._max_speed * action
        moved, stopped = self._move(data, self.dt * velocity)
        is_open = data.open
        if self._switch is not None:
            is_open = jnp.maximum(is_open, self._switch.holds(moved.position).astype(jnp.float32))
        return moved.replace(velocity=jnp.where(stopped, 0.0, velocity), open=is_open)

    def observe(self, data: PointState, steps: jax.Array) -> jax.Array:
        """The state [state_dim]: x, y in m, vx, vy in m/s."""
        flags = [jnp.full(self._gates, data.open)] if self._full else []
        return jnp.concatenate([data.position, data.velocity, *flags])

    def displace(self, data: PointState, offset: jax.Array) -> PointState:
        """The point moved by `offset` [2], as far as the walls let it."""
        return self._move(data, offset)[0]

    def flipped(self, data: PointState) -> jax.Array:
        """Never."""
        return jnp.zeros((), bool)

    def fallen(self, data: PointState) -> jax.Array:
        """Never."""
        return jnp.zeros((), bool)

    def unhealthy(self, data: PointState) -> jax.Array:
        """Never."""
        return jnp.zeros((), bool)

    def dropped(self, data: PointState) -> jax.Array:
        """Never."""
        return jnp.zeros((), bool)

    def model(self) -> Any:
        """A box on two slides in the arena, to draw."""
        import mujoco

        from envs import scene

        spec, radius = mujoco.MjSpec(), self._motion.radius
        body = spec.worldbody.add_body(name="point", pos=[0, 0, radius])
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[radius] * 3, rgba=(0.8, 0.6, 0.4, 1.0), contype=0, conaffinity=0
        )
        for name in ("x", "y"):
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=scene.AXES[name])
        return scene.build_model(self._arena, spec, {}, visual=True)

    def pose(self, data: PointState) -> tuple[Any, Any]:
        """(qpos [2], mocap_pos [gates, 3])."""
        gates = self._arena.gates()
        z = jnp.where(data.open > 0, 2.5, 0.5) * HEIGHT
        centres = (gates[:, :2] + gates[:, 2:]) / 2
        return data.position, jnp.concatenate([centres, jnp.full((len(gates), 1), z)], axis=1)

    def _move(self, data: PointState, offset: jax.Array) -> tuple[PointState, jax.Array]:
        """As far along `offset` [2] as the walls let it, first along x, then along y; and which walls stopped [2]."""
        aim = data.position + offset
        x, at_x = self._advance(0, data.open, data.position[0], data.position[1], aim[0])
        y, at_y = self._advance(1, data.open, data.position[1], x, aim[1])
        return data.replace(position=jnp.stack([x, y])), jnp.stack([at_x, at_y])

    def _advance(
        self, axis: int, is_open: jax.Array, here: jax.Array, across: jax.Array, aim: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """End of a move along `axis` from `here` to `aim`, the other coordinate being `across`; if at a wall."""
        there = (is_open == 0) | ~self._is_gate
        beside = there & (across > self._lower[:, 1 - axis]) & (across < self._upper[:, 1 - axis])
        ahead = jnp.where(beside & (here <= self._lower[:, axis]), self._lower[:, axis], jnp.inf)
        behind = jnp.where(beside & (here >= self._upper[:, axis]), self._upper[:, axis], -jnp.inf)
        low, high = behind.max(), ahead.min()
        return jnp.clip(aim, low, high), (aim < low) | (aim > high)
