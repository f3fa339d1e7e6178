"""Batches of environments that stay one physics batch.

    reset        keys -> states                 a plain vmap: it needs no physics
    step         vmap(env.step), then the finished environments are really reset
    reset_where  states of fresh episodes where the mask says so

A physics engine wants one flat batch: nested vmaps break MJX-Warp and multiply host callbacks. So `step` and
`reset_where` are flattened: an outer vmap over S turns [S, B, ...] into [S * B, ...], steps once, and turns the
result back. On a mesh of devices each does so with its share of the B.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from envs._quiet import Env, State
from envs.common.batching import flattened, shared_out, where
from envs.common.errors import UserError


class VectorEnv:
    """`num_envs` (B) environments, stepped together. All leaves of a `State` have the leading axis [B].

    `info["final_obs"]` [B, obs] is the observation after the step and before any reset. With `auto_reset`, an
    environment that finishes starts a new episode (new goal, new start) within the same step: `obs`, `info["steps"]`
    and the simulation are those of the new episode, while `reward`, `done`, `metrics` and `info["truncation"]` are
    those of the step that finished. Without it `step` never resets.
    """

    def __init__(self, env: Env, num_envs: int, *, auto_reset: bool = True):
        if num_envs < 1:
            raise UserError(f"num_envs is {num_envs}; allowed: a whole number above 0")
        self.env = env
        self.num_envs = num_envs
        self.auto_reset = auto_reset
        self._step = shared_out(flattened(self._step_batch))
        self._reset_where = shared_out(flattened(self._reset_batch))

    def __reduce__(self) -> Any:
        return partial(type(self), auto_reset=self.auto_reset), (self.env, self.num_envs)

    def reset(self, rng: jax.Array) -> State:
        """New episodes [B] from one key, or from a key [B] for each; typed or raw.

        Raises:
          UserError: in one line, for another number of keys.
        """
        return self._begin(self._keys(rng))

    def step(self, state: State, action: jax.Array) -> State:
        """One env step of every environment; `action` [B, action_size].

        Raises:
          UserError: in one line, for an action of another shape.
        """
        expected = (self.num_envs, self.env.action_size)
        if jnp.shape(action) != expected:
            raise UserError(f"the shape of the actions is {jnp.shape(action)}; allowed: {expected}")
        return self._step(state, action)

    def reset_where(self, state: State, mask: jax.Array, rng: jax.Array) -> State:
        """New episodes where `mask` (bool [B]) is set; every other environment stays as it is, to the bit.

        `rng` is as for `reset`.
        """
        return self._reset_where(state, mask, self._keys(rng))

    def with_goals(self, state: State, goals: jax.Array, mask: jax.Array) -> State:
        """`state` with the desired goals [B, k] where `mask` (bool [B]) is set, at the start of episodes."""
        return where(mask, jax.vmap(self.env.with_goal)(state, goals), state)

    def _keys(self, rng: jax.Array) -> jax.Array:
        """A key [B] for each environment: those given, or as many split from one."""
        shape = jnp.shape(rng) if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jnp.shape(rng)[:-1]
        if shape == ():
            return jax.random.split(rng, self.num_envs)
        if shape != (self.num_envs,):
            raise UserError(f"the shape of the keys is {shape}; allowed: one key, or ({self.num_envs},)")
        return rng

    def _begin(self, rng: jax.Array) -> State:
        """New episodes, one for each key of `rng` [n]. Each keeps a key of its own for the resets to come."""
        rng, own = jnp.moveaxis(jax.vmap(jax.random.split)(rng), 1, 0)
        state = jax.vmap(self.env.reset)(rng)
        return state.replace(info={**state.info, "final_obs": state.obs, "rng": own})

    def _step_batch(self, state: State, action: jax.Array) -> State:
        state = jax.vmap(self.env.step)(state, action)
        state = state.replace(info={**state.info, "final_obs": state.obs})
        if not self.auto_reset:
            return state
        return self._restart_done(state)

    def _restart_done(self, state: State) -> State:
        """New episodes where one has finished, with what is told of the finished step kept."""
        rng = state.info["rng"]
        # nothing in the `cond` depends on the action: JAX cannot differentiate it backward in a vmap
        fresh = jax.lax.cond(
            (state.done > 0).any(), self._begin, partial(_blank, jax.eval_shape(self._begin, rng)), rng
        )
        kept = {key: state.info[key] for key in ("truncation", "final_obs")}
        fresh = fresh.replace(reward=state.reward, done=state.done, metrics=state.metrics, info={**fresh.info, **kept})
        return where(state.done > 0, fresh, state)

    def _reset_batch(self, state: State, mask: jax.Array, rng: jax.Array) -> State:
        return where(mask, self._begin(rng), state)


def _blank(shapes: State, rng: jax.Array) -> State:
    """A state of these shapes without any episode in it; its keys are `rng`."""
    others = {key: leaf for key, leaf in shapes.info.items() if key != "rng"}
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes.replace(info=others))
    return blank.replace(info={**blank.info, "rng": rng})
