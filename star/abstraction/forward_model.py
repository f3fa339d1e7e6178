"""F_k: where k env steps lead from an abstract state when a box is commanded.

    F_k(s, [lower, upper]) = s + f(...)   (`residual`)   or   f(...),      f a ReLU network trained by MSE

It is trained on commanded boxes, reached or not, so that it also predicts failures. Its error on new transitions is
measured before they enter the buffer, so the error kept per pair of regions is always a held-out one.

Source: STAR (ICLR 2024), section 4.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from star.abstraction import regions
from star.abstraction.reachability import ROUNDING, Network
from star.abstraction.regions import Abstraction
from star.abstraction.sections import ForwardModelConfig
from star.learners import replay
from star.learners.networks import MLP, apply, descend

Metrics = dict[str, Array]


class Outcome(struct.PyTreeNode):
    """Periods of k env steps: where they began, which box was commanded, where they ended. `weight` masks."""

    start: Float[Array, "*N d"]
    lower: Float[Array, "*N d"]
    upper: Float[Array, "*N d"]
    end: Float[Array, "*N d"]
    weight: Float[Array, "*N"]


class ForwardModelState(struct.PyTreeNode):
    """Network, optimiser and buffer. `space` [2, d] scales inputs and outputs."""

    params: Mapping[str, Any]
    optimizer: optax.OptState
    ring: replay.Ring
    space: Float[Array, "2 d"]


def _mlp(config: ForwardModelConfig, d: int) -> MLP:
    return MLP(config.hidden, d)


def init(key: Array, config: ForwardModelConfig, *, space: Float[Array, "2 d"]) -> ForwardModelState:
    """An untrained model for the abstract space with corners `space`."""
    d = space.shape[1]
    point = jnp.zeros(d)
    params = _mlp(config, d).init(key, jnp.zeros(3 * d))
    example = Outcome(start=point, lower=point, upper=point, end=point, weight=jnp.zeros(()))
    return ForwardModelState(
        params=params,
        optimizer=optax.scale_by_adam().init(params),
        ring=replay.create(example, size=config.buffer_size),
        space=space,
    )


def predict(
    config: ForwardModelConfig,
    state: ForwardModelState,
    start: Float[Array, "*N d"],
    lower: Float[Array, "*N d"],
    upper: Float[Array, "*N d"],
) -> Float[Array, "*N d"]:
    """Expected abstract state k steps after commanding the box [lower, upper] in `start`."""
    return _predict(config, state.params, state.space, start, lower, upper)


def network(
    config: ForwardModelConfig, state: ForwardModelState, lower: Float[Array, "d"], upper: Float[Array, "d"]
) -> Network:
    """The model for one commanded box as a plain ReLU network of the start state, in the units of the state.

    Scaling and command are folded into its first and last layer; `doubt` bounds what that rounds.
    """
    middle, half = _scaling(state.space)
    dense = state.params["params"]
    layers = [(dense[f"Dense_{i}"]["kernel"].T, dense[f"Dense_{i}"]["bias"]) for i in range(len(dense))]
    d = middle.shape[0]
    command = jnp.concatenate([(lower - middle) / half, (upper - middle) / half])
    product = partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    first, bias = layers[0]
    layers[0] = (first[:, :d] / half, bias + product(first[:, d:], command) - product(first[:, :d], middle / half))
    last, last_bias = layers[-1]
    layers[-1] = (last * half[:, None], last_bias * half + (0.0 if config.residual else middle))
    shift = jnp.abs(middle) / half
    terms = jnp.abs(bias) + product(jnp.abs(first), jnp.concatenate([shift, jnp.abs(command) + jnp.tile(shift, 2)]))
    doubt = [jnp.zeros_like(b) for _, b in layers]
    doubt[0] += (2 * d + 4) * ROUNDING * terms
    doubt[-1] = half * doubt[-1] + 4 * ROUNDING * (jnp.abs(last_bias) * half + jnp.abs(middle))
    return Network(layers=tuple(layers), residual=config.residual, doubt=tuple(doubt))


def errors(config: ForwardModelConfig, state: ForwardModelState, batch: Outcome) -> Float[Array, "*N"]:
    """Squared prediction errors in units of the state, summed over dimensions."""
    predicted = predict(config, state, batch.start, batch.lower, batch.upper)
    return jnp.square(predicted - batch.end).sum(axis=-1)


def train(
    config: ForwardModelConfig, state: ForwardModelState, fresh: Outcome, *, key: Array
) -> tuple[ForwardModelState, Metrics]:
    """Store the outcomes `fresh` [N] and make `updates_per_epoch` updates on batches of the buffer."""
    state = state.replace(ring=replay.add(state.ring, fresh))

    def loss(params: Any, step_key: Array) -> Array:
        return _loss(config, params, state.space, replay.sample(state.ring, step_key, batch_size=config.batch_size))

    rate, updates = config.learning_rate, config.updates_per_epoch
    params, optimizer, mean_loss = descend(
        loss, state.params, state.optimizer, learning_rate=rate, updates=updates, key=key
    )
    return state.replace(params=params, optimizer=optimizer), {"loss": mean_loss}


def remembered(state: ForwardModelState) -> Outcome:
    """The periods [N] in the buffer; those that are not real weigh nothing."""
    items, written = replay.contents(state.ring)
    return items.replace(weight=items.weight * written)


def traffic(state: ForwardModelState, abstraction: Abstraction) -> Float[Array, "R R"]:
    """Number of periods in the buffer that began in each region (row) and ended in each (column)."""
    periods = remembered(state)
    began, ended = (regions.locate(abstraction, point) for point in (periods.start, periods.end))
    none = jnp.zeros((abstraction.capacity, abstraction.capacity))
    return none.at[began, ended].add(periods.weight)


def _scaling(space: Float[Array, "2 d"]) -> tuple[Array, Array]:
    return (space[0] + space[1]) / 2, (space[1] - space[0]) / 2


def _predict(config: ForwardModelConfig, params: Any, space: Array, start: Array, lower: Array, upper: Array) -> Array:
    middle, half = _scaling(space)
    x = jnp.concatenate([(start - middle) / half, (lower - middle) / half, (upper - middle) / half], axis=-1)
    out = half * apply(_mlp(config, middle.shape[0]), params, x)
    return start + out if config.residual else middle + out


def _loss(config: ForwardModelConfig, params: Any, space: Array, batch: Outcome) -> Array:
    predicted = _predict(config, params, space, batch.start, batch.lower, batch.upper)
    scaled = (predicted - batch.end) / _scaling(space)[1]
    return replay.weighted_mean(jnp.square(scaled).mean(axis=-1), batch.weight)
