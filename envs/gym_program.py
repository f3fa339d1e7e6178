"""The engine of the Gymnasium environments: a batch as two compiled functions, and what of it is on the host.

After each call one array goes to the host, a record [B, n + 3]: observation [n], then done, truncation and fault as 0
or 1.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box, Dict

import envs
from envs.arena import Arena
from envs.common import modes
from envs.maze import MazeEnv
from envs.options import normal

Observation = dict[str, np.ndarray]

LARGEST = np.finfo(np.float32).max  # observations are finite, and nothing more is known of them
PROGRAMS = 16  # that are kept compiled
_begun: list[int] = []  # the process that has compiled, and with it those forked from it


class Program(NamedTuple):
    """The compiled functions of a batch of B environments. Both return the new state and a record of it.

    `step` takes a state and actions [B, action_size]; `begin` a state, a mask (bool [B]) of the environments that
    begin an episode, and 64 random bits for all (uint32 [1, 2]) or for each (uint32 [B, 2]). `blank` is a state to
    begin from.
    """

    env: MazeEnv
    blank: Any
    begin: Callable[[Any, np.ndarray, np.ndarray], tuple[Any, Any]]
    step: Callable[[Any, np.ndarray], tuple[Any, Any]]


class Record(NamedTuple):
    """A record on the host: observations [B, n] and three flags (bool [B])."""

    obs: np.ndarray
    done: np.ndarray
    truncated: np.ndarray
    fault: np.ndarray


def _check_process() -> None:
    """Raise `EnvError` in a process that was forked from one in which JAX had begun: it would wait for ever."""
    if not _begun:
        _begun.append(os.getpid())
    if _begun[0] != os.getpid():
        raise envs.EnvError(
            'this process was forked from one that runs JAX, and would hang; start it by "spawn" or "forkserver", as '
            'AsyncVectorEnv does with context="forkserver", or make the batch with gymnasium.make_vec'
        )


def program(task: str, options: dict[str, Any], num_envs: int) -> Program:
    """The program of a batch, compiled at most once; raises `EnvError` if the options are wrong."""
    _check_process()
    options = normal(options)
    arena = envs.make(task, **options).arena  # the file of a map may have changed
    return _compiled(task, arena, num_envs, **dict(sorted(options.items())))


@lru_cache(maxsize=PROGRAMS)
def _compiled(task: str, arena: Arena, num_envs: int, **options: Any) -> Program:
    env = envs.make(task, **options)
    vector = envs.VectorEnv(env, num_envs, auto_reset=False)

    def begin(state: Any, mask: jax.Array, bits: jax.Array) -> tuple[Any, jax.Array]:
        return recorded(vector.reset_where(state, mask, keys(bits)))

    def step(state: Any, action: jax.Array) -> tuple[Any, jax.Array]:
        return recorded(vector.step(state, action))

    def keys(bits: jax.Array) -> jax.Array:
        key = jax.random.wrap_key_data(bits, impl=modes.KEYS)
        return jax.vmap(lambda one: jax.random.split(one, num_envs // len(bits)))(key).reshape(num_envs)

    def recorded(state: Any) -> tuple[Any, jax.Array]:
        fault = jnp.maximum(state.metrics["non_finite"], state.metrics["overflow"])
        flags = jnp.stack([state.done, state.info["truncation"], fault], axis=-1)
        return state, jnp.concatenate([state.obs, flags], axis=-1)

    shapes = jax.eval_shape(lambda bits: vector.reset(keys(bits)), jax.ShapeDtypeStruct((1, 2), jnp.uint32))
    blank = jax.jit(lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))
    return Program(env=env, blank=blank(), begin=jax.jit(begin), step=jax.jit(step))


def spaces(env: MazeEnv) -> tuple[gymnasium.Space[Any], Box]:
    """The spaces of one environment's observations and actions."""
    goal = len(env.goal_indices)
    sizes = {"observation": env.state_dim, "achieved_goal": goal, "desired_goal": goal}
    observations = Dict({name: Box(-LARGEST, LARGEST, (size,), np.float32) for name, size in sizes.items()})
    return observations, Box(-1.0, 1.0, (env.action_size,), np.float32)


def goals(env: MazeEnv, obs: np.ndarray) -> Observation:
    """Gymnasium's dictionary of observations [..., n], in arrays of their own."""
    return {
        "observation": obs[..., : env.state_dim].copy(),
        "achieved_goal": obs[..., list(env.goal_indices)],
        "desired_goal": obs[..., env.state_dim :].copy(),
    }


def compute_reward(env: MazeEnv, achieved: np.ndarray, desired: np.ndarray) -> Any:
    """The reward [...] for goals [..., k]. One pair of goals is rewarded as a batch of one: NumPy rounds alike."""
    achieved, desired = np.asarray(achieved), np.asarray(desired)
    pairs = (goal.reshape(-1, len(env.goal_indices)) for goal in (achieved, desired))
    return env.reward(*pairs).reshape(achieved.shape[:-1])[()]


def raw(leaf: jax.Array) -> jax.Array:
    """The integers of a key; anything else as it is."""
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


def like(leaf: jax.Array, array: np.ndarray) -> jax.Array:
    """`array` on a device, as a key where `leaf` is one."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    return jnp.asarray(array)


def read(env: MazeEnv, array: jax.Array) -> Record:
    """The record in an array [B, n + 3]."""
    host = np.asarray(array)
    done, truncated, fault = host[:, env.observation_size :].T > 0
    return Record(host[:, : env.observation_size], done, truncated, fault)
