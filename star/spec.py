"""The levels' knowledge of the environment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from envs.maze import uprightness, yaw


@dataclass(frozen=True)
class Spec:
    """The levels' knowledge of the environment."""

    state_dim: int
    action_size: int
    episode_length: int
    abstract_indices: tuple[int, ...]
    goal_indices: tuple[int, ...]
    subgoal_scale: tuple[float, ...]
    space: tuple[tuple[float, ...], tuple[float, ...]]
    region_cuts: tuple[tuple[float, ...], ...]
    success_radius: float
    orientation: tuple[int, ...] = ()
    """Indices of the body's unit quaternion (w, x, y, z) in the state; empty if it has none."""
    velocity: tuple[int, ...] = ()
    """Indices of the body's velocity along x and y, in the world's axes; empty if it has no orientation."""
    heading: float | None = None
    """Length, in m, of the heading vector that subgoals set too; None if they do not."""

    @classmethod
    def of(cls, env: Any, *, heading: float | None = None) -> Spec:
        """Read the spec off an environment of `envs.make`."""
        return cls(
            state_dim=env.state_dim,
            action_size=env.action_size,
            episode_length=env.episode_length,
            abstract_indices=tuple(env.abstract_indices),
            goal_indices=tuple(env.goal_indices),
            subgoal_scale=tuple(env.subgoal_scale),
            space=(tuple(map(float, env.space[0])), tuple(map(float, env.space[1]))),
            region_cuts=tuple(tuple(cut) for cut in env.region_cuts),
            success_radius=float(env.success_radius),
            orientation=tuple(env.orientation),
            velocity=tuple(env.velocity),
            heading=heading,
        )

    def within(self, env: Any) -> Spec:
        """The same levels in another environment: its episodes and its goals, their own space and subgoals."""
        return replace(
            self,
            episode_length=env.episode_length,
            goal_indices=tuple(env.goal_indices),
            success_radius=float(env.success_radius),
        )

    @property
    def cube(self) -> float:
        """Half-width of the cube inside the ball of success around a goal, in units of the state."""
        return self.success_radius / len(self.goal_indices) ** 0.5

    @property
    def scale(self) -> Float[Array, "p"]:
        """Half-ranges of the Tutor's subgoals."""
        return jnp.asarray(self.subgoal_scale + ((self.heading, self.heading) if self.heading else ()))

    def state(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch state"]:
        """The state part of an observation."""
        return obs[..., : self.state_dim]

    def goal(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch goal"]:
        """The task goal g* in an observation."""
        return obs[..., self.state_dim :]

    def success(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch"]:
        """1 where the goal counts as reached, else 0."""
        distance = jnp.linalg.norm(obs[..., np.asarray(self.goal_indices)] - self.goal(obs), axis=-1)
        return (distance < self.success_radius).astype(jnp.float32)

    def abstract(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch d"]:
        """The abstract dimensions of an observation."""
        return obs[..., np.asarray(self.abstract_indices)]

    def pose(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch p"]:
        """The dimensions of subgoals: the abstract dimensions, and with a `heading` the vector of that length ahead.

        The latter is (cos, sin) of the yaw, the angle about z, times the length: in the same unit as positions.
        """
        if not self.heading:
            return self.abstract(obs)
        facing = yaw(obs[..., np.asarray(self.orientation)])
        ahead = self.heading * jnp.stack([jnp.cos(facing), jnp.sin(facing)], axis=-1)
        return jnp.concatenate([self.abstract(obs), ahead], axis=-1)

    def tilt(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch"]:
        """1 - cos of the angle between the body's up axis and the world's: 0 upright, 1 on its side, 2 on its back."""
        return 1.0 - uprightness(obs[..., np.asarray(self.orientation)])

    def turned(
        self, state: Float[Array, "*batch state"], ways: Float[Array, "*batch m"]
    ) -> tuple[Float[Array, "*batch state"], Float[Array, "*batch m"]]:
        """`state` and `ways`, abstract ones or subgoals one after another, turned about z until the body's yaw is 0.

        Of the velocity are left the parts ahead and to the left, of the orientation the tilt, with the real part >= 0.
        """
        quaternion = state[..., np.asarray(self.orientation)]
        facing = yaw(quaternion)
        w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
        c, s = jnp.cos(facing / 2), jnp.sin(facing / 2)
        tilt = jnp.stack([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w], axis=-1)
        tilt = jnp.where(tilt[..., :1] < 0, -tilt, tilt)
        cos, sin = jnp.cos(facing), jnp.sin(facing)

        def turn(way: Array) -> Array:
            return jnp.stack([cos * way[..., 0] + sin * way[..., 1], cos * way[..., 1] - sin * way[..., 0]], axis=-1)

        order = np.arange(state.shape[-1])
        order[[*self.velocity, *self.orientation]] = state.shape[-1] + np.arange(6)
        parts = [state, turn(state[..., np.asarray(self.velocity)]), tilt]
        each = len(self.abstract_indices)  # also where headings begin
        ways_one_by_one = jnp.split(ways, list(range(each, ways.shape[-1], each)), axis=-1)
        turned = [part for way in ways_one_by_one for part in (turn(way), way[..., 2:])]
        return jnp.concatenate(parts, axis=-1)[..., order], jnp.concatenate(turned, axis=-1)

    def towards(self, obs: Float[Array, "*batch obs"], point: Float[Array, "*batch d"]) -> Float[Array, "*batch p"]:
        """From the pose to that of having come straight to the abstract `point`, looking ahead."""
        way = point - self.abstract(obs)
        if not self.heading:
            return way
        flat = way[..., :2]
        ahead = self.heading * flat / jnp.maximum(jnp.linalg.norm(flat, axis=-1, keepdims=True), 1e-6)
        return jnp.concatenate([way, ahead - self.pose(obs)[..., way.shape[-1] :]], axis=-1)

    def goal_point(self, obs: Float[Array, "*batch obs"]) -> Float[Array, "*batch d"]:
        """g* as an abstract point; abstract dimensions that g* leaves open are those of the state."""
        columns = [
            self.goal(obs)[..., self.goal_indices.index(i)] if i in self.goal_indices else obs[..., i]
            for i in self.abstract_indices
        ]
        return jnp.stack(columns, axis=-1)

    def with_goal_point(
        self, goal: Float[Array, "*batch goal"], point: Float[Array, "*batch d"]
    ) -> Float[Array, "*batch goal"]:
        """The task goal at an abstract `point`; what is not abstract in it stays as in `goal`."""
        columns = [
            point[..., self.abstract_indices.index(i)] if i in self.abstract_indices else goal[..., column]
            for column, i in enumerate(self.goal_indices)
        ]
        return jnp.stack(columns, axis=-1)

    def in_goal(self) -> Bool[Array, "d"]:
        """Mask of the abstract dimensions that g* fixes."""
        return jnp.asarray([i in self.goal_indices for i in self.abstract_indices])
