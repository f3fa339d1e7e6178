"""A world turns a sequence of primitives into outcomes: data and pure functions.

A primitive is a movement, p numbers in [-1, 1]. A sequence has 1 to L of them and always begins from the rest state.
Each task has an outcome space of at most four dimensions; an execution may have no outcome in it. Outcomes and goals
are [S, 4], the numbers after a task's own dimensions being 0.

All functions are pure, compiled once, and take any number of leading axes. Source: S. M. Nguyen's habilitation thesis,
chapter 2 (arXiv 2412.20573).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key

from envs.options import EnvError, known

WIDTH = 4
"""Numbers of an outcome, a goal or a subgoal."""

Simulate = Callable[[Array, Array], tuple["Outcomes", Any]]
Subgoal = tuple[int, Any]
"""A task's index and its goal."""


class Outcomes(struct.PyTreeNode):
    """The results of a sequence, in the outcome space of each of S tasks; 0 where there is none."""

    value: Float[Array, "*batch S 4"]
    reached: Bool[Array, "*batch S"]


class Trace(struct.PyTreeNode):
    """Outcomes, and how they came about: `path` is a pytree [*batch, steps, ...] of the world's own, for pictures."""

    outcomes: Outcomes
    path: Any


class Decomposition(struct.PyTreeNode):
    """A goal as two goals to be reached one after the other; all 0 where the task has none (`exists`)."""

    tasks: Int[Array, "*batch 2"]
    goals: Float[Array, "*batch 2 4"]
    exists: Bool[Array, "*batch"]


@dataclasses.dataclass(frozen=True)
class Task:
    """An outcome space, and what can be shown of it. Goals that its functions are given are [4].

    `lower` and `upper` [d], d at most 4, are the bounds of outcomes and goals. `goals` makes the goals of the
    evaluation [n, d], the same at every call. `demonstrate(goal)` is a sequence [n, p], n at most L, that reaches the
    goal: an action teacher. `decompose(goal)` is two subgoals (task, goal [d]): a procedural teacher.
    """

    name: str
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    goals: Callable[[], np.ndarray]
    demonstrate: Callable[[Array], Array] | None = None
    decompose: Callable[[Array], tuple[Subgoal, Subgoal]] | None = None


@dataclasses.dataclass(frozen=True)
class World:
    """A world of S tasks, whose sequences have up to L = `longest` primitives of p = `primitive` numbers.

    `simulate(sequence [L, p], length [])` is one execution, `(Outcomes, path)`; a path has the same number of control
    steps for each primitive. `sketch(figure, path, step, task, goal)` draws on a Matplotlib figure what is there after
    a control step, and the goal of a task unless both are None (`envs.worlds.draw`). `noise` is the standard deviation
    of what is added to all numbers of every primitive that is executed.
    """

    name: str
    primitive: int
    longest: int
    tasks: tuple[Task, ...]
    simulate: Simulate
    sketch: Callable[..., None] | None = None
    noise: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tasks [S]."""
        return tuple(task.name for task in self.tasks)

    @property
    def dims(self) -> tuple[int, ...]:
        """Dimensions of each outcome space [S]."""
        return tuple(len(task.lower) for task in self.tasks)

    @property
    def lower(self) -> Float[np.ndarray, "S 4"]:
        """Lower bounds of outcomes and goals; 0 after a task's own dimensions."""
        return np.concatenate([_widened([task.lower]) for task in self.tasks])

    @property
    def upper(self) -> Float[np.ndarray, "S 4"]:
        """Upper bounds of outcomes and goals; 0 after a task's own dimensions."""
        return np.concatenate([_widened([task.upper]) for task in self.tasks])

    def index(self, task: int | str) -> int:
        """The number of a task, given by its name or itself.

        Raises:
          EnvError: in one line, if there is no such task.
        """
        if isinstance(task, str) and task in self.names:
            return self.names.index(task)
        if isinstance(task, int | np.integer) and 0 <= task < len(self.tasks):
            return int(task)
        raise EnvError(f'task "{task}" is not one of {self.name}; {known(str(task), self.names)}')

    def execute(self, sequence: Array, length: Array | int, *, key: Key[Array, ""] | None = None) -> Outcomes:
        """The outcomes of `sequence` [*batch, L, p], whose first `length` [*batch] primitives are executed.

        Numbers are clipped to [-1, 1], lengths to 1 to L. `key`, one for the whole batch, is needed only if
        there is noise.

        Raises:
          EnvError: in one line, if a shape is wrong or the key is missing.
        """
        return _execute(self, *self._checked(sequence, length, key))

    def trace(self, sequence: Array, length: Array | int, *, key: Key[Array, ""] | None = None) -> Trace:
        """As `execute`, and the path at every control step. After the last primitive the path stays where it is."""
        return _trace(self, *self._checked(sequence, length, key))

    def benchmark(self, task: int | str) -> Float[np.ndarray, "n 4"]:
        """The goals of the evaluation of a task, never to be practised; the same every time."""
        return _widened(self.tasks[self.index(task)].goals())

    def demonstrate(self, task: int | str, goal: Array) -> tuple[Float[Array, "*batch L p"], Int[Array, "*batch"]]:
        """A sequence, and its length, that reaches `goal` [*batch, 4] of a task.

        Raises:
          EnvError: in one line, if nobody can show the task, or a shape is wrong.
        """
        index = self.index(task)
        if self.tasks[index].demonstrate is None:
            able = [one.name for one in self.tasks if one.demonstrate is not None]
            raise EnvError(f"nobody demonstrates {self.tasks[index].name} in {self.name}; allowed: {', '.join(able)}")
        return _demonstrate(self, index, self._checked_goal(goal))

    def decompose(self, task: int | str, goal: Array) -> Decomposition:
        """The two goals that make up `goal` [*batch, 4] of a task, in the order in which they are to be reached.

        Raises:
          EnvError: in one line, if there is no such task, or a shape is wrong.
        """
        return _decompose(self, self.index(task), self._checked_goal(goal))

    def _checked(self, sequence: Array, length: Array | int, key: Any) -> tuple[Array, Array, Any]:
        sequence, length = jnp.asarray(sequence, jnp.float32), jnp.asarray(length)
        sizes = (self.longest, self.primitive)
        if sequence.shape[-2:] != sizes:
            raise EnvError(f"a sequence has the shape {_listed(sequence.shape)}; allowed: {_listed(('...', *sizes))}")
        batch = sequence.shape[:-2]
        if length.shape not in ((), batch) or not jnp.issubdtype(length.dtype, jnp.integer):
            raise EnvError(
                f"length has the shape {_listed(length.shape)} of {length.dtype}; allowed: {_listed(batch)} of int32"
            )
        if self.noise and key is None:
            raise EnvError(f"{self.name} has noise {self.noise:g}, which needs a key; allowed: key=jax.random.key(0)")
        return sequence, jnp.broadcast_to(length, batch), key if self.noise else None

    def _checked_goal(self, goal: Array) -> Array:
        goal = jnp.asarray(goal, jnp.float32)
        if goal.shape[-1:] != (WIDTH,):
            raise EnvError(f"a goal has the shape {_listed(goal.shape)}; allowed: {_listed(('...', WIDTH))}")
        return goal


@partial(jax.jit, static_argnums=0)
def _trace(world: World, sequence: Array, length: Array, key: Array | None) -> Trace:
    if key is not None:
        sequence = sequence + world.noise * jax.random.normal(key, sequence.shape)
    run = over_leading_axes(world.simulate, length.ndim)
    return Trace(*run(jnp.clip(sequence, -1.0, 1.0), jnp.clip(length, 1, world.longest)))


@partial(jax.jit, static_argnums=0)
def _execute(world: World, sequence: Array, length: Array, key: Array | None) -> Outcomes:
    return _trace(world, sequence, length, key).outcomes


@partial(jax.jit, static_argnums=(0, 1))
def _demonstrate(world: World, task: int, goal: Array) -> tuple[Array, Array]:
    show = world.tasks[task].demonstrate
    assert show is not None
    shown = over_leading_axes(show, goal.ndim - 1)(goal)
    length = shown.shape[-2]
    rest = [(0, 0)] * (shown.ndim - 2) + [(0, world.longest - length), (0, 0)]
    return jnp.pad(shown, rest), jnp.full(goal.shape[:-1], length, jnp.int32)


@partial(jax.jit, static_argnums=(0, 1))
def _decompose(world: World, task: int, goal: Array) -> Decomposition:
    split = world.tasks[task].decompose

    def one(goal: Array) -> Decomposition:
        if split is None:
            return Decomposition(jnp.zeros(2, jnp.int32), jnp.zeros((2, WIDTH)), jnp.zeros((), bool))
        first, second = split(goal)
        goals = jnp.stack([_padded(first[1]), _padded(second[1])])
        return Decomposition(jnp.array([first[0], second[0]], jnp.int32), goals, jnp.ones((), bool))

    return over_leading_axes(one, goal.ndim - 1)(goal)


def sole(reached: Array, world: World) -> None:
    """Raise `EnvError` in one line, unless what was reached is that of one execution, [S]."""
    if reached.shape != (len(world.tasks),):
        raise EnvError(f"a trace of {_listed(reached.shape[:-1])} executions; allowed: one, as jax.tree.map gives it")


def over_leading_axes(function: Callable[..., Any], axes: int) -> Callable[..., Any]:
    """`function`, mapped over so many leading axes of all its arguments."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function


def outcomes(*found: tuple[Any, Any]) -> Outcomes:
    """The outcomes of one execution, from (value [d], reached []) of each task."""
    reached = jnp.stack([jnp.asarray(there, bool) for _, there in found])
    value = jnp.stack([_padded(value) for value, _ in found])
    return Outcomes(jnp.where(reached[:, None], value, 0.0), reached)


def _padded(values: Any) -> Float[Array, "4"]:
    """`values` [d] and then 0."""
    values = jnp.asarray(values, jnp.float32)
    return jnp.pad(values, (0, WIDTH - values.shape[-1]))


def _widened(points: Any) -> Float[np.ndarray, "n 4"]:
    """`points` [n, d], each and then 0, on the host: nothing is compiled for them."""
    points = np.asarray(points, np.float32)
    return np.pad(points, ((0, 0), (0, WIDTH - points.shape[1])))


def _listed(shape: Any) -> str:
    return f"[{', '.join(map(str, shape))}]"
