"""The maze environment: a body in an arena, a goal to reach.

    obs     = state, desired goal
    reward  = - || achieved goal - desired goal ||        (r_ext of the paper, in m)
    success = distance < success_radius, at this step

An episode is truncated after `episode_length` steps. It is terminated only if the simulation turns non-finite;
the observation then stays what it was, and stepping on stays terminated until the next reset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State
from flax import struct

from envs.arena import Arena


class Body(Protocol):
    """What moves in the maze. Its data is any pytree of floating point arrays."""

    state_dim: int
    action_size: int
    dt: float
    engine: str

    def init(self, rng: jax.Array) -> Any:
        """The data at the start of an episode."""

    def step(self, data: Any, action: jax.Array) -> Any:
        """The data `dt` seconds later; `action` [action_size] in [-1, 1]."""

    def observe(self, data: Any, steps: jax.Array) -> jax.Array:
        """The state [state_dim], `steps` env steps into the episode."""


@dataclass(frozen=True)
class Goals:
    """Desired goals: uniform in a box. `lower` and `upper` are corners over the goal dimensions, in m."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def sample(self, rng: jax.Array) -> jax.Array:
        """One goal [k]."""
        lower, upper = jnp.asarray(self.lower, jnp.float32), jnp.asarray(self.upper, jnp.float32)
        return jax.random.uniform(rng, lower.shape, minval=lower, maxval=upper)


@dataclass(frozen=True)
class Geometry:
    """What a hierarchical agent is told of a task; indices are those of the state.

    `space` is (lower, upper) of the abstract dimensions, `region_cuts` the interior cuts of each of them, which
    give the first regions, `subgoal_scale` the half-range of a subgoal along each.
    """

    goal_indices: tuple[int, ...]
    success_radius: float
    abstract_indices: tuple[int, ...]
    space: tuple[tuple[float, ...], tuple[float, ...]]
    region_cuts: tuple[tuple[float, ...], ...]
    subgoal_scale: tuple[float, ...]


@struct.dataclass
class Simulation:
    """The body's data, and the env steps since the last reset (int32)."""

    data: Any
    steps: jax.Array


class MazeEnv(Env):
    """A brax environment of one body: `reset` and `step` are pure and can be jitted, scanned and vmapped once.

    For a batch use `envs.VectorEnv`, which stays one physics batch under any number of outer vmaps.
    """

    def __init__(self, name: str, arena: Arena, body: Body, goals: Goals, geometry: Geometry, *, episode_length: int):
        self.name = name
        self.arena = arena
        self.episode_length = episode_length
        self.engine = body.engine
        self.state_dim = body.state_dim
        self.dt = body.dt
        self.goal_indices = geometry.goal_indices
        self.success_radius = geometry.success_radius
        self.abstract_indices = geometry.abstract_indices
        self.space = tuple(np.asarray(corner, np.float32) for corner in geometry.space)
        self.region_cuts = geometry.region_cuts
        self.subgoal_scale = geometry.subgoal_scale
        self._body = body
        self._goals = goals

    @property
    def observation_size(self) -> int:
        """Length of an observation: the state and the desired goal."""
        return self.state_dim + len(self.goal_indices)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self._body.action_size

    @property
    def backend(self) -> str:
        """Brax's word for the engine."""
        return self.engine

    @property
    def body(self) -> Body:
        """What moves in the maze."""
        return self._body

    def reset(self, rng: jax.Array) -> State:
        """A new episode with a new goal; `rng` is a typed or a raw key."""
        body_rng, goal_rng = jax.random.split(rng)
        steps = jnp.zeros((), jnp.int32)
        data = self._body.init(body_rng)
        goal = self._goals.sample(goal_rng)
        obs = jnp.concatenate([self._body.observe(data, steps), goal])
        return State(
            pipeline_state=Simulation(data=data, steps=steps),
            obs=obs,
            reward=jnp.zeros(()),
            done=jnp.zeros(()),
            metrics=self._metrics(obs),
            info={"steps": steps, "truncation": jnp.zeros(()), "goal": goal},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """One env step of `dt` seconds; `action` [action_size] is clipped to [-1, 1]."""
        data = self._body.step(state.pipeline_state.data, jnp.clip(action, -1.0, 1.0))
        steps = state.pipeline_state.steps + 1
        seen = self._body.observe(data, steps)
        finite = _all_finite(data) & jnp.isfinite(seen).all()
        obs = jnp.where(finite, jnp.concatenate([seen, state.info["goal"]]), state.obs)
        metrics = self._metrics(obs)
        truncated = finite & (steps >= self.episode_length)
        info = {
            "steps": steps.astype(state.info["steps"].dtype),
            "truncation": truncated.astype(jnp.float32),
        }
        return state.replace(
            pipeline_state=Simulation(data=data, steps=steps),
            obs=obs,
            reward=-metrics["distance"],
            done=(truncated | ~finite).astype(jnp.float32),
            metrics={**state.metrics, **metrics},
            info={**state.info, **info},
        )

    def _metrics(self, obs: jax.Array) -> dict[str, jax.Array]:
        achieved = obs[np.asarray(self.goal_indices)]
        distance = jnp.linalg.norm(achieved - obs[self.state_dim :])
        return {"distance": distance, "success": (distance < self.success_radius).astype(jnp.float32)}


def _all_finite(data: Any) -> jax.Array:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(data)]).all()
