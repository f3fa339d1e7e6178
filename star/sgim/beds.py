"""Test beds: learners whose laws are known, to measure how well a selector spends its episodes.

A bed is a few pure functions of its latent state, so that whole experiments are scanned and vmapped over seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from star.abstraction.regions import Abstraction, create
from star.sgim.selectors import Selector


class Bed(NamedTuple):
    """A learner and what it can practise."""

    regions: Abstraction
    """Bins of the space of goals, all active."""
    strategies: int
    start: Any
    """The latent state before the first episode."""
    play: Callable[..., tuple[Any, Array]]
    """(latent, region, strategy, goals [n, d], late, *, key) -> latent, observed competences [n].

    `late` is whether half of the time is over.
    """
    mastery: Callable[[Any], Array]
    """Latent state -> competence in all that can be learnt, 0 to 1."""


class Course(struct.PyTreeNode):
    """The history, block by block."""

    region: Int[Array, "blocks"]
    strategy: Int[Array, "blocks"]
    mastery: Float[Array, "blocks"]
    """At the end of each block."""
    latent: Any
    """The latent state at the end of each block."""


def run(bed: Bed, selector: Selector, *, blocks: int = 2400, episodes: int = 5, key: Array) -> Course:
    """Let a selector choose what to practise in each of `blocks` blocks of `episodes` episodes."""

    def block(carry: tuple[Any, Any], inputs: tuple[Array, Array]) -> tuple[tuple[Any, Any], Course]:
        latent, state = carry
        number, key = inputs
        select_key, goal_key, play_key = jax.random.split(key, 3)
        region, strategy = selector.select(state, key=select_key)
        lower, upper = bed.regions.lower[region], bed.regions.upper[region]
        goals = jax.random.uniform(goal_key, (episodes, lower.shape[0]), minval=lower, maxval=upper)
        latent, seen = bed.play(latent, region, strategy, goals, 2 * number >= blocks, key=play_key)
        state = selector.update(state, region, strategy, goals, seen)
        return (latent, state), Course(region=region, strategy=strategy, mastery=bed.mastery(latent), latent=latent)

    inputs = (jnp.arange(blocks), jax.random.split(key, blocks))
    return jax.lax.scan(block, (bed.start, selector.state), inputs)[1]


def until_mastered(course: Course, *, level: float = 0.9) -> Int[Array, ""]:
    """Blocks until the mastery exceeds `level`; their number if it never does."""
    there = course.mastery > level
    return jnp.where(there.any(), jnp.argmax(there), there.shape[0])


GAINS = np.array(
    [
        [0.004, 0.001, 0.008, 0],  # autonomous, procedure, teacher, bad teacher
        [0.002, 0.006, 0.004, 0],
        [0.0002, 0.006, 0.001, 0],
        [0, 0, 0.010, 0],
        [0, 0, 0, 0],
        [0, 0, 0, 0],
    ]
)


def six_regions(*, noise: float = 0.0, gains: np.ndarray = GAINS, late_gains: np.ndarray | None = None) -> Bed:
    """A chain of three regions, one that only the teacher teaches, a silent one, a noisy one; four strategies.

    Playing (r, s) once does C_r += gains[r, s] (1 - C_r) if the region that r needs has C > .7: 1 needs 0, 2 needs 1.
    What is observed is C_r + N(0, noise^2), in the noisy region .5 + N(0, .3^2). In the second half of the time
    `late_gains` apply.
    """
    table = jnp.stack([jnp.asarray(gains), jnp.asarray(gains if late_gains is None else late_gains)])
    needs, noisy = jnp.array([-1, 0, 1, -1, -1, -1]), 5

    def play(latent: Array, region: Array, strategy: Array, goals: Array, late: Array, *, key: Array) -> tuple:
        need = needs[region]
        gain = table[late.astype(int), region, strategy] * ((need < 0) | (latent[need] > 0.7))
        path = 1 - (1 - latent[region]) * (1 - gain) ** jnp.arange(1, len(goals) + 1)
        shaken = jax.random.normal(key, path.shape)
        seen = jnp.where(region == noisy, 0.5 + 0.3 * shaken, path + noise * shaken)
        return latent.at[region].set(path[-1]), seen

    return Bed(
        regions=create(((0.0,), (6.0,)), (range(1, 6),), max_regions=6),
        strategies=4,
        start=jnp.zeros(6),
        play=play,
        mastery=lambda latent: latent[:4].mean(),
    )


def frontier(*, noise: float = 0.05) -> Bed:
    """Goals in the unit square, which are reached up to a frontier that practice near it moves on.

    A goal x with x_1 >= x_2 is at the difficulty |x|, and reached with probability p = 1 / (1 + exp((|x| - f) / .05));
    practising it moves f on by gain[s] 4 p (1 - p). With x_1 < x_2 nothing is ever reached. Strategies: autonomous,
    with gain .001; a teacher, .004, who knows only goals up to |x| = .6; a teacher without effect. Regions: 6 x 6
    squares.
    """
    gains = jnp.array([0.001, 0.004, 0.0])

    def play(latent: Array, region: Array, strategy: Array, goals: Array, late: Array, *, key: Array) -> tuple:
        far = jnp.linalg.norm(goals, axis=-1)
        possible = goals[:, 0] >= goals[:, 1]

        def one(front: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
            distance, can = inputs
            p = jax.nn.sigmoid((front - distance) / 0.05) * can
            knows = (strategy != 1) | (distance < 0.6)
            return front + gains[strategy] * knows * 4 * p * (1 - p), p

        latent, reached = jax.lax.scan(one, latent, (far, possible))
        return latent, reached + noise * jax.random.normal(key, reached.shape)

    sixths = tuple(i / 6 for i in range(1, 6))
    return Bed(
        regions=create(((0.0, 0.0), (1.0, 1.0)), (sixths, sixths), max_regions=36),
        strategies=3,
        start=jnp.array(0.1),
        play=play,
        mastery=lambda front: jnp.clip(front / 1.4, 0.0, 1.0),
    )


PLAN = np.array([list(row) for row in ("...#..", "...#..", "...+..", ".K.#..", "...#..")])
"""Free cells, walls #, the door + and the key K."""


def key_and_door(*, noise: float = 0.0) -> Bed:
    """A grid of cells in two rooms; nothing is learnt in the door and the room behind it before the key is mastered.

    A goal is a point in [0, 5) x [0, 6), in the cell of `PLAN` in row floor(x_1) and column floor(x_2). Practising cell
    c once does C_c += g (1 - C_c), and with g / 4 the same to the cells that share a side with it; never to walls, and
    to the door and what lies behind it only if the key's C > .7. Strategies: autonomous, g = .01, behind the door .002;
    a teacher who knows the way through, g = .02 behind the door, else 0; a poor teacher, who whatever the goal has the
    first cell practised, with g = .01. What is observed is C of the goal's cell + N(0, noise^2).
    """
    rows, columns = PLAN.shape
    wall, behind = PLAN == "#", np.arange(columns) >= 3
    key_cell = tuple(np.argwhere(PLAN == "K")[0])
    gains = jnp.array([[0.01, 0.0, 0.01], [0.002, 0.02, 0.01]])  # [behind, strategy]
    first, down, along = np.zeros(2, int), jnp.arange(rows)[:, None], jnp.arange(columns)

    def play(latent: Array, region: Array, strategy: Array, goals: Array, late: Array, *, key: Array) -> tuple:
        def one(skill: Array, cell: Array) -> tuple[Array, Array]:
            practised = jnp.where(strategy == 2, first, cell)
            steps = jnp.abs(down - practised[0]) + jnp.abs(along - practised[1])
            spread = jnp.select([steps == 0, steps == 1], [1.0, 0.25], 0.0)
            open_ = ~wall & (~behind | (skill[key_cell] > 0.7))
            gain = gains[jnp.asarray(behind, int)[practised[1]], strategy] * open_[tuple(practised)]
            skill = skill + gain * spread * open_ * (1 - skill)
            return skill, skill[tuple(cell)]

        latent, seen = jax.lax.scan(one, latent, jnp.floor(goals).astype(int))
        return latent, seen + noise * jax.random.normal(key, seen.shape)

    return Bed(
        regions=create(((0.0, 0.0), (rows, columns)), (range(1, rows), range(1, columns)), max_regions=rows * columns),
        strategies=3,
        start=jnp.zeros(PLAN.shape),
        play=play,
        mastery=lambda skill: skill.sum() / (~wall).sum(),
    )


def oracle(bed: Bed, *, episodes: int = 16) -> Selector:
    """Knows the law of the bed and its latent state: takes the arm with which one episode adds most to the mastery.

    The gain is a mean over `episodes` goals in the region. Greedy: what an arm makes possible later counts nothing.
    """
    lower, upper = bed.regions.lower, bed.regions.upper
    late, unused = jnp.array(False), jax.random.key(0)

    def select(latent: Any, *, key: Array) -> tuple[Array, Array]:
        def gain(region: Array, strategy: Array) -> Array:
            goals = jax.random.uniform(key, (episodes, lower.shape[1]), minval=lower[region], maxval=upper[region])
            once = jax.vmap(lambda goal: bed.mastery(bed.play(latent, region, strategy, goal, late, key=unused)[0]))
            return once(goals[:, None]).mean()

        gains = jax.vmap(jax.vmap(gain, (None, 0)), (0, None))(jnp.arange(len(lower)), jnp.arange(bed.strategies))
        region, strategy = jnp.unravel_index(jnp.argmax(gains), gains.shape)
        return region, strategy

    def update(latent: Any, region: Array, strategy: Array, goals: Array, competences: Array) -> Any:
        return bed.play(latent, region, strategy, goals, late, key=unused)[0]

    return Selector(bed.start, select, update)
