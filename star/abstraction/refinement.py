"""Refinement: between episodes, look at pairs of regions and cut a region where only a part of it reaches the other.

    a pair (i, j), i != j, is due when
        it was commanded `min_transitions` times since i or j changed or it was examined (for (i, i) half of them stay),
        it has no verdict, and
        the forward model's held-out error on it has stopped falling
    the due pair with most transitions times epochs since it was examined is taken (star/abstraction/reachability.py):
        all parts of i reach j:  edge i -> j, REACHES
        none does:               MISSES, until older than `miss_lifetime` epochs: the low levels are still learning
        some do:                 cut i along the axis that best parts the reaching from the missing leaves
    where no cut is possible, there is an edge if all parts of i where agents have been reach j, else no verdict

With `within`, pairs (i, i) are examined too: does a region reach the goals inside it? They count decisions of agents
in i whose goal lies in i. One of their goals is drawn, if possible one that was reached, and the square inside its
circle of success is the box to reach. Only cuts come of it, no verdicts, since the next goal may be another one.

With `separate`, regions are cut besides along planes that agents do not pass (star/abstraction/passages.py).

Source: STAR (ICLR 2024), section 4.3 and algorithm 2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.common.batching import where
from star.abstraction import cutting, forward_model, passages, reachability, regions
from star.abstraction.forward_model import ForwardModelState, Outcome
from star.abstraction.passages import Tries
from star.abstraction.reachability import MISSES, MIXED, REACHES, UNKNOWN, Leaves
from star.abstraction.regions import Abstraction, Change, Cut, Split
from star.abstraction.sections import AbstractionConfig, ForwardModelConfig, RefinementConfig

Metrics = dict[str, Array]

_SEPARATED = 8  # regions an epoch that may be cut where nobody passes


class Settings(Protocol):
    """The sections that this is about; those of an agent have them."""

    @property
    def abstraction(self) -> AbstractionConfig:
        """The table of regions."""

    @property
    def forward_model(self) -> ForwardModelConfig:
        """The model that predicts the ends of commands."""

    @property
    def refinement(self) -> RefinementConfig:
        """When and where regions are cut."""


class Graph(struct.PyTreeNode):
    """Knowledge of every ordered pair of regions (row: start, column: target)."""

    verdict: Int[Array, "R R"]
    age: Int[Array, "R R"]
    """Epochs since the pair, or that it was cut from, was examined."""
    transitions: Float[Array, "R R"]
    error: Float[Array, "R R"]
    stable: Bool[Array, "R R"]
    told: Int[Array, "R R"]
    """By teachers: 1 where they go from one into the other, -1 where they only go by way of a third, else 0."""
    tries: Tries
    """Of each region, how goals in it were tried from within."""

    @property
    def reaches(self) -> Bool[Array, "*seeds R R"]:
        """Edges: pairs shown reachable."""
        return self.verdict == REACHES

    @property
    def misses(self) -> Bool[Array, "*seeds R R"]:
        """Pairs shown unreachable, and not yet forgotten."""
        return self.verdict == MISSES


def init(*, capacity: int, dimensions: int) -> Graph:
    """Nothing known."""
    square = (capacity, capacity)
    return Graph(
        verdict=jnp.full(square, UNKNOWN, jnp.int32),
        age=jnp.zeros(square, jnp.int32),
        transitions=jnp.zeros(square),
        error=jnp.full(square, jnp.inf, jnp.float32),
        stable=jnp.zeros(square, bool),
        told=jnp.zeros(square, jnp.int32),
        tries=passages.untried(capacity=capacity, dimensions=dimensions),
    )


def tell(
    graph: Graph, abstraction: Abstraction, paths: Float[Array, "N T d"], weight: Float[Array, "N"] | float = 1.0
) -> Graph:
    """Take in the ways that teachers go, given as points close to one another; those of weight 0 count for nothing."""
    weight = jnp.broadcast_to(weight, paths.shape[:1])
    region = regions.locate(abstraction, paths)
    order = jnp.cumsum(jnp.diff(region, axis=1, prepend=region[:, :1]) != 0, axis=1)  # counts the regions entered
    later = order[:, None, :] - order[:, :, None]
    inside = jax.nn.one_hot(region, abstraction.capacity)

    def pairs(chosen: Bool[Array, "N T T"]) -> Bool[Array, "R R"]:
        return jnp.einsum("n,nti,ntu,nuj->ij", weight, inside, chosen.astype(jnp.float32), inside) > 0

    directly, around = pairs(later == 1), pairs(later > 1)
    told = jnp.where(around & (graph.told < 1), -1, graph.told)
    return graph.replace(told=jnp.where(directly, 1, told))


def observe(
    config: Settings,
    graph: Graph,
    *,
    region: Int[Array, "N"],
    target: Int[Array, "N"],
    error: Float[Array, "N"],
    weight: Float[Array, "N"],
) -> Graph:
    """Count one epoch's transitions and compare the forward model's error on them, per pair, with the epoch before."""
    cell = (region, target)
    seen = jnp.zeros_like(graph.transitions).at[cell].add(weight)
    mean = jnp.zeros_like(graph.error).at[cell].add(weight * error) / jnp.maximum(seen, 1.0)
    falling = mean < (1 - config.refinement.error_tolerance) * graph.error
    return graph.replace(
        transitions=graph.transitions + seen,
        error=jnp.where(seen > 0, mean, graph.error),
        stable=jnp.where(seen > 0, ~falling, graph.stable),
    )


def forget(config: Settings, graph: Graph) -> Graph:
    """Let one epoch pass: MISSES verdicts older than `miss_lifetime` become unknown and must earn examination anew."""
    age = graph.age + 1
    expired = graph.misses & (age > config.refinement.miss_lifetime)
    return graph.replace(
        age=age,
        verdict=jnp.where(expired, UNKNOWN, graph.verdict),
        transitions=jnp.where(expired, 0.0, graph.transitions),
    )


def due(config: Settings, graph: Graph, active: Bool[Array, "R"]) -> Bool[Array, "R R"]:
    """The pairs that pass the gate."""
    pairs = active[:, None] & active[None, :]
    if not config.refinement.within:
        pairs &= ~jnp.eye(active.shape[0], dtype=bool)
    commanded = graph.transitions >= config.refinement.min_transitions
    return pairs & commanded & graph.stable & (graph.verdict == UNKNOWN)


def refine(
    config: Settings,
    abstraction: Abstraction,
    graph: Graph,
    model: ForwardModelState,
    goals: Outcome,
    *,
    cube: float | Array,
    weight: Float[Array, "R"] | float = 1.0,
    key: Array,
) -> tuple[Graph, Change, Metrics]:
    """Examine the due pairs of one epoch, at most `pairs_per_epoch`, and cut where a verdict is mixed.

    `cube` is `Spec.cube`. Of the due pairs, those commanded most and waiting longest come first; `weight` multiplies
    the urgency of those that lead to each region. Returns the graph of the new regions, and the change that tables
    indexed by region have to follow, with [pairs_per_epoch * cuts_per_pair] splits and those where nobody passes.
    """
    graph, before, periods = forget(config, graph), abstraction, forward_model.remembered(model)
    met = reached(goals, cube)

    def one_pair(abstraction: Abstraction, graph: Graph, pair_key: Array) -> tuple[Abstraction, Graph, tuple]:
        region, target = _most_urgent(config, abstraction, graph, weight)
        inside = region == target
        goal_key, cut_key = jax.random.split(pair_key)
        commanded, wanted, judged = _boxes(abstraction, region, target, goals, met, cube=cube, key=goal_key)
        leaves = _examine(config, abstraction, model, region, commanded, wanted, periods.start, periods.weight)
        verdict = reachability.summary(leaves)
        graph = graph.replace(
            age=graph.age.at[region, target].set(0),
            transitions=graph.transitions.at[region, target].multiply(0.5 * inside),  # another goal may be drawn
        )
        mixed = judged & (verdict == MIXED)
        abstraction, graph, splits = _cut(config, abstraction, graph, region, leaves, mixed, key=cut_key)
        verdict = jnp.where(mixed & ~splits.done.any() & reachability.reaches_where_visited(leaves), REACHES, verdict)
        recorded = (verdict == REACHES) | ((verdict == MISSES) & (config.refinement.miss_lifetime > 0))
        settled = judged & ~inside & recorded
        known = jnp.where(settled, verdict, graph.verdict[region, target])
        graph = graph.replace(verdict=graph.verdict.at[region, target].set(known))
        return abstraction, graph, (splits, mixed)

    examined, abstraction, graph, (splits, mixed) = _each_due(config, abstraction, graph, one_pair, key=key)
    abstraction, graph, more = _separate(config, abstraction, graph, periods, goals, met)
    splits = jax.tree.map(lambda x, other: jnp.concatenate([x.reshape(-1), other]), splits, more)
    metrics = {
        "examined": examined,
        "mixed": mixed.sum(),
        "splits": splits.done.sum(),
        "separated": more.done.sum(),
        "edges": graph.reaches.sum(),
        "misses": graph.misses.sum(),
        "table_full": (abstraction.count == abstraction.capacity).astype(jnp.int32),
    }
    return graph, Change.of(before, abstraction, splits), metrics


def _each_due(
    config: Settings, abstraction: Abstraction, graph: Graph, one_pair: Callable[..., Any], *, key: Array
) -> tuple[Int[Array, ""], Abstraction, Graph, Any]:
    """Do `one_pair` as long as a pair is due, `pairs_per_epoch` times at most: how often, and all that it returned.

    Its other results have a leading axis of `pairs_per_epoch`, with 0 where it was not done.
    """
    pairs = config.refinement.pairs_per_epoch
    keys = jax.random.split(key, pairs)
    shapes = jax.eval_shape(one_pair, abstraction, graph, keys[0])[2]
    nothing = jax.tree.map(lambda x: jnp.zeros((pairs, *x.shape), x.dtype), shapes)

    def goes_on(carry: tuple) -> Array:
        number, abstraction, graph, _ = carry
        return (number < pairs) & due(config, graph, abstraction.active).any()

    def one(carry: tuple) -> tuple:
        number, abstraction, graph, told = carry
        abstraction, graph, more = one_pair(abstraction, graph, keys[number])
        return number + 1, abstraction, graph, jax.tree.map(lambda all_, x: all_.at[number].set(x), told, more)

    return jax.lax.while_loop(goes_on, one, (jnp.zeros((), jnp.int32), abstraction, graph, nothing))


def _separate(
    config: Settings, abstraction: Abstraction, graph: Graph, periods: Outcome, goals: Outcome, met: Bool[Array, "N"]
) -> tuple[Abstraction, Graph, Split]:
    """Cut regions where nobody passes, if that is wanted, those first in which most move on either side."""
    if not config.refinement.separate:
        none = jnp.zeros(0, jnp.int32)
        return abstraction, graph, Split(done=none > 0, cut=Cut(none, none, jnp.zeros(0)), child=none)
    cuts, evidence, tries = passages.cuts(
        abstraction, periods, goals, met, graph.tries, min_width=config.abstraction.min_width
    )
    graph = graph.replace(tries=tries)
    worst = jnp.argsort(-evidence)[:_SEPARATED]

    def one(carry: tuple[Abstraction, Graph], chosen: tuple[Cut, Array]) -> tuple[tuple[Abstraction, Graph], Split]:
        cut, evidence = chosen
        abstraction, graph, split = _split(config, *carry, cut, wanted=evidence > 0)
        return (abstraction, graph), split

    chosen = jax.tree.map(lambda x: x[worst], (cuts, evidence))
    (abstraction, graph), splits = jax.lax.scan(one, (abstraction, graph), chosen)
    return abstraction, graph, splits


def _most_urgent(
    config: Settings, abstraction: Abstraction, graph: Graph, weight: Float[Array, "R"] | float
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The pair to examine next, region and target, of those that are due."""
    waiting = due(config, graph, abstraction.active)
    urgency = graph.transitions * (1 + graph.age) * weight
    region, target = jnp.unravel_index(jnp.argmax(jnp.where(waiting, urgency, -1.0)), waiting.shape)
    return region, target


def _split(
    config: Settings, abstraction: Abstraction, graph: Graph, cut: Cut, *, wanted: Bool[Array, ""]
) -> tuple[Abstraction, Graph, Split]:
    """Make a cut if it is `wanted` and possible, and let the graph follow."""
    after, possible = regions.split(abstraction, cut, min_width=config.abstraction.min_width)
    child = jnp.minimum(abstraction.count, abstraction.capacity - 1)
    split = Split(done=wanted & possible, cut=cut, child=child)
    return where(split.done, after, abstraction), on_split(graph, split), split


def on_split(graph: Graph, split: Split) -> Graph:
    """Parts of a region inherit what held for all of it; as targets they are new, so their verdicts are unknown.

    All pairs with one of the parts must be commanded anew before they are examined.
    """
    index = jnp.arange(graph.verdict.shape[0])
    new = split.done & (index == split.child)
    origin = jnp.where(new, split.parent, index)
    parts = jax.tree.map(partial(regions.inherit, origin=origin), graph.replace(tries=None))
    changed = new | (split.done & (index == split.parent))
    pair = changed[:, None] | changed
    return parts.replace(
        tries=jax.tree.map(lambda x: jnp.where(changed[:, None, None], 0.0, x), graph.tries),
        verdict=jnp.where(changed, UNKNOWN, parts.verdict),
        transitions=jnp.where(pair, 0.0, parts.transitions),
        told=jnp.where(pair, jnp.minimum(parts.told, 0), parts.told),
    )


def reached(goals: Outcome, cube: float | Array) -> Bool[Array, "N"]:
    """True if the goals, boxes that were commanded, were reached: within `cube` units of each coordinate."""
    away = jnp.maximum(goals.lower - goals.end, goals.end - goals.upper)
    return jnp.all(away <= _widening((goals.upper - goals.lower) / 2, cube), axis=-1)


def _widening(half: Float[Array, "*n d"], cube: float | Array) -> Float[Array, "*n d"]:
    """The gap from a box of half-widths `half` to a cube of half-width `cube`."""
    return jnp.maximum(cube - half, 0.0)


def _boxes(
    abstraction: Abstraction,
    region: Array,
    target: Array,
    goals: Outcome,
    met: Bool[Array, "N"],
    *,
    cube: float | Array,
    key: Array,
) -> tuple[tuple[Array, Array], tuple[Array, Array], Bool[Array, ""]]:
    """The box that is commanded to examine a pair, the box that is to be reached, and whether there is one.

    Both are the target region, or where that is the region itself the box around a goal in it, and the widened one.
    """
    inside = region == target
    goal, there = _draw_goal(abstraction, region, goals, met, key=key)
    commanded = (
        jnp.where(inside, goal[0], abstraction.lower[target]),
        jnp.where(inside, goal[1], abstraction.upper[target]),
    )
    widened = _widening((goal[1] - goal[0]) / 2, cube) * inside
    return commanded, (commanded[0] - widened, commanded[1] + widened), ~inside | there


def _draw_goal(
    abstraction: Abstraction, region: Array, goals: Outcome, met: Bool[Array, "N"], *, key: Array
) -> tuple[tuple[Array, Array], Bool[Array, ""]]:
    """The box around a random goal inside `region`, one that was reached if possible, and whether there is one."""
    centre = (goals.lower + goals.upper) / 2
    inside = jnp.all((abstraction.lower[region] <= centre) & (centre <= abstraction.upper[region]), axis=-1)
    chance = inside * goals.weight * (1.0 + met + jax.random.uniform(key, goals.weight.shape))
    drawn = jnp.argmax(chance)
    return (goals.lower[drawn], goals.upper[drawn]), chance[drawn] > 0


def _examine(
    config: Settings,
    abstraction: Abstraction,
    model: ForwardModelState,
    region: Array,
    commanded: tuple[Array, Array],
    wanted: tuple[Array, Array],
    starts: Array,
    seen: Array,
) -> Leaves:
    return reachability.examine(
        forward_model.network(config.forward_model, model, *commanded),
        (abstraction.lower[region], abstraction.upper[region]),
        wanted,
        starts,
        seen,
        depth=config.refinement.depth,
        parts=config.refinement.parts,
        reach_share=config.refinement.reach_share,
        miss_share=config.refinement.miss_share,
        min_visits=config.refinement.min_visits,
    )


def _cut(
    config: Settings,
    abstraction: Abstraction,
    graph: Graph,
    region: Array,
    leaves: Leaves,
    mixed: Array,
    *,
    key: Array,
) -> tuple[Abstraction, Graph, Split]:
    """Up to `cuts_per_pair` cuts of `region` and of the parts cut from it, best first."""

    def one_cut(carry: tuple, cut_key: Array) -> tuple[tuple, Split]:
        abstraction, graph, parts = carry
        min_width = config.abstraction.min_width
        cut, gain = cutting.best_cut(abstraction, parts, leaves, min_width=min_width)
        if config.refinement.cuts == "random":
            cut = cutting.random_cut(abstraction, cut.region, min_width=min_width, key=cut_key)
        abstraction, graph, split = _split(config, abstraction, graph, cut, wanted=mixed & (gain > 1e-6))
        parts = parts.at[split.child].set(parts[split.child] | split.done)
        return (abstraction, graph, parts), split

    parts = jnp.zeros(abstraction.capacity, bool).at[region].set(True)
    (abstraction, graph, _), splits = jax.lax.scan(
        one_cut, (abstraction, graph, parts), jax.random.split(key, config.refinement.cuts_per_pair)
    )
    return abstraction, graph, splits
