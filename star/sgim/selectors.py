"""SGIM's rule and others to compare it with, behind one interface.

A selector chooses, for every block of episodes, a region and a strategy: an arm (r, s) of R x S. Those that need a
reward are given the increment of the mean competence of r over its block before: learning progress by this arm.

Sources: UCB1 (Auer et al. 2002), discounted and sliding-window UCB (Garivier and Moulines 2011), Exp3 and Exp3.S (Auer
et al. 2002) with rewards rescaled by their quantiles (Graves et al. 2017), SGIM-D (Nguyen and Oudeyer 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from star.abstraction import Abstraction
from star.config import SelectionConfig
from star.sgim import selection
from star.sgim.selection import Choice

HISTORY = 256  # increments whose quantiles rescale the rewards of Exp3


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
        region, _ = rule.select(state, key=key)
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
    """Exp3, and with `share` > 0 Exp3.S: increments between their 20 % and 80 % quantiles become rewards in [-1, 1]."""
    arms = regions * strategies
    start = (jnp.full(regions, jnp.nan), jnp.zeros(arms), jnp.zeros(HISTORY), jnp.zeros((), jnp.int32))

    def distribution(weights: Array) -> Float[Array, "arms"]:
        return (1 - explore) * jax.nn.softmax(weights) + explore / arms

    def select(state: Any, *, key: Array) -> tuple[Array, Array]:
        return _arm(jax.random.categorical(key, jnp.log(distribution(state[1]))), strategies)

    def update(state: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        mean, weights, history, n = state
        mean, increment = _increment(mean, region, competences)
        history = history.at[n % HISTORY].set(increment)
        seen = jnp.where(jnp.arange(HISTORY) <= n, history, jnp.nan)
        low, high = jnp.nanquantile(seen, jnp.array([0.2, 0.8]))
        scaled = jnp.clip(2 * (increment - low) / jnp.maximum(high - low, 1e-9) - 1, -1.0, 1.0)
        arm = region * strategies + strategy
        weights = weights.at[arm].add(rate * scaled / distribution(weights)[arm])
        if share:
            mixed = (1 - share) * jax.nn.softmax(weights) + share / arms
            weights = jnp.log(mixed)
        return mean, weights - weights.max(), history, n + 1

    return Selector(start, select, update)


def _increment(mean: Float[Array, "R"], region: Array, competences: Array) -> tuple[Float[Array, "R"], Array]:
    """Mean competence of each region in its last block after this one, and the increment; 0 where `mean` is NaN yet."""
    now = competences.mean()
    return mean.at[region].set(now), jnp.where(jnp.isnan(mean[region]), 0.0, now - mean[region])


def _arm(arm: Array, strategies: int) -> tuple[Array, Array]:
    return arm // strategies, arm % strategies
