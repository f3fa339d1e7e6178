"""Models are born, their inputs change, and those of no use are switched off.

    evolve   all learn from what is remembered
             each is judged on what was held out, and so is every other model of the same outcome, on the same actions
             a candidate that explains more than they do is born; a changed copy that is better takes its parent's place
             slots that are of no use for long are switched off, and on again when they are of use
             new candidates take the places of those that were judged

A model tells what follows when its control moves. So it learns from, and is judged on, actions in which that moves.
Source: CHIME (Manoury, Nguyen, Buche, arXiv 2009.10968); rules and numbers are ours.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.worlds.room import Room
from star.saht.chime import candidates, models
from star.saht.chime import memory as memories
from star.saht.chime.candidates import NOBODY, Population, controllable, leads
from star.saht.chime.memory import Memory
from star.saht.chime.sections import ChimeConfig

NESTED = 1.1
"""A model whose control is an observable may err by so much more than one of the action, and is preferred."""
FEWER = 1.02  # an input less may cost so much of the error


class Judged(struct.PyTreeNode):
    """Errors on what was held out."""

    own: Float[Array, "K"]
    """Of each model; 1 where too few actions tell."""
    slots: Float[Array, "K M"]
    """Of each slot on the actions of each model; infinite where it is no other model of the same outcome that is on."""
    parent: Float[Array, "K"]
    """Of its parent on the actions of a changed copy."""


def evolve(
    config: ChimeConfig, room: Room, population: Population, memory: Memory, births: Int[Array, "B B+1"], *, key: Array
) -> tuple[Population, Int[Array, "B B+1"]]:
    """The population, and the first births of each outcome by each control, after an evolution."""
    learn_key, judge_key, draw_key = jax.random.split(key, 3)
    kept, held = memories.parts(memory)
    population = learn(config, population, memory, kept, key=learn_key)
    judged = judge(config, population, memory, held, key=judge_key)
    now = jnp.clip(1 - judged.own, 0.0, 1.0)
    slow = population.competence + config.smooth * (now - population.competence)
    population = population.replace(competence=jnp.where(population.born != NOBODY, slow, now))
    population, births = succeed(config, population, judged, births, now=memory.written)
    population = switch(config, population, judged)
    return candidates.renew(config, room, population, memory, kept, key=draw_key), births


def learn(
    config: ChimeConfig, population: Population, memory: Memory, among: Bool[Array, "N"], *, key: Array
) -> Population:
    """All models after some steps of Adam, each on its own draws of these actions."""

    def one(model: models.Model, moments: Any, dice: Array) -> tuple[models.Weights, Any]:
        rows = memories.mixture(memory, among, model.outcome, model.control, dice)
        return models.train(model, moments, memory.rows, rows)

    dice = jax.random.uniform(key, (len(population.active), config.steps, config.batch, 2))
    weights, moments = jax.vmap(one)(population.models, population.moments, dice)
    return population.replace(models=population.models._replace(weights=weights), moments=moments)


def judge(
    config: ChimeConfig, population: Population, memory: Memory, among: Bool[Array, "N"], *, key: Array
) -> Judged:
    """Errors of all models on these actions. Models of one outcome and control are judged on the same draws."""
    slots, everybody = config.models, population.models
    of_slots = jax.tree.map(lambda leaf: leaf[:slots], everybody)
    dice = jax.random.uniform(key, (config.held, 2))

    def one(model: models.Model) -> tuple[Array, Array]:
        rows = memories.mixture(memory, among, model.outcome, model.control, dice)
        batch = jax.tree.map(lambda leaf: leaf[rows], memory.rows)
        change = batch.change[:, model.outcome]

        def off(other: models.Model) -> Array:
            return models.error(models.predict(other, batch), change)

        return off(model), jax.vmap(off)(of_slots)

    own, others = jax.vmap(one)(everybody)
    counted = memories.counts(memory, among)[everybody.outcome, everybody.control]
    number = jnp.arange(len(own))
    rival = everybody.outcome[:, None] == of_slots.outcome
    rival &= population.enabled[:slots] & (number[:, None] != number[:slots])
    return Judged(
        own=jnp.where(counted >= config.few // 3, own, 1.0),
        slots=jnp.where(rival, others, jnp.inf),
        parent=others[number, jnp.maximum(population.parent, 0)],
    )


def succeed(
    config: ChimeConfig, population: Population, judged: Judged, births: Int[Array, "B B+1"], *, now: Array
) -> tuple[Population, Int[Array, "B B+1"]]:
    """The best new model gets a slot, and the best changed copy of each slot its place; what was judged is dropped."""
    slots, count = config.models, len(judged.own)
    number = jnp.arange(count)
    is_slot = number < slots
    ripe = population.active & ~is_slot & (population.age + 1 >= config.trial)
    better = ripe & changed_for_good(config, population, judged)
    gain = jnp.where(better, FEWER * judged.parent - judged.own, -jnp.inf)
    of_slot = jnp.where(population.parent == number[:slots, None], gain, -jnp.inf)  # [M, K]
    source = jnp.where(of_slot.max(axis=1) > -jnp.inf, of_slot.argmax(axis=1), number[:slots])
    new = ripe & worth_a_slot(config, population, judged)
    chosen = jnp.argmax(jnp.where(new, -judged.own, -jnp.inf))
    # a free slot, else that of the worst that is switched off
    room = jnp.where(population.active, jnp.where(population.enabled, -1.0, 1 - population.competence), 2.0)[:slots]
    place = jnp.argmax(room)
    born = new.any() & (room[place] >= 0)
    source = source.at[place].set(jnp.where(born, chosen, source[place]))
    fresh = born & (number == place)
    taken = jnp.zeros(count, bool).at[source].set(True) & ~is_slot
    moved = jax.tree.map(lambda leaf: jnp.concatenate([leaf[source], leaf[slots:]]), population)
    pair = moved.models.outcome[place], moved.models.control[place]
    first = births[pair] == NOBODY
    return moved.replace(
        active=jnp.where(is_slot, population.active | fresh, population.active & ~taken & (~ripe | new)),
        enabled=is_slot & (population.enabled | fresh),
        born=jnp.where(fresh, now, population.born),
        age=jnp.where(is_slot, 0, population.age + 1),
        idle=jnp.where(fresh, 0, population.idle),
        parent=jnp.where(is_slot, NOBODY, population.parent),
    ), births.at[pair].set(jnp.where(born & first, now, births[pair]))


def changed_for_good(config: ChimeConfig, population: Population, judged: Judged) -> Bool[Array, "K"]:
    """True for copies that are better than their parents by enough, or not worse with an input less."""
    inputs = population.models.context.sum(axis=-1)
    fewer = inputs < inputs[jnp.maximum(population.parent, 0)]
    return (population.parent != NOBODY) & (judged.own <= jnp.where(fewer, FEWER, 1 - config.gain) * judged.parent)


def worth_a_slot(config: ChimeConfig, population: Population, judged: Judged) -> Bool[Array, "K"]:
    """True for models that explain something new, by way of something that is controllable."""
    slots, found = config.models, population.models
    nested = found.control != models.ACTION
    reach, able = leads(config, population), controllable(config, population)
    cyclic = nested & (reach[found.outcome, found.control] | (found.outcome == found.control))
    twin = (found.outcome[:, None] == found.outcome[:slots]) & (found.control[:, None] == found.control[:slots])
    twin = (twin & population.active[:slots]).any(axis=1)
    allowed = jnp.where(nested[:, None] & ~nested[:slots], NESTED, 1 - config.gain)
    explains = (judged.own[:, None] <= allowed * judged.slots).all(axis=1)
    competent = 1 - judged.own >= config.birth
    return (population.parent == NOBODY) & competent & explains & ~cyclic & ~twin & (~nested | able[found.control])


def switch(config: ChimeConfig, population: Population, judged: Judged) -> Population:
    """Slots of no use are switched off: those without competence, and those that another one explains as well.

    `idle` counts evolutions without use, less those with use. At 0 a competent one is switched on again. Tasks that
    were given stay.
    """
    if config.tasks == "given":
        return population
    slots = config.models
    nested = population.models.control != models.ACTION
    enough = jnp.where(nested[:slots] & ~nested[:, None], NESTED, 1 - config.gain)
    explained = (judged.slots < enough * judged.own[:, None]).any(axis=1)
    useless = (population.competence < config.lowest) | explained
    idle = jnp.where(population.born != NOBODY, jnp.maximum(population.idle + jnp.where(useless, 1, -1), 0), 0)
    again = (idle == 0) & (population.competence >= config.birth)
    on = jnp.where(population.enabled, idle < config.patience, again)
    return population.replace(idle=jnp.minimum(idle, 2 * config.patience), enabled=on & (population.born != NOBODY))
