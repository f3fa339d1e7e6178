"""The maze environment: a body in an arena, a goal to reach.

    obs     = state, desired goal
    reward  = - || achieved goal - desired goal ||        (r_ext of the paper, in m; 1 or 0 for success if sparse)
    success = distance < success_radius, at this step

An episode is truncated after `episode_length` steps, and at once if the simulator fails: a state that is not finite,
contacts that were dropped. The observation then stays what it was. With `flip` it also ends when the body turns over,
with `fall` when it lies in a gap, with `unhealthy` when it is too low or too high, with `at_goal` upon success. With
`at_goal="new_goal"` it goes on from there with another goal, which is the next observation's.
An episode that has ended before its time stays as it is until the next reset.
"""

from __future__ import annotations

import math
from functools import cached_property
from numbers import Integral, Real
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs._quiet import Env, State
from envs.arena import Arena
from envs.common.errors import shown
from envs.options import ENDS, EnvError, known
from envs.places import Places
from envs.tasks import Switch, Task, on_map

NEW_GOALS = 16  # drawn where one is wanted that is not reached yet


class Body(Protocol):
    """The moving body in the maze. Its data is any pytree of floating point arrays."""

    state_dim: int
    action_size: int
    orientation: tuple[int, ...]
    """Indices of the state with the body's unit quaternion (w, x, y, z); empty if it has none."""
    velocity: tuple[int, ...]
    """Indices of the state with its velocity along x and y (m/s, world's axes); empty without an orientation."""
    dt: float

    @property
    def engine(self) -> str:
        """The physics engine."""

    def init(self, rng: jax.Array, position: jax.Array) -> Any:
        """The data at the start of an episode, near `position` [2]."""

    def step(self, data: Any, action: jax.Array) -> Any:
        """The data `dt` seconds later; `action` [action_size] in [-1, 1]."""

    def observe(self, data: Any, steps: jax.Array) -> jax.Array:
        """The state [state_dim], `steps` env steps into the episode."""

    def displace(self, data: Any, offset: jax.Array) -> Any:
        """The data with the body moved by `offset` [2], in m."""

    def flipped(self, data: Any) -> jax.Array:
        """True if the body lies on its back (bool)."""

    def fallen(self, data: Any) -> jax.Array:
        """True if the body is down in a gap of the floor (bool)."""

    def unhealthy(self, data: Any) -> jax.Array:
        """True if the body is lower or higher than it can walk (bool)."""

    def dropped(self, data: Any) -> jax.Array:
        """True if the engine dropped contacts in the last step (bool)."""

    def model(self) -> Any:
        """A MuJoCo model to draw the task with."""

    def pose(self, data: Any) -> tuple[Any, Any]:
        """(qpos, mocap_pos) of `data` in that model."""


class Simulation(struct.PyTreeNode):
    """The body's data, the env steps since the last reset (int32), and the key of noise and new goals (raw).

    `ended` is 1.0 if the episode has ended before its time, `terminated` 1.0 if the task ended it.
    """

    data: Any
    steps: jax.Array
    ended: jax.Array
    terminated: jax.Array
    noise: jax.Array


class MazeEnv(Env):
    """A brax environment of one body: `reset` and `step` are pure and can be jitted, scanned and vmapped once.

    For a batch use `envs.VectorEnv`, which stays one physics batch under any number of outer vmaps.
    """

    def __init__(
        self,
        name: str,
        task: Task,
        body: Body,
        *,
        goals: str,
        start: str,
        episode_length: int,
        reward: str,
        success_radius: float,
        flip: str = "ignore",
        fall: str = "ignore",
        unhealthy: str = "ignore",
        at_goal: str = "ignore",
        position_noise: float = 0.0,
    ):
        """`task` is a row of the registry; the other arguments are options of docs/environments.md."""
        self.name = name
        self.arena: Arena = task.arena
        self.switch: Switch | None = task.switch
        self.episode_length = episode_length
        self.state_dim = body.state_dim
        self.orientation = body.orientation
        self.velocity = body.velocity
        self.dt = body.dt
        self.success_radius = success_radius
        geometry = task.geometry
        self.goal_indices = geometry.goal_indices
        self.abstract_indices = geometry.abstract_indices
        self.space = tuple(np.asarray(corner, np.float32) for corner in geometry.space)
        self.region_cuts = geometry.region_cuts
        self.subgoal_scale = geometry.subgoal_scale
        self._body = body
        self._goals = task.pairs[goals] if goals in task.pairs else task.goals[goals]
        self._paired = goals in task.pairs and start == "task"
        self._starts = task.starts[start]
        self._sparse = reward == "sparse"
        self._ends = {"flipped": flip, "fallen": fall, "unhealthy": unhealthy}
        self._at_goal = at_goal
        self._position_noise = position_noise

    @classmethod
    def of(
        cls,
        name: str,
        body: Body,
        arena: Arena,
        *,
        goals: str = "train",
        start: str = "task",
        episode_length: int = 500,
        reward: str = "distance",
        success_radius: float | None = None,
        clearance: float = 1.0,
        flip: str = "ignore",
        fall: str = "ignore",
    ) -> MazeEnv:
        """A body of the user's own in an arena of theirs.

        Args:
          name: what it is called in pictures.
          body: what moves, such as a `Robot`. Its position (x, y) comes first in its state.
          arena: where it moves, see `read_arena`.
          goals: `train`, anywhere in the free cells; `test`, the cells marked `g` or the one that is farthest away.
          start: `task`, the cells marked `r`; `free`, anywhere.
          episode_length: env steps.
          reward: `distance`, minus the distance to the goal (m); `sparse`, 1 for success and else 0.
          success_radius: m; None is 5/8 of a cell.
          clearance: m that starts and goals keep from the sides of a cell.
          flip: what ends an episode where the body lies on its back: `ignore` (nothing), `terminate`, `truncate`.
          fall: the same where it lies in a gap of the floor.

        Raises:
          EnvError: in one line, for a value that is not allowed.

        """
        task = on_map("", arena, clearance=clearance)
        for what, word, words in (
            ("goals", goals, task.goals),
            ("start", start, task.starts),
            ("reward", reward, ("distance", "sparse")),
            ("flip", flip, ENDS),
            ("fall", fall, ENDS),
        ):
            if word not in words:
                raise EnvError(f"{name}: {what} is {word!r}; {known(str(word), words)}")
        radius = task.success_radius if success_radius is None else success_radius
        _check_number(f"{name}: episode_length", episode_length, whole=True)
        _check_number(f"{name}: success_radius", radius, whole=False)
        return cls(
            name,
            task,
            body,
            goals=goals,
            start=start,
            episode_length=episode_length,
            reward=reward,
            success_radius=radius,
            flip=flip,
            fall=fall,
        )

    @property
    def observation_size(self) -> int:
        """Length of an observation: the state and the desired goal."""
        return self.state_dim + len(self.goal_indices)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self._body.action_size

    @property
    def engine(self) -> str:
        """The physics engine that is used; on its first use JAX looks for its devices."""
        return self._body.engine

    @property
    def backend(self) -> str:
        """Brax's word for the engine."""
        return self.engine

    @property
    def walls(self) -> np.ndarray:
        """Merged wall rectangles [n, 4] as (x_lo, y_lo, x_hi, y_hi), in m."""
        return self.arena.walls()

    @property
    def body(self) -> Body:
        """The moving body in the maze."""
        return self._body

    @cached_property
    def model(self) -> Any:
        """A `mujoco.MjModel` to draw the task with; `pose` says how."""
        return self._body.model()

    def pose(self, data: Any) -> tuple[Any, Any]:
        """(qpos [nq], mocap_pos [nmocap, 3]) that show the body's `data`, of one environment, in `model`."""
        return self._body.pose(data)

    def reward(self, achieved: Any, desired: Any) -> Any:
        """The reward [...] for goals [..., k] of NumPy or JAX, under the task's options."""
        distance = _distance(achieved, desired)
        return (distance < self.success_radius).astype(distance.dtype) if self._sparse else -distance

    def reset(self, rng: jax.Array) -> State:
        """A new episode with a new goal; `rng` is a typed or a raw key."""
        body_rng, goal_rng, start_rng, noise_rng = jax.random.split(rng, 4)
        steps = jnp.zeros((), jnp.int32)
        place, goal = self._drawn(start_rng, goal_rng)
        data = self._body.init(body_rng, place)
        obs = jnp.concatenate([self._body.observe(data, steps), goal])
        noise = noise_rng if jnp.issubdtype(noise_rng.dtype, jnp.uint32) else jax.random.key_data(noise_rng)
        zero = jnp.zeros(())
        return State(
            pipeline_state=Simulation(data=data, steps=steps, ended=zero, terminated=zero, noise=noise),
            obs=obs,
            reward=zero,
            done=zero,
            metrics=self._metrics(obs) | {"non_finite": zero, "overflow": zero} | dict.fromkeys(self._ends, zero),
            info={"steps": steps, "truncation": zero, "goal": goal},
        )

    def draw_goal(self, rng: jax.Array) -> jax.Array:
        """A desired goal [k], as an episode may have."""
        return sample(self._goals, rng)[-len(self.goal_indices) :]

    def _drawn(self, start_rng: jax.Array, goal_rng: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The place [2] of a start, and a desired goal [k]."""
        if self._paired:
            both = sample(self._goals, goal_rng)
            return both[:2], both[2:]
        return sample(self._starts, start_rng), self.draw_goal(goal_rng)

    def with_goal(self, state: State, goal: jax.Array) -> State:
        """`state`, at the start of an episode, with another desired goal [k]."""
        obs = state.obs.at[self.state_dim :].set(goal)
        metrics = {**state.metrics, **self._metrics(obs)}
        return state.replace(obs=obs, metrics=metrics, info={**state.info, "goal": goal})

    def step(self, state: State, action: jax.Array) -> State:
        """One env step of `dt` seconds; `action` [action_size] is clipped to [-1, 1]."""
        before = state.pipeline_state
        noise, now = before.noise, None
        if self._position_noise or self._at_goal == "new_goal":
            noise, now = jax.random.split(noise)
        data = self._shaken(self._body.step(before.data, jnp.clip(action, -1.0, 1.0)), now)
        steps = before.steps + 1
        seen = self._body.observe(data, steps)
        non_finite = ~(all_finite(data) & jnp.isfinite(seen).all())
        overflow = ~non_finite & self._body.dropped(data)
        mishaps = {name: ~non_finite & getattr(self._body, name)(data) for name in self._ends}
        going, failed = before.ended == 0, non_finite | overflow
        obs = jnp.where(going & ~failed, jnp.concatenate([seen, state.info["goal"]]), state.obs)
        told = self._metrics(obs)
        terminated = (before.terminated > 0) | (going & ~failed & self._ended_by(mishaps, told, "terminate"))
        ended = ~going | failed | terminated | self._ended_by(mishaps, told, "truncate")
        done = ended | (steps >= self.episode_length)
        metrics = told | {
            "non_finite": (going & non_finite).astype(jnp.float32),
            "overflow": (going & overflow).astype(jnp.float32),
            **{name: happened.astype(jnp.float32) for name, happened in mishaps.items()},
        }
        info = {
            "steps": steps.astype(state.info["steps"].dtype),
            "truncation": (done & ~terminated).astype(jnp.float32),
            "goal": self._next_goal(state.info["goal"], obs, going & ~failed & (told["success"] > 0), now),
        }
        flags = {"ended": ended.astype(jnp.float32), "terminated": terminated.astype(jnp.float32)}
        return state.replace(
            pipeline_state=Simulation(data=data, steps=steps, noise=noise, **flags),
            obs=obs,
            reward=self.reward(obs[np.asarray(self.goal_indices)], obs[self.state_dim :]),
            done=done.astype(jnp.float32),
            metrics={**state.metrics, **metrics},
            info={**state.info, **info},
        )

    def _ended_by(self, mishaps: dict[str, jax.Array], told: dict[str, jax.Array], how: str) -> jax.Array:
        """True if one of `mishaps`, or the success `told` of, is to end the episode by `how`."""
        reached = (told["success"] > 0) & (self._at_goal == how)
        return jnp.any(jnp.stack([reached, *(mishaps[name] & (self._ends[name] == how) for name in mishaps)]))

    def _next_goal(self, goal: jax.Array, obs: jax.Array, reached: jax.Array, rng: jax.Array | None) -> jax.Array:
        """The desired goal [k] of the next env step: under `new_goal`, if `reached`, another one that is not yet."""
        if self._at_goal != "new_goal" or rng is None:
            return goal
        others = jax.vmap(self.draw_goal)(jax.random.split(jax.random.fold_in(rng, 1), NEW_GOALS))
        far = _distance(obs[np.asarray(self.goal_indices)], others) >= self.success_radius
        return jnp.where(reached, others[jnp.argmax(far)], goal)

    def _shaken(self, data: Any, rng: jax.Array | None) -> Any:
        """`data` with noise on the body's position."""
        if not self._position_noise or rng is None:
            return data
        return self._body.displace(data, self._position_noise * jax.random.normal(rng, (2,)))

    def _metrics(self, obs: jax.Array) -> dict[str, jax.Array]:
        distance = _distance(obs[np.asarray(self.goal_indices)], obs[self.state_dim :])
        return {"distance": distance, "success": (distance < self.success_radius).astype(jnp.float32)}


def yaw(quaternion: jax.Array) -> jax.Array:
    """Angle about z [...], in rad from -pi to pi, of unit quaternions [..., 4] (w, x, y, z)."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))


def uprightness(quaternion: jax.Array) -> jax.Array:
    """Vertical part [...] of the up axis of unit quaternions [..., 4] (w, x, y, z): 1 upright, -1 on its back."""
    _, x, y, _ = jnp.moveaxis(quaternion, -1, 0)
    return 1.0 - 2.0 * (x**2 + y**2)


def sample(places: Places, rng: jax.Array) -> jax.Array:
    """One point [k] of `places`."""
    lower, upper = np.asarray(places.lower, np.float32), np.asarray(places.upper, np.float32)
    sides = upper - lower
    volume = np.where(sides > 0, sides, 1.0).prod(axis=1) * (sides > 0).any(axis=1)
    share = volume / volume.sum() if volume.any() else np.full(len(lower), 1 / len(lower))
    choice_rng, point_rng = jax.random.split(rng)
    i = jnp.searchsorted(jnp.cumsum(jnp.asarray(share)), jax.random.uniform(choice_rng))
    i = jnp.minimum(i, len(lower) - 1)
    low, high = jnp.asarray(lower)[i], jnp.asarray(upper)[i]
    return low + (high - low) * jax.random.uniform(point_rng, low.shape)


def _distance(achieved: Any, desired: Any) -> Any:
    return ((achieved - desired) ** 2).sum(axis=-1) ** 0.5


def _check_number(what: str, number: Any, *, whole: bool) -> None:
    kind = isinstance(number, Integral if whole else Real) and not isinstance(number, bool)
    if not kind or not 0 < float(number) < math.inf:
        raise EnvError(f"{what} is {shown(number)}; allowed: a {'whole ' * whole}number above 0")


def all_finite(data: Any) -> jax.Array:
    """True if no floating point number in a pytree is NaN or infinite (bool)."""
    numbers = [leaf for leaf in jax.tree.leaves(data) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in numbers]).all()
