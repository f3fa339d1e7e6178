"""Replay of env steps whose goals are where the agent came to later: what learners with `futures` have in common.

    ring of whole rollouts   the next env step of an environment lies `num_envs` items ahead
    goal of an env step      the place D env steps ahead in the same episode, D ~ Geometric(1 - gamma), cut off there

A learner stores each rollout, and then makes `updates_per_rollout` updates, each of them on a batch of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from star import devices
from star.learners import replay
from star.learners.networks import adam_step
from star.learners.replay import Imitation, Penalty, Relabel, Track, Transition, flatten

Metrics = dict[str, Array]


class Step(struct.PyTreeNode):
    """An env step in the buffer: observation, action, and the agent's track."""

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    weight: Float[Array, "*batch"]
    track: Track

    @classmethod
    def of(cls, transition: Transition, **more: Array) -> Self:
        """The part of a transition that is kept; `more` are the fields of a subclass."""
        return cls(transition.obs, transition.action, transition.weight, transition.extras, **more)


class ReplayState(struct.PyTreeNode):
    """Networks, temperature, their optimisers, and the replay buffer of one learner."""

    params: Mapping[str, Any]
    """`actor` and `critic`."""
    log_alpha: Float[Array, ""]
    optimizers: Mapping[str, optax.OptState]
    ring: replay.Ring
    updates: Int[Array, ""]

    @classmethod
    def create(cls, params: Mapping[str, Any], example: Step, *, size: int) -> Self:
        """Before anything is learnt; the buffer keeps `size` steps shaped like `example`."""
        log_alpha, adam = jnp.zeros(()), optax.scale_by_adam()
        return cls(
            params=params,
            log_alpha=log_alpha,
            optimizers={name: adam.init(one) for name, one in ({**params, "alpha": log_alpha}).items()},
            ring=replay.create(example, size=size),
            updates=jnp.zeros((), jnp.int32),
        )

    def stepped(self, gradients: Mapping[str, Any], *, rate: Array | float, ready: Array) -> Self:
        """After one Adam step of size `rate` on parts named `actor`, `critic` or `alpha`; nothing unless `ready`."""
        parts, optimizers = {**self.params, "alpha": self.log_alpha}, dict(self.optimizers)
        for name, gradient in gradients.items():
            parts[name], optimizers[name] = adam_step(parts[name], gradient, optimizers[name], rate, ready)
        log_alpha = parts.pop("alpha")
        return self.replace(params=parts, log_alpha=log_alpha, optimizers=optimizers)


class Future(NamedTuple):
    """Items of a ring that others follow: the first `number` of `going`. `left` has the steps that follow each item."""

    left: Int[Array, "size"]
    going: Int[Array, "size"]
    number: Int[Array, ""]
    num_envs: int

    @classmethod
    def of(cls, ring: replay.Ring, *, num_envs: int, least: int = 1) -> Self:
        """That of the rollouts of `num_envs` environments in `ring`; `least` steps have to follow."""
        left = steps_left(ring, num_envs=num_envs)
        going = jnp.flatnonzero(left >= least, size=len(left), fill_value=0)
        return cls(left, going, jnp.sum(left >= least), num_envs)

    def draw(self, key: Array, *, size: int) -> Int[Array, "size"]:
        """Items that others follow, drawn uniformly; any if there are none."""
        return self.going[jax.random.randint(key, (size,), 0, jnp.maximum(self.number, 1))]

    def later(
        self, x: Float[Array, "size ..."], item: Int[Array, "#*n"], steps: Int[Array, "#*n"]
    ) -> Float[Array, "..."]:
        """`x` of all items, so many env steps after each `item`; within `left` it is of the same episode."""
        return x[(item + steps * self.num_envs) % len(self.left)]


def steps_left(ring: replay.Ring, *, num_envs: int) -> Int[Array, "size"]:
    """The number of steps that follow each item of `ring`, in it and of the same episode.

    Items are those of rollouts of `num_envs` environments, so that the next step of an environment is `num_envs` ahead.
    """
    items, _ = replay.contents(ring)
    rows = replay.capacity(ring) // num_envs
    over, epoch, weight = (x.reshape(rows, num_envs) for x in (items.track.over, items.track.epoch, items.weight))
    number = jnp.arange(rows)[:, None]
    newest = (ring.current_index // num_envs - 1) % rows
    alive, later = weight > 0, partial(jnp.roll, shift=-1, axis=0)
    going = (over == 0) & alive & later(alive) & (epoch == later(epoch)) & (number != newest)
    by_age = jnp.roll(going, -(newest + 1), axis=0)
    end = jax.lax.cummin(jnp.where(by_age, rows, number), axis=0, reverse=True)
    return jnp.roll(end - number, newest + 1, axis=0).ravel()


def ahead(left: Int[Array, "*n"], uniform: Float[Array, "*n"], *, discount: Array | float) -> Int[Array, "*n"]:
    """Steps to the goal, at least 1: geometric with parameter 1 - `discount`, given that there are at most `left`.

    `uniform` is drawn from [0, 1). Where nothing is left it is 0.
    """
    tail = 1.0 - jnp.power(discount, left)
    steps = 1 + jnp.floor(jnp.log1p(-uniform * tail) / jnp.log(discount)).astype(left.dtype)
    return jnp.minimum(steps, left)


def updating(
    one_update: Callable[..., tuple[ReplayState, Metrics]],
    *,
    step: Callable[[Transition], Step] = Step.of,
    least: Callable[[Any], int] = lambda config: 1,
) -> Callable[..., tuple[ReplayState, Metrics]]:
    """The `update` of a `Learner`: it stores the steps of a rollout [T, B], and makes `updates_per_rollout` updates.

    Each is `one_update(config, imitation, future, state, key)`, on items that at least `least(config)` others follow.
    `step` is the part of a transition that is stored. Metrics are means over the updates.
    """

    def update(
        config: Any,
        state: ReplayState,
        rollout: Transition,
        *,
        relabel: Relabel | None = None,
        penalty: Penalty | None = None,
        imitation: Imitation | None = None,
        key: Array,
    ) -> tuple[ReplayState, Metrics]:
        """Goals of the future take the place of `relabel`, and only a Tutor has a `penalty`."""
        steps = devices.whole(step(rollout))
        ring = replay.add(state.ring, flatten(steps))
        future = Future.of(ring, num_envs=steps.weight.shape[1], least=least(config))
        one = partial(one_update, config, imitation, future)
        keys = jax.random.split(key, config.updates_per_rollout)
        state, metrics = jax.lax.scan(one, state.replace(ring=ring), keys)
        return state, jax.tree.map(jnp.mean, metrics)

    return update
