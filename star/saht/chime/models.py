"""Small networks that predict how one observable changes in one action.

    dy = A(h) u,   h = tanh(W [u, contexts] + b),   A: 16 numbers -> a matrix of 2 x 2

u is the change of the model's control: the action, or the change of an observable that another model predicts, which
makes models nested. Contexts are the inputs that were chosen for it. All others are masked, so shapes never change.

Source: CHIME (Manoury, Nguyen, Buche, arXiv 2009.10968) has models with evolving inputs. It is ours that
the effect is linear in the change of the control, given the hidden units: without u nothing happens.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

HIDDEN = 16
ACTION = -1
"""The control that is no observable."""
OPTIMISER = optax.adam(0.02)
_SIZES = {"control": (2, HIDDEN), "context": (HIDDEN,), "bias": (HIDDEN,), "out": (HIDDEN, 4), "last": (4,)}
_SPREAD = {"control": 2.0, "context": 2.0, "bias": 1.0, "out": 0.2, "last": 0.0}
"""New weights are even within these of 0."""


class Weights(struct.PyTreeNode):
    """Of one network."""

    control: Float[Array, "*K 2 H"]
    context: Float[Array, "*K I H"]
    """Both numbers of each possible input in turn, I = 2 O."""
    bias: Float[Array, "*K H"]
    out: Float[Array, "*K H 4"]
    last: Float[Array, "*K 4"]


class Rows(NamedTuple):
    """Examples for models to learn from."""

    seen: Float[Array, "*n O 2"]
    """All possible inputs, before the action."""
    action: Float[Array, "*n 2"]
    change: Float[Array, "*n B 2"]
    """Of each observable, in its unit."""


class Model(NamedTuple):
    """A network and what it is of. Any number of leading axes."""

    outcome: Int[Array, "*K"]
    """The observable that it predicts."""
    control: Int[Array, "*K"]
    """An observable, or `ACTION`."""
    context: Bool[Array, "*K O"]
    weights: Weights


def init(inputs: int, count: int, *, key: Array) -> Weights:
    """New weights of so many networks with so many possible inputs."""
    sizes = _SIZES | {"context": (2 * inputs, HIDDEN)}
    ends = np.cumsum([np.prod(size) for size in sizes.values()])
    parts = jnp.split(jax.random.uniform(key, (count, ends[-1]), minval=-1.0, maxval=1.0), ends[:-1], axis=1)
    named = zip(sizes.items(), parts, strict=True)
    return Weights(**{name: _SPREAD[name] * part.reshape(count, *size) for (name, size), part in named})


def effect(weights: Weights, hidden: Float[Array, "*n H"], control: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
    """The predicted change, from the control and what contexts and bias bring to the hidden units."""
    matrix = jnp.tanh(hidden + control @ weights.control) @ weights.out + weights.last
    return (matrix.reshape(*matrix.shape[:-1], 2, 2) * control[..., None, :]).sum(axis=-1)


def predict(model: Model, rows: Rows) -> Float[Array, "*n 2"]:
    """The change of the outcome, in its unit, where the change of the control is known."""
    seen = (rows.seen * model.context[:, None]).reshape(*rows.action.shape[:-1], -1)
    controls = jnp.concatenate([rows.change, rows.action[..., None, :]], axis=-2)  # ACTION is the last
    return effect(model.weights, seen @ model.weights.context + model.weights.bias, controls[..., model.control, :])


def error(predicted: Float[Array, "n 2"], change: Float[Array, "n 2"]) -> Float[Array, ""]:
    """The length of all errors over that of all changes: 0 is perfect, 1 is as good as predicting no change."""
    off, moved = (jnp.sqrt(jnp.square(x).sum(axis=-1)).sum() for x in (predicted - change, change))
    return jnp.where(moved > 0, off / jnp.where(moved > 0, moved, 1.0), 1.0)


def train(model: Model, moments: Any, memory: Rows, rows: Int[Array, "steps batch"]) -> tuple[Weights, Any]:
    """Weights and moments after one step of Adam on each batch of rows."""

    def loss(weights: Weights, batch: Rows) -> Array:
        off = predict(model._replace(weights=weights), batch) - batch.change[:, model.outcome]
        return jnp.sqrt(jnp.square(off).sum(axis=-1) + 1e-4).mean()

    def step(known: tuple[Weights, Any], index: Array) -> tuple[tuple[Weights, Any], None]:
        weights, moments = known
        gradient = jax.grad(loss)(weights, jax.tree.map(lambda x: x[index], memory))
        updates, moments = OPTIMISER.update(gradient, moments)
        return (optax.apply_updates(weights, updates), moments), None

    return jax.lax.scan(step, (model.weights, moments), rows)[0]
