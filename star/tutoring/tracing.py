"""Prerequisites from scores alone: knowledge tracing whose graph is learnt.

    level       l_k = c + a_s + sum_f w_fk x_fk         of skill k; a_s is the ability of the student
    features    x = ln(1 + right), ln(1 + wrong), running success at two rates: of the exercises so far that need k
    graph       m_ij = sigma(M_ij): how strongly skill j is a prerequisite of skill i
    involved    v_ej = 1 if exercise e needs j, else 1 - prod_{i needed} (1 - m_ij)
    chance      z = sigma(softmin_v(l) - d_e),  softmin_v(l) = sum_j v_ej e^(-l_j) l_j / sum_j v_ej e^(-l_j)
    score       right with guess + (1 - guess - slip) z
    loss        cross-entropy + (sparsity sum m + one_way sum m_ij m_ji) / n

Several models are fitted, each to students drawn anew with replacement (a bootstrap). The strength of an edge is the
mean of its m, its share that of the models whose own graph has it.

Levels here are in units of ln 10 / 400 Elo points.

Source: a graph learnt within knowledge tracing: Annabi and Nguyen (ICDL 2023, arXiv 2402.01672), in our own form.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import random
from jaxtyping import Array, Bool, Float, Int

from star.tutoring import graphs
from star.tutoring.sections import DiscoveryConfig

RATES = (0.1, 0.3)  # of running success
FEATURES = 2 + len(RATES)
"""F, of each skill before each score."""
_NEAR_1 = 0.999  # of m in the product over needed skills, so that its logarithm is finite
Params = dict[str, Array]


class Scores(struct.PyTreeNode):
    """Scores of many students: N rows, those of a student one after the other in the order of time."""

    student: Int[Array, "N"]
    """Students are numbered from 0."""
    exercise: Int[Array, "N"]
    right: Bool[Array, "N"]


class Found(struct.PyTreeNode):
    """Graphs found."""

    parents: Bool[Array, "n n"]
    """[i, j]: skill j is a prerequisite of skill i; without cycles and edges that others imply."""
    strength: Float[Array, "n n"]
    """Mean over models, in [0, 1]."""
    share: Float[Array, "n n"]
    """Share of the models whose graphs have the edge."""


def discover(config: DiscoveryConfig, needs: Bool[Array, "E n"], scores: Scores, students: int, *, key: Array) -> Found:
    """The prerequisites among the skills that `needs` gives for each exercise; `students` is their number."""
    seen = features(needs, scores)
    fits = jax.lax.map(
        lambda one: fit(config, needs, scores, seen, students, key=one), random.split(key, config.members)
    )
    of = lambda strength: graphs.acyclic(strength, config.threshold)  # noqa: E731
    strength = fits.mean(axis=0)
    return Found(parents=of(strength), strength=strength, share=jax.vmap(of)(fits).mean(axis=0))


def features(needs: Bool[Array, "E n"], scores: Scores) -> Float[Array, "N F n"]:
    """Evidence of each student for each skill before each score."""
    n = needs.shape[1]
    rates = jnp.asarray(RATES)[:, None]
    none = (jnp.zeros((2, n)), jnp.zeros((len(RATES), n)))

    def step(state: Any, row: Any) -> Any:
        exercise, right, first = row
        counts, running = jax.tree.map(lambda x: jnp.where(first, 0.0, x), state)
        needed = needs[exercise]
        counted = counts.at[jnp.where(right, 0, 1)].add(needed)
        moved = running + rates * needed * (right - running)
        return (counted, moved), jnp.concatenate([jnp.log1p(counts), 4 * running])

    first = jnp.concatenate([jnp.ones(1, bool), scores.student[1:] != scores.student[:-1]])
    return jax.lax.scan(step, none, (scores.exercise, scores.right, first))[1]


def fit(
    config: DiscoveryConfig,
    needs: Bool[Array, "E n"],
    scores: Scores,
    seen: Float[Array, "N F n"],
    students: int,
    *,
    key: Array,
) -> Float[Array, "n n"]:
    """The strengths m of one model, fitted to students drawn anew."""
    first_key, draw_key, steps_key = random.split(key, 3)
    drawn = random.randint(draw_key, (students,), 0, students)
    weight = jnp.zeros(students).at[drawn].add(1.0)
    params = _first(needs, students, key=first_key)
    optimiser = optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.steps))

    def step(state: Any, key: Array) -> Any:
        params, moments = state
        rows = random.randint(key, (config.batch,), 0, len(scores.right))
        gradient = jax.grad(_loss)(params, config, needs, jax.tree.map(lambda x: x[rows], scores), seen[rows], weight)
        updates, moments = optimiser.update(gradient, moments)
        return (optax.apply_updates(params, updates), moments), None

    state = (params, optimiser.init(params))
    (params, _), _ = jax.lax.scan(step, state, random.split(steps_key, config.steps))
    return strengths(params)


def strengths(params: Params) -> Float[Array, "n n"]:
    """m; 0 on the diagonal."""
    m = jax.nn.sigmoid(params["graph"])
    return m * (1 - jnp.eye(len(m)))


def chances(
    params: Params, needs: Bool[Array, "E n"], scores: Scores, seen: Float[Array, "B F n"]
) -> Float[Array, "B"]:
    """The chance that each score is right."""
    ability = params["ability"][scores.student][:, None]
    levels = params["level"] + ability + (params["weights"] * seen).sum(axis=1)
    implied = 1 - jnp.exp(needs @ jnp.log1p(-_NEAR_1 * strengths(params)))
    involved = jnp.where(needs, 1.0, implied)[scores.exercise]
    weight = involved * jnp.exp(levels.min(axis=-1, keepdims=True) - levels)
    lowest = (weight * levels).sum(axis=-1) / weight.sum(axis=-1)
    guess, slip = jax.nn.sigmoid(params["guess"]) / 2, jax.nn.sigmoid(params["slip"]) / 2
    return guess + (1 - guess - slip) * jax.nn.sigmoid(lowest - params["difficulty"][scores.exercise])


def _first(needs: Bool[Array, "E n"], students: int, *, key: Array) -> Params:
    exercises, n = needs.shape
    return {
        "graph": -2.0 + 0.1 * random.normal(key, (n, n)),
        "level": jnp.full(n, -1.0),
        "weights": jnp.tile(jnp.asarray([0.5, 0.0, *(0.3 for _ in RATES)])[:, None], (1, n)),
        "ability": jnp.zeros(students),
        "difficulty": jnp.zeros(exercises),
        "guess": jnp.asarray(-1.4),
        "slip": jnp.asarray(-2.2),
    }


def _loss(
    params: Params, config: DiscoveryConfig, needs: Array, scores: Scores, seen: Array, weight: Float[Array, "students"]
) -> Float[Array, ""]:
    chance = chances(params, needs, scores, seen)
    surprise = -jnp.where(scores.right, jnp.log(chance), jnp.log1p(-chance))
    m = strengths(params)
    prior = 1e-3 * (jnp.square(params["ability"]).mean() + jnp.square(params["difficulty"]).mean())
    edges = (config.sparsity * m.sum() + config.one_way * (m * m.T).sum()) / len(m)
    return (weight[scores.student] * surprise).mean() + prior + edges
