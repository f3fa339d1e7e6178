"""SGIM's rule and others to compare it with, behind one interface.

A selector chooses, for every block of episodes, a region and a strategy: an arm (r, s) of R x S. Those that need a
reward are given the increment of the mean competence of r over its block before: learning progress by this arm.

Sources: UCB1 (Auer, Cesa-Bianchi and Fischer 2002), discounted and sliding-window UCB (Garivier and Moulines 2011),
Exp3, Exp3.S and Exp4 (Auer, Cesa-Bianchi, Freund and Schapire 2002) with rewards rescaled by their quantiles (Graves et
al. 2017), ALP-GMM (Portelas et al. 2019), SGIM-D (Nguyen and Oudeyer 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from envs.common import modes
from star.abstraction.regions import Abstraction, locate
from star.sgim import mixtures, selection
from star.sgim.mixtures import Mixture
from star.sgim.sections import SelectionConfig
from star.sgim.selection import Choice, SgimState

HISTORY = 256  # increments whose quantiles rescale the rewards of Exp3 and Exp4


class Selector(NamedTuple):
    """A rule of choice."""

    state: Any
    select: Callable[..., tuple[Array, Array]]
    """(state, *, key) -> region, strategy"""
    update: Callable[..., Any]
    """(state, region, strategy, goals [n, d], competences [n]) -> state"""


def sgim(config: SelectionConfig, abstraction: Abstraction, costs: Sequence[float], available: Any = None) -> Selector:
    """SGIM's own (`star.sgim.selection`); `available` [S] masks strategies."""

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        choice = selection.select(config, state, available, key=key)
        return choice.region, choice.strategy

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        same = lambda x: jnp.full(competences.shape, x)  # noqa: E731
        choice = Choice(region=same(region), strategy=same(strategy), goal=goals, mode=same(0), log_prob=same(0.0))
        return selection.update(config, state, choice, competences)

    return Selector(selection.init(config, abstraction, costs), select, update)


def uniform(regions: int, strategies: int) -> Selector:
    """Any arm, evenly."""
    return Selector(
        jnp.zeros(()),
        lambda state, *, key: _arm(jax.random.randint(key, (), 0, regions * strategies), strategies),
        lambda state, *_: state,
    )


def round_robin(regions: int, strategies: int) -> Selector:
    """One arm after another."""
    return Selector(
        jnp.zeros((), jnp.int32),
        lambda state, *, key: _arm(state % (regions * strategies), strategies),
        lambda state, *_: state + 1,
    )


def fixed_frequency(
    config: SelectionConfig, abstraction: Abstraction, strategies: int, *, teacher: int, every: int
) -> Selector:
    """SGIM-D: regions by progress; the strategy is `teacher` in every `every`-th block, else strategy 0."""
    rule = sgim(config, abstraction, [1.0] * strategies)

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        region = jax.random.categorical(key, jnp.log(_by_progress(state)))
        return region, jnp.where(state.blocks % every == every - 1, teacher, 0)

    return Selector(rule.state, select, rule.update)


def ucb(regions: int, strategies: int, *, bonus: float, discount: float = 1.0, window: int | None = None) -> Selector:
    """UCB1 on increments: mean + `bonus` sqrt(log(n) / n_a); with `discount` or the last `window` blocks alone."""
    arms = regions * strategies
    mean = jnp.full(regions, jnp.nan)
    counts, totals = jnp.zeros(arms), jnp.zeros(arms)
    ring = (jnp.full(window or 1, arms), jnp.zeros(window or 1), jnp.zeros((), jnp.int32))

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        _, counts, totals, _ = state
        worth = totals / jnp.maximum(counts, 1e-9)
        width = bonus * jnp.sqrt(jnp.log(1 + counts.sum()) / jnp.maximum(counts, 1e-9))
        value = jnp.where(counts < 1e-3, jnp.inf, worth + width)
        tie = jax.random.uniform(key, value.shape)
        return _arm(jnp.argmax(jnp.where(value == value.max(), tie, -1.0)), strategies)

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        mean, counts, totals, (arms_ring, rewards, at) = state
        mean, reward = _increment(mean, region, competences)
        arm = region * strategies + strategy
        if window is not None:
            counts = counts.at[arms_ring[at]].add(-1.0, mode="drop")
            totals = totals.at[arms_ring[at]].add(-rewards[at], mode="drop")
            arms_ring, rewards, at = arms_ring.at[at].set(arm), rewards.at[at].set(reward), (at + 1) % window
        counts = (discount * counts).at[arm].add(1.0)
        totals = (discount * totals).at[arm].add(reward)
        return mean, counts, totals, (arms_ring, rewards, at)

    return Selector((mean, counts, totals, ring), select, update)


def exp3(regions: int, strategies: int, *, rate: float, explore: float = 0.1, share: float = 0.0) -> Selector:
    """Exp3, and with `share` > 0 Exp3.S, on rescaled increments."""
    arms = regions * strategies
    start = (jnp.full(regions, jnp.nan), jnp.zeros(arms), jnp.zeros(HISTORY), jnp.zeros((), jnp.int32))

    def distribution(weights: Array) -> Float[Array, "arms"]:
        return (1 - explore) * jax.nn.softmax(weights) + explore / arms

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        return _arm(jax.random.categorical(key, jnp.log(distribution(state[1]))), strategies)

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        mean, weights, history, n = state
        mean, increment = _increment(mean, region, competences)
        history, scaled = _rescaled(history, n, increment)
        arm = region * strategies + strategy
        weights = weights.at[arm].add(rate * scaled / distribution(weights)[arm])
        if share:
            mixed = (1 - share) * jax.nn.softmax(weights) + share / arms
            weights = jnp.log(mixed)
        return mean, weights - weights.max(), history, n + 1

    return Selector(start, select, update)


def exp4(
    config: SelectionConfig, abstraction: Abstraction, strategies: int, *, rate: float, explore: float = 0.1
) -> Selector:
    """Exp4 on rescaled increments.

    Its experts: any arm, evenly; each strategy alone, in regions by progress; SGIM itself.
    """
    rule = sgim(config, abstraction, [1.0] * strategies)
    arms = abstraction.capacity * strategies
    none = jnp.full(abstraction.capacity, jnp.nan)
    start = (rule.state, none, jnp.zeros(strategies + 2), jnp.zeros(HISTORY), jnp.zeros((), jnp.int32))

    def advice(known: Any) -> Float[Array, "experts arms"]:
        alone = _by_progress(known)[:, None] * jnp.eye(strategies)[:, None]
        own = selection.probabilities(config, known)
        return jnp.stack([jnp.full(arms, 1 / arms), own.ravel(), *alone.reshape(strategies, arms)])

    def distribution(weights: Array, advised: Array) -> Float[Array, "arms"]:
        return (1 - explore) * jax.nn.softmax(weights) @ advised + explore / arms

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        known, _, weights, *_ = state
        return _arm(jax.random.categorical(key, jnp.log(distribution(weights, advice(known)))), strategies)

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        known, mean, weights, history, n = state
        mean, increment = _increment(mean, region, competences)
        history, scaled = _rescaled(history, n, increment)
        advised, arm = advice(known), region * strategies + strategy
        weights = weights + rate * advised[:, arm] * scaled / distribution(weights, advised)[arm]
        known = rule.update(known, region, strategy, goals, competences)
        return known, mean, weights - weights.max(), history, n + 1

    return Selector(start, select, update)


def alp_gmm(
    abstraction: Abstraction,
    strategies: int,
    *,
    every: int = 250,
    most: int = 8,
    random: float = 0.2,
    memory: int = 12_000,
) -> Selector:
    """ALP-GMM: goals by absolute learning progress, strategies evenly.

    The progress at a goal is how far its competence is from that of the nearest goal of the last `memory`. Once in
    `every` episodes a mixture of at most `most` Gaussians is fitted to as many (goal, progress). Goals are drawn from
    Gaussians in proportion to their mean progress, a share `random` anywhere; what is chosen is the region of the goal.
    """
    d = abstraction.lower.shape[1]
    low, high = abstraction.space
    empty = Mixture(
        weights=jnp.zeros(most), means=jnp.zeros((most, d + 1)), covariances=jnp.zeros((most, d + 1, d + 1))
    )
    start = (jnp.zeros((memory, d)), jnp.zeros(memory), jnp.zeros((every, d + 1)), empty, jnp.zeros((), jnp.int32))

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        *_, mixture, n = state
        random_key, even_key, part_key, goal_key, strategy_key = jax.random.split(key, 5)
        mean_progress = jnp.maximum(mixture.means[:, -1], 0.0)  # 0 may be less than 0 by rounding
        part = jax.random.categorical(part_key, jnp.log(mean_progress * (mixture.weights > 0)))
        mean, covariance = mixture.means[part, :d], mixture.covariances[part, :d, :d]
        drawn = jax.random.multivariate_normal(goal_key, mean, covariance)
        even = jax.random.uniform(even_key, (d,), minval=low, maxval=high)
        anywhere = (n < every) | jax.random.bernoulli(random_key, random) | ~jnp.isfinite(drawn).all()
        region = locate(abstraction, jnp.where(anywhere, even, drawn))
        return region, jax.random.randint(strategy_key, (), 0, strategies)

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        remembered, reached, points, mixture, n = state
        apart = jnp.square(goals[:, None] - remembered).sum(axis=-1)
        nearest = jnp.argmin(jnp.where(jnp.arange(memory) < n, apart, jnp.inf), axis=-1)
        progress = jnp.where(n > 0, jnp.abs(competences - reached[nearest]), 0.0)
        slots = n + jnp.arange(len(goals))
        points = points.at[slots % every].set(jnp.concatenate([goals, progress[:, None]], axis=-1))
        remembered = remembered.at[slots % memory].set(goals)
        reached = reached.at[slots % memory].set(competences)
        due = (n + len(goals)) // every > n // every
        mixture = jax.lax.cond(due, lambda: _fitted(points, most, key=modes.key(n)), lambda: mixture)
        return remembered, reached, points, mixture, n + len(goals)

    return Selector(start, select, update)


def _fitted(points: Float[Array, "n d"], most: int, *, key: Array) -> Mixture:
    """The best mixture in the units of `points`, which are brought to unit scale for the fit."""
    middle, scale = points.mean(axis=0), points.std(axis=0) + 1e-6
    mixture = mixtures.best_fit((points - middle) / scale, most=most, key=key)
    return Mixture(
        weights=mixture.weights,
        means=middle + scale * mixture.means,
        covariances=scale[:, None] * scale * mixture.covariances,
    )


def _by_progress(state: SgimState, *, random: float = 0.2) -> Float[Array, "R"]:
    """Probabilities of regions in proportion to the progress over their windows; a share `random` is even."""
    grown, even = jnp.maximum(selection.progress(state), 0.0), 1 / len(state.written)
    total = grown.sum()
    return random * even + (1 - random) * jnp.where(total > 0, grown / jnp.where(total > 0, total, 1.0), even)


def _increment(mean: Float[Array, "R"], region: Array, competences: Array) -> tuple[Float[Array, "R"], Array]:
    """Mean competence of each region in its last block after this one, and the increment; 0 where `mean` is NaN yet."""
    now = competences.mean()
    return mean.at[region].set(now), jnp.where(jnp.isnan(mean[region]), 0.0, now - mean[region])


def _rescaled(history: Float[Array, "HISTORY"], n: Array, increment: Array) -> tuple[Float[Array, "HISTORY"], Array]:
    """History with the n-th increment, and this brought from between its 20 % and 80 % quantiles to [-1, 1]."""
    history = history.at[n % HISTORY].set(increment)
    seen = jnp.where(jnp.arange(HISTORY) <= n, history, jnp.nan)
    low, high = jnp.nanquantile(seen, jnp.array([0.2, 0.8]))
    return history, jnp.clip(2 * (increment - low) / jnp.maximum(high - low, 1e-9) - 1, -1.0, 1.0)


def _arm(arm: Array, strategies: int) -> tuple[Array, Array]:
    return arm // strategies, arm % strategies
