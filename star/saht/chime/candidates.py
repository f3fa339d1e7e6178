"""Models in slots, and candidates for them: new ones, and copies with other inputs."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds.room import Room
from star.saht.chime import memory as memories
from star.saht.chime import models
from star.saht.chime.memory import Memory
from star.saht.chime.models import ACTION, OPTIMISER, Model, Weights
from star.saht.chime.sections import ChimeConfig
from star.saht.choose import drawn

NOBODY = -1
COPIES = 0.5
"""This share of candidates are copies of a model with other inputs; the rest are new."""
INPUTS = (0.3, 0.5, 0.2)
"""New models have none, one or two contexts with these chances."""
TRANSFER = 0.5
"""This share of new models whose control is an observable begin as another such model, with the roles exchanged."""
CURIOUS = 0.05
"""The chance of an input that tells nothing, in units of that of the one that tells most."""
DICE = 10
ALWAYS = 0.9


class Population(struct.PyTreeNode):
    """K models: the first M are slots, the others candidates for them."""

    models: Model
    moments: Any
    """Of Adam."""
    active: Bool[Array, "K"]
    """True for those that exist."""
    enabled: Bool[Array, "K"]
    """True for those in use: slots alone."""
    competence: Float[Array, "K"]
    """1 less the error on what was held out, at least 0."""
    born: Int[Array, "K"]
    """The action at which a model got its slot; `NOBODY` without one."""
    age: Int[Array, "K"]
    """Evolutions of a candidate."""
    idle: Int[Array, "K"]
    """Evolutions in which a slot was of no use, less those in which it was."""
    parent: Int[Array, "K"]
    """The slot that a candidate is a copy of, or `NOBODY`."""


def empty(config: ChimeConfig, inputs: int, *, key: Array) -> Population:
    """No models at all."""
    size = config.models + config.candidates
    weights = models.init(inputs, size, key=key)
    zero, no = jnp.zeros(size, jnp.int32), jnp.zeros(size, bool)
    return Population(
        models=Model(zero, zero + ACTION, jnp.zeros((size, inputs), bool), weights),
        moments=jax.vmap(OPTIMISER.init)(weights),
        active=no,
        enabled=no,
        competence=jnp.zeros(size),
        born=zero + NOBODY,
        age=zero,
        idle=zero,
        parent=zero + NOBODY,
    )


def controllable(config: ChimeConfig, population: Population) -> Bool[Array, "B"]:
    """The observables of which there is a competent model; B is at most the number of possible inputs."""
    slots = config.models
    good = (population.enabled & (population.competence >= config.controllable))[:slots]
    return jnp.zeros(_observables(population), bool).at[population.models.outcome[:slots]].max(good)


def leads(config: ChimeConfig, population: Population) -> Bool[Array, "B B"]:
    """[i, j]: whether i controls j in some slot, or controls what does, and so on."""
    slots, size = config.models, _observables(population)
    control, outcome = population.models.control[:slots], population.models.outcome[:slots]
    edge = jnp.zeros((size + 1, size), bool).at[control, outcome].max(population.active[:slots])[:-1]
    for _ in range(4):
        edge |= (edge.astype(jnp.float32) @ edge.astype(jnp.float32)) > 0
    return edge


def _observables(population: Population) -> int:
    """As many as there are inputs: the first of these are the observables."""
    return population.models.context.shape[-1]


def possible(
    config: ChimeConfig, population: Population, memory: Memory, among: Bool[Array, "N"]
) -> Bool[Array, "B B+1"]:
    """Outcomes and controls of which a new model may be tried; the last control is the action.

    They have moved together often enough, the control has moved at least as often as the outcome, it is controllable,
    no slot has both, and no circle of controls would come of it. The action is not tried where something controllable
    has moved with the outcome nearly always.
    """
    slots, counted = config.models, memories.counts(memory, among)
    size = len(counted)
    model = population.models
    taken = (
        jnp.zeros(counted.shape, bool).at[model.outcome[:slots], model.control[:slots]].max(population.active[:slots])
    )
    own = jnp.diagonal(counted)
    often = jnp.append(own, jnp.sum(among)) >= own[:, None]
    circle = jnp.pad(leads(config, population)[:size, :size] | jnp.eye(size, dtype=bool), ((0, 0), (0, 1)))
    able = controllable(config, population)[:size]
    nested = (circle[:, :-1] | ~able | (counted[:, :-1] < ALWAYS * own[:, None])).all(axis=1)
    able = jnp.concatenate([jnp.broadcast_to(able, (size, size)), nested[:, None]], axis=1)
    return (counted >= config.few) & often & able & ~taken & ~circle


def telling(memory: Memory, among: Bool[Array, "N"], outcome: Array, control: Array) -> Float[Array, "E O"]:
    """The use of each possible input for each pair [E]: it tells apart if the outcome moves or the control alone.

    The squared distance of the means of an input, or of its square, in units of its variance; 1 for the largest.
    """
    there = among & memory.moved.T[control]  # [E, N]
    moved = there & memory.moved.T[outcome]
    seen = memory.rows.seen.reshape(len(among), -1)
    features = jnp.concatenate([seen, seen**2], axis=1)

    def mean(weight: Array) -> Array:
        return weight.astype(jnp.float32) @ features / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1)

    spread = there.astype(jnp.float32) @ features**2 / jnp.maximum(there.sum(axis=-1, keepdims=True), 1)
    spread -= mean(there) ** 2
    apart = jnp.square(mean(moved) - mean(there & ~moved)) / jnp.maximum(spread, 1e-4)
    apart = apart.reshape(len(outcome), 2, -1, 2).max(axis=(1, 3))
    return apart / jnp.maximum(apart.max(axis=-1, keepdims=True), 1e-6)


def renew(
    config: ChimeConfig, room: Room, population: Population, memory: Memory, among: Bool[Array, "N"], *, key: Array
) -> Population:
    """The population with a new candidate in each place that is free."""
    slots, inputs = config.models, population.models.context.shape[-1]
    weight_key, dice_key = jax.random.split(key)
    dice = jax.random.uniform(dice_key, (DICE, config.candidates))
    pairs = possible(config, population, memory, among)
    active = population.active[:slots]
    width = pairs.shape[1]
    pair = jax.vmap(lambda die: drawn(1.0 * pairs.ravel(), die))(dice[0])
    slot = jax.vmap(lambda die: drawn(1.0 * active, die))(dice[1])
    copy = active.any() & (~pairs.any() | (dice[2] < COPIES))
    old = jax.tree.map(lambda leaf: leaf[slot], population.models)
    outcome = jnp.where(copy, old.outcome, pair // width)
    control = jnp.where(copy, old.control, jnp.where(pair % width == width - 1, ACTION, pair % width))
    tells = telling(memory, among, outcome, control) + CURIOUS
    fresh = models.init(inputs, config.candidates, key=weight_key)
    nested = active & (population.models.control[:slots] != ACTION)
    like = jax.tree.map(lambda leaf: leaf[jax.vmap(lambda die: drawn(1.0 * nested, die))(dice[8])], population.models)
    like = jax.vmap(lambda *given: in_the_roles_of(room, *given))(like, outcome, control)
    transfer = ~copy & nested.any() & (control != ACTION) & (dice[9] < TRANSFER)
    context = jnp.where(copy[:, None], _varied(old.context, tells, dice[3:6]), _chosen(tells, dice[5:8]))
    context = jnp.where(transfer[:, None], like.context, context)
    weights = _either(copy, _inherited(old, fresh), _either(transfer, like.weights, fresh))
    moments = _either(copy, jax.tree.map(lambda leaf: leaf[slot], population.moments), jax.vmap(OPTIMISER.init)(fresh))
    nothing = jnp.zeros(config.candidates, jnp.int32)
    made = Population(
        models=Model(outcome.astype(jnp.int32), control.astype(jnp.int32), context, weights),
        moments=moments,
        active=jnp.where(copy, (context != old.context).any(axis=-1), pairs.any()),
        enabled=nothing > 0,
        competence=nothing * 0.0,
        born=nothing + NOBODY,
        age=nothing,
        idle=nothing,
        parent=jnp.where(copy, slot, NOBODY).astype(jnp.int32),
    )
    there = jax.tree.map(lambda leaf: leaf[slots:], population)
    mixed = _either(there.active, there, made)
    return jax.tree.map(lambda leaf, new: leaf.at[slots:].set(new), population, mixed)


def in_the_roles_of(room: Room, model: Model, outcome: Int[Array, ""], control: Int[Array, ""]) -> Model:
    """The same model with other discs in the roles of outcome and control; the others change places accordingly.

    What one disc sees of another is turned around where the order of a pair is.
    """
    count, names = len(room.discs), len(room.names)
    discs = jnp.arange(count)
    for before, after in ((model.control, control), (model.outcome, outcome)):
        there = jnp.argmax(discs == after)
        discs = discs.at[there].set(discs[before]).at[before].set(after)
    first, second = np.array(room.pairs).T
    numbers = np.zeros((count, count), int)
    numbers[first, second] = numbers[second, first] = names + np.arange(len(first))
    colours = jnp.where(discs[1:] > 0, count + discs[1:] - 1, len(room.contexts))  # the robot has no colour
    place = jnp.concatenate([discs, colours, jnp.asarray(numbers)[discs[first], discs[second]]])
    turned = jnp.where(discs[first] < discs[second], 1.0, -1.0)
    sign = jnp.repeat(jnp.concatenate([jnp.ones(names), turned]), 2)[:, None]
    old = model.weights.context
    number = (2 * place[:, None] + jnp.arange(2)).ravel()
    moved = jnp.zeros_like(old).at[number].set(sign * old, mode="drop")
    context = jnp.zeros_like(model.context).at[place].set(model.context, mode="drop")
    return Model(outcome, control, context, model.weights.replace(context=moved))


def _either(which: Bool[Array, "E"], one: Any, other: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(jnp.expand_dims(which, range(1, x.ndim)), x, y), one, other)


def _chosen(tells: Float[Array, "E O"], dice: Float[Array, "3 E"]) -> Bool[Array, "E O"]:
    """No, one or two inputs, drawn by what they tell."""
    first, second = (jax.vmap(drawn)(tells, die) for die in dice[:2])
    count = jax.vmap(lambda die: drawn(jnp.array(INPUTS), die))(dice[2])
    one, two = (jax.nn.one_hot(each, tells.shape[1]) > 0 for each in (first, second))
    return (one & (count > 0)[:, None]) | (two & (count > 1)[:, None])


def _varied(context: Bool[Array, "E O"], tells: Float[Array, "E O"], dice: Float[Array, "3 E"]) -> Bool[Array, "E O"]:
    """One input more, another one in its place, or one less."""
    kind = jnp.where(context.any(axis=-1), (dice[0] * 3).astype(jnp.int32), 0)[:, None]
    lost = jax.nn.one_hot(jax.vmap(drawn)(1.0 * context, dice[1]), context.shape[1]) > 0
    found = jax.nn.one_hot(jax.vmap(drawn)(tells, dice[2]), context.shape[1]) > 0
    return (context & ~(lost & (kind > 0))) | (found & (kind < 2))


def _inherited(old: Model, fresh: Weights) -> Weights:
    """The weights of the old models; those of inputs that they do not have are new, and small at first."""
    had = jnp.repeat(old.context, 2, axis=-1)[..., None]
    return old.weights.replace(context=jnp.where(had, old.weights.context, 0.05 * fresh.context))
