"""The choice of a region of goals to practise, and of a strategy: where competence grows most for what it costs.

    progress by strategy s      P_rs = what a block of episodes with s adds to the competence of region r
    doubt                       v_rs = how uncertain that is
    interest                    I_rs = (max(P_rs, 0) + min(optimism, P) sqrt(v_rs)) / cost_s,  P the largest of all P_rs
    choice                      region and strategy ~ I_rs ^ sharpness; a share is random

A block is what one call of `update` is told: a few episodes of one learner in a row, or an epoch of many environments.
With m_b the mean competence in the b-th block that region r has a part in, and x_bs the share of strategy s in it,

    m_b - m_(b-1)  =  sum over s of f_s P_rs,        f = (x_(b-1) + x_b) / 2,

as a block's mean stands for its middle: half of what is learnt between two middles is due to the block before. P_rs
follows by a Kalman filter with a diagonal covariance v, in units of the variance of the noise of an increment: 1 at
first, less with every block that tells of s, and `drift` more in every block. A window of absolute competences could
not tell a strategy that teaches from one that is merely played while others teach.

All functions but `init` are pure and can be jitted, scanned and vmapped over independent learners. Shapes are
static: R is the capacity for regions, S the number of strategies, W the window, d the dimensions of goals.

Source: im = progress / cost of S. M. Nguyen's habilitation thesis; regions: SAGG-RIAC (Baranes and Oudeyer 2013);
strategies: SGIM-ACTS (Nguyen and Oudeyer 2012); optimism: UCB1 (Auer, Cesa-Bianchi and Fischer 2002).
"""

from __future__ import annotations

from collections.abc import Sequence

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.common import modes
from star.abstraction.regions import Abstraction
from star.sgim.sections import SelectionConfig

RANDOM, INTEREST, BEST = 0, 1, 2  # modes of a choice


class SgimState(struct.PyTreeNode):
    """The memory of every region, and of every strategy in it."""

    abstraction: Abstraction
    costs: Float[Array, "S"]
    goals: Float[Array, "R W d"]
    """The goals practised last in each region; slots are overwritten in turn."""
    competences: Float[Array, "R W"]
    written: Int[Array, "R"]
    """Episodes written to the window of each region since it came to be."""
    mean: Float[Array, "R"]
    """Mean competence in the last block of each region; infinite before the first, and after a cut."""
    shares: Float[Array, "R S"]
    """Share of each strategy in the last block of each region."""
    gains: Float[Array, "R S"]
    """P_rs, in units of competence per block."""
    doubt: Float[Array, "R S"]
    """v_rs, the variance of P_rs over that of the noise of an increment."""
    episodes: Float[Array, "R S"]
    """Episodes played in all."""
    refused: Int[Array, ""]
    """Episodes that were not counted because their competence was not finite."""
    blocks: Int[Array, ""]


class Choice(struct.PyTreeNode):
    """The exercise: a goal in a region, and the strategy to practise it with."""

    region: Int[Array, "*batch"]
    strategy: Int[Array, "*batch"]
    goal: Float[Array, "*batch d"]
    mode: Int[Array, "*batch"]
    """RANDOM, INTEREST or BEST: how region and goal were drawn."""
    log_prob: Float[Array, "*batch"]
    """Logarithm of the probability of region and strategy."""


def init(config: SelectionConfig, abstraction: Abstraction, costs: Sequence[float] | Array) -> SgimState:
    """Nothing practised yet in the regions of `abstraction`; `costs` [S] are those of an episode with each strategy.

    Raises:
      ValueError: if there is no strategy, or a cost is not a positive number.
      UserError: if JAX is in a mode that nothing here runs in.

    """
    modes.check_learning()
    price = np.asarray(costs, np.float32)
    if price.ndim != 1 or not len(price) or not (np.isfinite(price) & (price > 0)).all():
        raise ValueError(f"costs: {price.tolist()}; allowed: a list of positive numbers, one for each strategy")
    capacity, d = abstraction.lower.shape
    pairs = (capacity, len(price))
    return SgimState(
        abstraction=abstraction,
        costs=jnp.asarray(price),
        goals=jnp.zeros((capacity, config.window, d)),
        competences=jnp.zeros((capacity, config.window)),
        written=jnp.zeros(capacity, jnp.int32),
        mean=jnp.full(capacity, jnp.inf, jnp.float32),
        shares=jnp.zeros(pairs),
        gains=jnp.zeros(pairs),
        doubt=jnp.ones(pairs),
        episodes=jnp.zeros(pairs),
        refused=jnp.zeros((), jnp.int32),
        blocks=jnp.zeros((), jnp.int32),
    )


def progress(state: SgimState) -> Float[Array, "R"]:
    """Growth of the competence of each region over its window, in units of competence; 0 if inactive."""
    newer, older = _halves(state)
    grown = mean_where(state.competences, newer) - mean_where(state.competences, older)
    return jnp.where(state.abstraction.active & newer.any(axis=-1), grown, 0.0)


def competence(state: SgimState) -> Float[Array, "R"]:
    """Mean of what is remembered of each region; 0 where that is nothing."""
    return mean_where(state.competences, _known(state))


def mastered(state: SgimState) -> Float[Array, "R d"]:
    """The remembered goal of each region with the greatest competence, or its centre if none is remembered."""
    known = _known(state)
    best = jnp.argmax(jnp.where(known, state.competences, -jnp.inf), axis=-1)
    goal = jnp.take_along_axis(state.goals, best[:, None, None], axis=1)[:, 0]
    centre = (state.abstraction.lower + state.abstraction.upper) / 2
    return jnp.where(known.any(axis=-1)[:, None], goal, centre)


def interest(config: SelectionConfig, state: SgimState) -> Float[Array, "R S"]:
    """Gain of each strategy: what it adds to the competence of each region at best, over its cost; 0 if inactive.

    Loss of competence is worth nothing, or with `forgetting` that share of a gain. What is unknown is worth no more
    than the best that is known, so that slow learning is not drowned by curiosity.
    """
    active = state.abstraction.active[:, None]
    known = jnp.maximum(state.gains, -config.forgetting * state.gains) * active
    hope = jnp.minimum(config.optimism, jnp.maximum(known.max(), 1e-6)) * jnp.sqrt(state.doubt)
    return jnp.where(active, (known + hope) / state.costs, 0.0)


def probabilities(
    config: SelectionConfig,
    state: SgimState,
    available: Bool[Array, "S"] | None = None,
    admissible: Bool[Array, "R"] | None = None,
) -> Float[Array, "R S"]:
    """The distribution that `select` draws region and strategy from; it sums to 1.

    It is 0 on inactive regions, on those not `admissible`, and on strategies not `available`; everywhere if nothing is
    left to choose.
    """
    return _mixture(config, *_distributions(config, state, available, admissible))


def select(
    config: SelectionConfig,
    state: SgimState,
    available: Bool[Array, "S"] | None = None,
    admissible: Bool[Array, "R"] | None = None,
    *,
    key: Array,
) -> Choice:
    """Draw a region and a strategy, and a goal in the region. Vmap over keys for many choices.

    With probability `random` both are drawn evenly, otherwise by their interest; in a share `best` of all choices the
    goal then lies near the point of the region that `best_point` names, else anywhere in it. Where `probabilities`
    leave nothing to choose, `log_prob` is minus infinity and the rest means nothing.
    """
    mode_key, region_key, strategy_key, goal_key = jax.random.split(key, 4)
    shares = jnp.stack([config.random, jnp.maximum(1 - config.random - config.best, 0.0), config.best])
    mode = jax.random.categorical(mode_key, jnp.log(shares))
    at_random, by_interest = _distributions(config, state, available, admissible)
    regional, how = jax.tree.map(lambda a, b: jnp.where(mode == RANDOM, a, b), at_random, by_interest)
    region = jax.random.categorical(region_key, jnp.log(regional))
    strategy = jax.random.categorical(strategy_key, jnp.log(how[region]))
    return Choice(
        region=region,
        strategy=strategy,
        goal=_goal(config, state, region, mode, key=goal_key),
        mode=mode,
        log_prob=jnp.log(_mixture(config, at_random, by_interest)[region, strategy]),
    )


def update(
    config: SelectionConfig,
    state: SgimState,
    choice: Choice,
    competences: Float[Array, "N"],
    *,
    weight: Float[Array, "N"] | None = None,
) -> SgimState:
    """The state after one block of N episodes, whose `choice` has the leading axis [N].

    `competences` say how well each goal was reached, 1 at best. Episodes whose competence or goal is not finite are
    counted as `refused` and change nothing else; those of `weight` 0 are left out.
    """
    n = len(competences)
    chex.assert_shape((choice.region, choice.strategy, competences), (n,))
    chex.assert_shape(choice.goal, (n, state.goals.shape[-1]))
    given = jnp.ones(n, bool) if weight is None else weight > 0
    finite = jnp.isfinite(competences) & jnp.isfinite(choice.goal).all(axis=-1)
    counted = (given & finite).astype(jnp.float32)
    competences = jnp.where(counted > 0, competences, 0.0)
    state = _credit(config, state, choice, competences, counted)
    state = remember(config, state, choice.region, choice.goal, competences, counted)
    return state.replace(refused=state.refused + jnp.sum(given & ~finite), blocks=state.blocks + 1)


def _distributions(
    config: SelectionConfig, state: SgimState, available: Array | None, admissible: Array | None
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Regions [R] and strategies in each of them [R, S] as drawn at random, and as drawn by interest."""
    strategies = jnp.ones_like(state.costs, bool) if available is None else available
    allowed = state.abstraction.active if admissible is None else state.abstraction.active & admissible
    wanted = interest(config, state) * strategies
    within = _sharpened(config, wanted)
    between = _sharpened(config, wanted.max(axis=-1) * allowed) * within.sum(axis=-1)
    evenly = _shares(jnp.zeros_like(wanted), strategies)
    return (_shares(jnp.zeros_like(between), allowed), evenly), (_shares(between, allowed), _shares(within, strategies))


def _sharpened(config: SelectionConfig, worth: Float[Array, "*n K"]) -> Float[Array, "*n K"]:
    """`worth` to the power of `sharpness`, in units of the largest on the last axis; 0 stays 0."""
    largest = worth.max(axis=-1, keepdims=True)
    return (worth / jnp.where(largest > 0, largest, 1.0)) ** config.sharpness


def _mixture(
    config: SelectionConfig, at_random: tuple[Array, Array], by_interest: tuple[Array, Array]
) -> Float[Array, "R S"]:
    joint = [regional[:, None] * how for regional, how in (at_random, by_interest)]
    return config.random * joint[0] + (1 - config.random) * joint[1]


def _shares(worth: Float[Array, "*n K"], mask: Bool[Array, "K"]) -> Float[Array, "*n K"]:
    """Probabilities in proportion to `worth` where `mask`; even ones where nothing there is worth anything."""
    worth = worth * mask
    total = worth.sum(axis=-1, keepdims=True)
    return jnp.where(total > 0, worth / jnp.where(total > 0, total, 1.0), mask / jnp.maximum(mask.sum(), 1))


def _goal(config: SelectionConfig, state: SgimState, region: Array, mode: Array, *, key: Array) -> Float[Array, "d"]:
    """A point anywhere in the region, or in mode BEST near its best point."""
    lower, upper = state.abstraction.lower[region], state.abstraction.upper[region]
    point, around = _best_point(config, state, region), config.focus * (upper - lower)
    near = (mode == BEST) & (state.written[region] > 0)
    low = jnp.where(near, jnp.maximum(lower, point - around), lower)
    high = jnp.where(near, jnp.minimum(upper, point + around), upper)
    return jax.random.uniform(key, lower.shape, minval=low, maxval=high)


def _best_point(config: SelectionConfig, state: SgimState, region: Array) -> Float[Array, "d"]:
    """The remembered goal whose competence grew most since a neighbour of the older half, or is lowest."""
    goals, competences = state.goals[region], state.competences[region]
    if config.best_point == "worst":
        known = jnp.arange(len(competences)) < state.written[region]
        return goals[jnp.argmin(jnp.where(known, competences, jnp.inf))]
    newer, older = (half[region] for half in _halves(state))
    apart = jnp.square(goals[:, None] - goals[None]).sum(axis=-1)
    neighbour = jnp.argmin(jnp.where(older[None], apart, jnp.inf), axis=1)
    return goals[jnp.argmax(jnp.where(newer, competences - competences[neighbour], -jnp.inf))]


def _credit(config: SelectionConfig, state: SgimState, choice: Choice, competences: Array, counted: Array) -> SgimState:
    """Each region's mean, and what its increment says of the strategies played in this block and the one before."""
    pair = (choice.region, choice.strategy)
    played = jnp.zeros_like(state.episodes).at[pair].add(counted)
    total = jnp.zeros_like(state.mean).at[choice.region].add(counted * competences)
    count = played.sum(axis=-1)
    present = count > 0
    mean = jnp.where(present, total / jnp.maximum(count, 1.0), state.mean)
    shares = jnp.where(present[:, None], played / jnp.maximum(count, 1.0)[:, None], state.shares)
    due = (shares + state.shares) / 2
    surprise = mean - state.mean - jnp.sum(due * state.gains, axis=-1)
    shared = due * state.doubt
    rate = shared / (1 + jnp.sum(due * shared, axis=-1, keepdims=True))
    credited = (present & jnp.isfinite(state.mean))[:, None]  # there was a block before
    return state.replace(
        gains=state.gains + jnp.where(credited, rate * surprise[:, None], 0.0),
        doubt=state.doubt * (1 - jnp.where(credited, rate * due, 0.0)) + config.drift,
        shares=shares,
        mean=mean,
        episodes=state.episodes + played,
    )


def remember(
    config: SelectionConfig,
    state: SgimState,
    region: Int[Array, "N"],
    goals: Float[Array, "N d"],
    competences: Float[Array, "N"],
    counted: Float[Array, "N"],
) -> SgimState:
    """Write to each region's window, over its oldest episodes, at most `per_block` of this block drawn at random.

    Where `counted` is 0 an episode is left out.
    """
    order = jax.random.permutation(jax.random.fold_in(modes.key(0), state.blocks), len(competences))
    region, goals, competences, counted = (x[order] for x in (region, goals, competences, counted))
    capacity = len(state.written)
    mine = (region[:, None] == jnp.arange(capacity)) * counted[:, None].astype(jnp.int32)
    rank = jnp.take_along_axis(jnp.cumsum(mine, axis=0), region[:, None], axis=1)[:, 0] - 1
    kept = (counted > 0) & (rank < config.per_block)
    slot = (state.written[region] + rank) % config.window
    cell = (jnp.where(kept, region, capacity), slot)  # beyond the table: dropped
    return state.replace(
        goals=state.goals.at[cell].set(goals, mode="drop"),
        competences=state.competences.at[cell].set(competences, mode="drop"),
        written=state.written + jnp.minimum(mine.sum(axis=0), config.per_block),
    )


def credit(
    config: SelectionConfig,
    state: SgimState,
    region: Int[Array, "N"],
    strategy: Int[Array, "N"],
    increments: Float[Array, "N"],
    weight: Float[Array, "N"],
) -> SgimState:
    """The state after one block, of a learner that knows the competence of each goal before and after it.

    Such an increment is due to the strategy alone, f = 1, and free of the noise of drawing another goal. One of
    `weight` w tells as much as w of weight 1; those that are not finite are counted as `refused`. With the sum W of
    weights and the mean increment m of a pair in this block,

        P += k (m - P),    v <- (1 - k) v + drift,    k = W v / (1 + W v).
    """
    finite = jnp.isfinite(increments)
    refused = jnp.sum(~finite & (weight > 0))
    weight = jnp.where(finite, weight, 0.0)
    pair, zero = (region, strategy), jnp.zeros_like(state.gains)
    total = zero.at[pair].add(weight)
    mean = zero.at[pair].add(weight * jnp.where(finite, increments, 0.0)) / jnp.where(total > 0, total, 1.0)
    rate = total * state.doubt / (1 + total * state.doubt)
    return state.replace(
        gains=state.gains + rate * (mean - state.gains),
        doubt=state.doubt * (1 - rate) + config.drift,
        episodes=state.episodes + total,
        refused=state.refused + refused,
        blocks=state.blocks + 1,
    )


def _known(state: SgimState) -> Bool[Array, "R W"]:
    """Mask of the slots of each region's window that have been written."""
    return jnp.arange(state.competences.shape[1]) < state.written[:, None]


def newest_first(state: SgimState) -> tuple[Int[Array, "R W"], Bool[Array, "R W"]]:
    """Slots of each region's window from the newest to the oldest, and which of these have been written."""
    window = state.competences.shape[1]
    back = state.written[:, None] - 1 - jnp.arange(window)
    return back % window, back >= 0


def _halves(state: SgimState) -> tuple[Bool[Array, "R W"], Bool[Array, "R W"]]:
    """Masks of the slots in the newer and in the older half of what is remembered of each region."""
    window = state.competences.shape[1]
    half = (jnp.minimum(state.written, window) // 2)[:, None]
    age = (state.written[:, None] - 1 - jnp.arange(window)) % window  # of each slot; slots not written are oldest
    return age < half, (half <= age) & (age < 2 * half)


def mean_where(values: Array, mask: Bool[Array, "*n K"]) -> Float[Array, "*n"]:
    """Mean over the last axis where `mask`; 0 where there is nothing."""
    return jnp.sum(values * mask, axis=-1) / jnp.maximum(mask.sum(axis=-1), 1)
