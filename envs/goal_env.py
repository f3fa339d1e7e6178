"""Environments of a user's own: what they must have, and how they become what `VectorEnv` and agents expect.

>>> env = envs.adapt(MyEnv(), name="mine:make")

A `GoalEnv` is a brax environment whose observations are its state, then the desired goal. `adapt` looks at all that it
has to have before anything runs. Optional members:

    info["steps"], info["truncation"]     an episode is truncated after `episode_length` steps; `done` before that,
                                          unless the environment calls it a truncation itself, is the task's own end
    an episode that has ended             stays as it is until the next reset
    a step that is not finite             is not made; the episode is truncated, and metrics["non_finite"] is 1
    actions                               are clipped to [-1, 1]
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs._quiet import Env, State
from envs.common import modes
from envs.common.batching import where
from envs.common.errors import shown, where_raised
from envs.common.trees import described, difference
from envs.maze import MazeEnv, all_finite
from envs.options import EnvError

Corner = Sequence[float]

DRAWN = ("model", "pose", "arena")  # what pictures need
TRIED = 64  # episodes that are begun to see what goals they have
ZEROS = ("non_finite", "overflow", "flipped", "fallen", "unhealthy")  # metrics that an environment need not have


class GoalEnv(Protocol):
    """Members that a user's environment must have; d is the number of abstract dimensions, k that of goals.

    Observations are float32 [state_dim + k]: the state, then the desired goal. `State.metrics` holds two scalars:
    `distance`, between what is achieved and the goal, and `success`, 1 where that is close enough, else 0.

    It may have, too:

        abstract_indices   tuple[int, ...]   which numbers of the state regions are about; default: `goal_indices`
        region_cuts        d tuples          where the first regions are cut; default: there is one
        orientation        4 indices         of the unit quaternion (w, x, y, z) of the body, in the state
        velocity           2 indices         of its velocity along x and y, in the world's axes
        dt                 float             length of an env step in s; default 1
        engine             str               the physics engine that is used
        name               str               how it is called in pictures; default: `module:name`

    and what some features need, which without it say so: `with_goal(state, goal)`, the state at the start of an episode
    with another goal (SGIM, `--goals grid`); `walls`, rectangles [n, 4] (x_lo, y_lo, x_hi, y_hi) for figures; `arena`,
    an `Arena` (teachers by map, shortest ways, `--goals grid`); `model`, `pose` and `arena` (`star render`).
    """

    state_dim: int
    action_size: int
    goal_indices: tuple[int, ...]
    """Indices of the state that the goal is about [k]."""
    space: tuple[Corner, Corner]
    """Lower and upper corner [d] of the abstract space; goals lie inside."""
    subgoal_scale: tuple[float, ...]
    """Largest distance of a subgoal along each abstract dimension [d], in units of the state."""
    success_radius: float
    """Distance below which the goal counts as reached, in units of the state."""
    episode_length: int
    """Env steps after which an episode is truncated."""

    def reset(self, rng: jax.Array) -> State:
        """A new episode with a new goal."""

    def step(self, state: State, action: jax.Array) -> State:
        """One env step; `action` [action_size] in [-1, 1]."""


class Wrapped(struct.PyTreeNode):
    """The environment's own state, env steps since the reset (int32), and flags 1.0 or 0.0 as in `maze.Simulation`."""

    data: State
    steps: jax.Array
    ended: jax.Array
    terminated: jax.Array


class Adapted(Env):
    """A `GoalEnv` with all that `VectorEnv` and agents expect; made by `adapt`."""

    def __init__(self, env: Any, *, name: str):
        self._env = env
        self.name: str = getattr(env, "name", name)
        self.state_dim = int(env.state_dim)
        self.episode_length = int(env.episode_length)
        self.goal_indices = _indices(env.goal_indices)
        self.abstract_indices = _indices(getattr(env, "abstract_indices", self.goal_indices))
        self.space = tuple(np.asarray(corner, np.float32) for corner in env.space)
        self.region_cuts = tuple(map(tuple, getattr(env, "region_cuts", ((),) * len(self.abstract_indices))))
        self.subgoal_scale = tuple(map(float, env.subgoal_scale))
        self.success_radius = float(env.success_radius)
        self.orientation = _indices(getattr(env, "orientation", ()))
        self.velocity = _indices(getattr(env, "velocity", ()))
        self.dt = float(getattr(env, "dt", 1.0))
        self.walls = np.asarray(getattr(env, "walls", ()), np.float64).reshape(-1, 4)
        self.arena = getattr(env, "arena", None)
        self.switch = None

    @property
    def observation_size(self) -> int:
        """Length of an observation: the state and the desired goal."""
        return self.state_dim + len(self.goal_indices)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return int(self._env.action_size)

    @property
    def engine(self) -> str:
        """The physics engine that is used; `auto` if the environment does not say."""
        return str(getattr(self._env, "engine", "auto"))

    @property
    def backend(self) -> str:
        """Brax's word for the engine."""
        return self.engine

    def reset(self, rng: jax.Array) -> State:
        """A new episode with a new goal."""
        zero = jnp.zeros(())
        inner = self._env.reset(rng)
        wrapped = Wrapped(data=inner, steps=jnp.zeros((), jnp.int32), ended=zero, terminated=zero)
        return _told(wrapped, {}, done=zero, non_finite=zero)

    def step(self, state: State, action: jax.Array) -> State:
        """One env step."""
        before = state.pipeline_state
        after = jax.tree.map(jnp.asarray, self._env.step(before.data, jnp.clip(action, -1.0, 1.0)))
        steps = before.steps + 1
        going, finite = before.ended == 0, all_finite(after)
        cut = jnp.asarray(after.info.get("truncation", 0.0), jnp.float32) > 0
        over = going & finite & (_scalar(after.done) > 0) & (steps < self.episode_length)
        terminated = (before.terminated > 0) | (over & ~cut)
        ended = ~going | ~finite | over
        wrapped = Wrapped(
            data=where(going & finite, after, before.data),
            steps=steps,
            ended=ended.astype(jnp.float32),
            terminated=terminated.astype(jnp.float32),
        )
        done = (ended | (steps >= self.episode_length)).astype(jnp.float32)
        told = _told(wrapped, state.info, done=done, non_finite=(going & ~finite).astype(jnp.float32))
        return told.replace(reward=jnp.where(going & finite, told.reward, 0.0))  # else nothing was done

    def draw_goal(self, rng: jax.Array) -> jax.Array:
        """A desired goal [k], as an episode may have."""
        return self._env.reset(rng).obs[self.state_dim :]

    def with_goal(self, state: State, goal: jax.Array) -> State:
        """`state`, at the start of an episode, with another desired goal [k]; see `need`."""
        inner = self._env.with_goal(state.pipeline_state.data, goal)
        return _told(state.pipeline_state.replace(data=inner), state.info, done=state.done, non_finite=jnp.zeros(()))

    @property
    def model(self) -> Any:
        """A `mujoco.MjModel` to draw the task with."""
        return self._env.model

    def pose(self, data: State) -> tuple[Any, Any]:
        """(qpos [nq], mocap_pos [nmocap, 3]) that show the environment's own state `data` in `model`."""
        return self._env.pose(data)


def adapt(env: Any, *, name: str) -> MazeEnv | Adapted:
    """`env`, a `GoalEnv` that is called `name`, as `VectorEnv` and agents expect it; a `MazeEnv` is that already.

    Raises:
      EnvError: in one line, if something is missing, is not what it should be, or fails.
    """
    modes.check()
    if isinstance(env, MazeEnv):
        return env
    _check_attributes(env, name)
    adapted = Adapted(env, name=name)
    _check_functions(adapted, env, name)
    return adapted


def need(env: Any, feature: str, *attributes: str) -> None:
    """Raise `EnvError` in one line if `env` lacks one of the attributes that `feature` needs."""
    for attribute in attributes:
        if not has(env, attribute):
            raise EnvError(f"{env.name} has no {attribute}, which {feature} needs; see envs.GoalEnv")


def has(env: Any, *attributes: str) -> bool:
    """True if the user's own environment has all of these attributes."""
    own = getattr(env, "_env", env)
    return all(getattr(own, attribute, None) is not None for attribute in attributes)


def _told(wrapped: Wrapped, info: dict[str, Any], *, done: jax.Array, non_finite: jax.Array) -> State:
    """`wrapped` as it looks from outside; what else there was in `info` stays."""
    inner, zero = wrapped.data, jnp.zeros(())
    metrics = {key: _scalar(inner.metrics.get(key, zero)) for key in ("distance", "success", *ZEROS)}
    return State(
        pipeline_state=wrapped,
        obs=inner.obs,
        reward=_scalar(inner.reward),
        done=done,
        metrics=metrics | {"non_finite": non_finite},
        info={**info, "steps": wrapped.steps, "truncation": done * (1 - wrapped.terminated)},
    )


def _scalar(value: Any) -> jax.Array:
    return jnp.asarray(value).astype(jnp.float32)


def _indices(values: Any) -> tuple[int, ...]:
    return tuple(map(int, values))


def _check_attributes(env: Any, name: str) -> None:
    """Raise `EnvError` if something of a `GoalEnv` is missing or is not what it should be."""
    if env is None or isinstance(env, type):
        what = "nothing" if env is None else f"the class {env.__name__}"
        raise EnvError(f"{name}: gives {what}; allowed: an environment, see envs.GoalEnv")

    def refuse(attribute: str, allowed: str) -> NoReturn:
        value = getattr(env, attribute, None)
        what = f"is {shown(value)}" if hasattr(env, attribute) else "is missing"
        raise EnvError(f"{name}: {attribute} {what}; allowed: {allowed}")

    for attribute in ("reset", "step"):
        if not callable(getattr(env, attribute, None)):
            refuse(attribute, "a method, as of a brax environment")
    for attribute in ("state_dim", "action_size", "episode_length"):
        value: Any = getattr(env, attribute, None)
        if not _is_whole(value) or not 1 <= value < 2**31:
            refuse(attribute, "a whole number above 0")
    state_dim = int(env.state_dim)
    for attribute, lengths, words in (
        ("goal_indices", range(1, state_dim + 1), "one or more different whole numbers"),
        ("abstract_indices", range(1, state_dim + 1), "one or more different whole numbers"),
        ("orientation", (0, 4), "none, or 4 different whole numbers"),
        ("velocity", (0, 2), "none, or 2 different whole numbers"),
    ):
        value = getattr(env, attribute, None)
        optional = attribute != "goal_indices" and not hasattr(env, attribute)
        if not optional and not _are_indices(value, lengths, state_dim):
            refuse(attribute, f"{words} from 0 to {state_dim - 1}")
    d = len(getattr(env, "abstract_indices", env.goal_indices))
    space = _numbers(getattr(env, "space", None))
    if space is None or space.shape != (2, d) or not (space[0] < space[1]).all():
        refuse("space", f"lower corner, then upper corner, {d} numbers each, one for each abstract dimension")
    scale = _numbers(getattr(env, "subgoal_scale", None))
    if scale is None or scale.shape != (d,) or not (scale > 0).all():
        refuse("subgoal_scale", f"{d} numbers above 0, one for each abstract dimension")
    for attribute in ("success_radius", "dt"):
        value = _numbers(getattr(env, attribute, 1.0 if attribute == "dt" else None))
        if value is None or value.shape != () or not value > 0:
            refuse(attribute, "a number above 0")
    cuts = getattr(env, "region_cuts", ((),) * d)
    parts = [_numbers(one) for one in cuts] if isinstance(cuts, list | tuple) else []
    if len(parts) != d or not all(part is not None and part.ndim == 1 for part in parts):
        refuse("region_cuts", f"{d} tuples of numbers, one for each abstract dimension")
    walls = _numbers(getattr(env, "walls", ()))
    if walls is None or (walls.size and (walls.ndim != 2 or walls.shape[1] != 4)):
        refuse("walls", "rectangles [n, 4]")


def _check_functions(adapted: Adapted, env: Any, name: str) -> None:
    """Raise `EnvError` if `reset` and `step` do not give what they should."""
    key = modes.key(0)
    first = _called(env.reset, key, name=name, what="reset", run=jax.eval_shape)
    if not isinstance(first, State):
        raise EnvError(f"{name}: reset gives a {type(first).__name__}; allowed: a brax State")
    size = adapted.observation_size
    _check_array(first.obs, (size,), f"{name}: obs of reset", "the state, then the goal")
    for metric in ("distance", "success"):
        if metric not in first.metrics:
            raise EnvError(f"{name}: metrics of reset lack {metric}; allowed: distance and success, both scalars")
        _check_scalar(first.metrics[metric], f"{name}: metrics[{metric!r}] of reset")
    for part in ("reward", "done"):
        _check_scalar(getattr(first, part), f"{name}: {part} of reset")
    action = jnp.zeros(adapted.action_size)
    after = _called(env.step, first, action, name=name, what="step", run=jax.eval_shape)
    if not isinstance(after, State):
        raise EnvError(f"{name}: step gives a {type(after).__name__}; allowed: a brax State")
    wrong = difference(first, after, began="reset")
    if wrong is not None:
        raise EnvError(f"{name}: step {wrong}")

    def begin(key: jax.Array) -> tuple[State, State, State]:
        state = env.reset(key)
        drawn = jax.random.uniform(key, action.shape, minval=-1.0)
        return state, env.step(state, action), env.step(state, drawn)

    keys = jax.random.split(key, TRIED)
    begun, stepped, moved = _called(jax.vmap(begin), keys, name=name, what="reset or step", run=_run)
    zeros, drawn = "step with an action of zeros", f"all {TRIED} steps with random actions"
    for what, state, least in (("reset", begun, TRIED), (zeros, stepped, TRIED), (drawn, moved, 1)):
        for part, value in (("obs", state.obs), ("reward", state.reward), *state.metrics.items()):
            if np.isfinite(np.asarray(value, np.float32).reshape(TRIED, -1)).all(axis=1).sum() < least:
                raise EnvError(f"{name}: {part} of {what} is not finite")
    _check_goals(adapted, np.asarray(begun.obs), name)


def _check_goals(adapted: Adapted, obs: np.ndarray, name: str) -> None:
    """Raise `EnvError` if a goal lies outside of the space, where no region is."""
    for column, (index, low, high) in enumerate(zip(adapted.abstract_indices, *adapted.space, strict=True)):
        if index in adapted.goal_indices:
            goals = obs[:, adapted.state_dim + adapted.goal_indices.index(index)]
            outside = goals[(goals < low) | (goals > high)]
            if len(outside):
                raise EnvError(
                    f"{name}: a goal of reset has {outside[0]:.4g} in abstract dimension {column}; "
                    f"allowed: inside the space, from {low:g} to {high:g}"
                )


def _called(function: Callable[..., Any], *args: Any, name: str, what: str, run: Callable[..., Any]) -> Any:
    """`function` of `args` by `run`; an error of its author's in one line that says where."""
    try:
        return run(function, *args)
    except (Exception, SystemExit) as error:  # whatever its author has done
        raise EnvError(f"{name}: {what} raises {where_raised(error)}") from error


def _run(function: Callable[..., Any], *args: Any) -> Any:
    return jax.device_get(jax.jit(function)(*args))


def _check_array(value: Any, shape: tuple[int, ...], what: str, words: str) -> None:
    if getattr(value, "shape", None) != shape or value.dtype != jnp.float32:
        raise EnvError(f"{what} is {described(value)}; allowed: float32 {list(shape)}, {words}")


def _check_scalar(value: Any, what: str) -> None:
    if getattr(value, "shape", None) != () or not (
        jnp.issubdtype(value.dtype, jnp.floating) or value.dtype in (jnp.bool_, jnp.int32)
    ):
        raise EnvError(f"{what} is {described(value)}; allowed: one number")


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _are_indices(value: Any, lengths: Sequence[int], size: int) -> bool:
    if not isinstance(value, list | tuple | np.ndarray) or not all(map(_is_whole, value)):
        return False
    return len(value) in lengths and len(set(map(int, value))) == len(value) and all(0 <= i < size for i in value)


def _numbers(value: Any) -> np.ndarray | None:
    """`value` as an array of finite numbers, None if it is not that."""
    try:
        found = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(float(np.abs(found).sum())) else None
