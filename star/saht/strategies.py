"""Strategies: what a learner executes for a goal, alone or as a teacher shows.

    random        sequences anywhere
    actions       near what is known to be best for the goal, by the inverse model or the best neighbour with noise;
                  with a chance that grows with its distance, anywhere
    procedures    by two subgoals: those that were best for such goals, or two at random
    action        a teacher's demonstration, then the same with noise (mimicry)
    outcome       the goal becomes what a teacher has reached, then as `actions` (emulation)
    procedure     by the two subgoals that a teacher names

Each subgoal becomes the nearest outcome that was reached, and what reached the two is executed, one after the other.

All functions are of one learner and make a generation of G sequences. docs/saht.md says where the numbers come from.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from envs.common.batching import where
from envs.worlds import World
from star.saht import inverse
from star.saht.choose import drawn
from star.saht.memory import FAR, Memory, Neighbours, Piece, Scale, least, neighbours, rank, squared
from star.saht.teachers import Shown

NEIGHBOURS = 10
CERTAIN = 0.3  # distance of the best known outcome from which on a learner explores most
LOCAL = (0.1, 0.9)  # least and largest chance of staying near what is known
BY_MODEL, BY_REGRESSION = 0.5, 0.7  # chance of a regression rather than the best neighbour: of actions, of procedures
NOISE, NOISE_MORE, NOISE_MOST = 0.01, 0.5, 0.3  # standard deviation: at distance 0, what a distance of 1 adds, at most
VARIED = 0.5  # chance of each number of a sequence to get noise
RETRY = 0.05  # standard deviation of what is added to what a teacher has shown


class Way(NamedTuple):
    """A strategy as a learner knows it."""

    name: str
    kind: str
    task: int = 0
    """The task of its teacher, if it has one."""
    teacher: int = 0
    """The number of its teacher in `Shown`."""


class Setting(NamedTuple):
    """The needs of strategies besides the memory."""

    world: World
    scale: Scale
    ways: tuple[Way, ...]
    shown: Shown
    generation: int
    """G."""

    def of_way(self, way: Array, name: str) -> Array:
        """The notes on a strategy, by its number."""
        return jnp.array([getattr(one, name) for one in self.ways])[way]


class Order(NamedTuple):
    """The exercise: a scaled goal of a task, by the strategy number `way`."""

    task: Int[Array, ""]
    goal: Float[Array, "4"]
    way: Int[Array, ""]
    first: Bool[Array, ""]
    """True if a block begins with it: then the first sequence is as a teacher shows it."""


class Proposals(struct.PyTreeNode):
    """A generation of sequences."""

    sequences: Float[Array, "G L p"]
    lengths: Int[Array, "G"]
    pair: Int[Array, "G"]
    """Of the procedure that each is made of, as in `Memory`."""
    subgoals: Float[Array, "G 2 4"]


class Dice(NamedTuple):
    """Random numbers of a generation. Kinds of strategies share them: of all that is made one kind is executed.

    Few calls for many numbers: each takes as long to compile as all that a strategy does.
    """

    anywhere: Float[Array, "G L p"]
    """Even in [-1, 1]; all others in [0, 1), or normal."""
    varied: Float[Array, "G L p"]
    normal: Float[Array, "G L p"]
    goals: Float[Array, "G 2 4"]
    normal_goals: Float[Array, "G 2 4"]
    length: Float[Array, "G"]
    local: Float[Array, "G"]
    model: Float[Array, "G"]
    once: Float[Array, "8"]

    @classmethod
    def thrown(cls, world: World, g: int, *, key: Array) -> Dice:
        """For G sequences in a world."""
        even_key, normal_key = jax.random.split(key)
        sequences, two, one = (g, world.longest, world.primitive), (g, 2, 4), (g,)
        even = _parts(jax.random.uniform, even_key, [sequences, sequences, two, one, one, one, (8,)])
        normal = _parts(jax.random.normal, normal_key, [sequences, two])
        anywhere, varied, goals, length, local, model, once = even
        return cls(2 * anywhere - 1, varied, normal[0], goals, normal[1], length, local, model, once)


def _parts(draw: Any, key: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """The draws of one call, in these shapes."""
    sizes = np.array([math.prod(shape) for shape in shapes])
    parts = jnp.split(draw(key, (int(sizes.sum()),)), np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


class Two(NamedTuple):
    """Two tasks, and for each sequence a scaled goal of either."""

    tasks: Int[Array, "2"]
    goals: Float[Array, "G 2 4"]


def propose(setting: Setting, memory: Memory, rows: Array, order: Order, *, key: Array) -> Proposals:
    """The strategy's sequences. Each kind that there is is computed, so that learners side by side may differ."""
    dice = Dice.thrown(setting.world, setting.generation, key=key)
    kinds = {way.kind for way in setting.ways}
    made: dict[str, Proposals] = {}
    if "random" in kinds:
        made["random"] = _plain(anywhere(setting, dice))
    if kinds & {"actions", "outcome"}:
        aimed = _plain(actions(setting, memory, rows, *aim(setting, order), dice))
        made |= {kind: aimed for kind in ("actions", "outcome") if kind in kinds}
    if "action" in kinds:
        made["action"] = _plain(mimicked(setting, order, dice))
    two: dict[str, Two] = {}
    if "procedures" in kinds:
        two["procedures"] = composed(setting, memory, rows, order, dice)
    if "procedure" in kinds:
        two["procedure"] = taught(setting, order, dice)
    if two:
        made |= dict.fromkeys(two, refine(setting, memory, rows, _of_kind(setting, order, two), dice))
    chosen = _of_kind(setting, order, made)
    played = jnp.arange(setting.world.longest) < chosen.lengths[:, None]
    return chosen.replace(sequences=jnp.where(played[..., None], jnp.clip(chosen.sequences, -1.0, 1.0), 0.0))


def _of_kind(setting: Setting, order: Order, made: Mapping[str, Any]) -> Any:
    """That of the strategy's kind; the last one if there is none."""
    (*others, (_, chosen)) = made.items()
    for kind, one in others:
        mine = jnp.array([way.kind == kind for way in setting.ways])[order.way]
        chosen = where(mine, one, chosen)
    return chosen


def _plain(made: tuple[Array, Array]) -> Proposals:
    """Sequences that are no procedures."""
    g = len(made[1])
    return Proposals(*made, pair=jnp.full(g, -1, jnp.int32), subgoals=jnp.zeros((g, 2, 4)))


def anywhere(setting: Setting, dice: Dice) -> tuple[Float[Array, "G L p"], Int[Array, "G"]]:
    """Random sequences, each primitive more half as likely."""
    weights = 0.5 ** np.arange(setting.world.longest)
    below = np.cumsum(weights)[:-1] / weights.sum()
    return dice.anywhere, 1 + jnp.sum(dice.length[:, None] >= below, axis=1, dtype=jnp.int32)


def aim(setting: Setting, order: Order) -> tuple[Array, Array]:
    """Task and goal; of a teacher of outcomes those of the demonstration nearest to the goal."""
    if all(way.kind != "outcome" for way in setting.ways):
        return order.task, order.goal
    emulated = jnp.array([way.kind == "outcome" for way in setting.ways])[order.way]
    nearest = _nearest(setting, order)
    outcome = setting.shown.outcomes[setting.of_way(order.way, "teacher"), nearest]
    return where(emulated, (setting.of_way(order.way, "task"), outcome), (order.task, order.goal))


def _nearest(setting: Setting, order: Order) -> Int[Array, ""]:
    """The number of the demonstration of the strategy's teacher that is nearest to the goal."""
    teacher = setting.of_way(order.way, "teacher")
    apart = squared(setting.shown.outcomes[teacher].T, order.goal)
    return jnp.argmin(jnp.where(jnp.arange(len(apart)) < setting.shown.counts[teacher], apart, jnp.inf))


def chance_of_local(near: Neighbours) -> Float[Array, ""]:
    """The chance of staying near the best neighbour: the nearer it is to the goal the greater; 0 if there is none."""
    return jnp.where(near.known[0], jnp.clip(1 - near.distances[0] / CERTAIN, *LOCAL), 0.0)


def noise(near: Neighbours) -> Float[Array, ""]:
    """The standard deviation of noise around what the neighbours say."""
    return jnp.minimum(NOISE + NOISE_MORE * near.distances[0], NOISE_MOST)


def actions(
    setting: Setting, memory: Memory, rows: Array, task: Array, goal: Array, dice: Dice
) -> tuple[Float[Array, "G L p"], Int[Array, "G"]]:
    """Near what is known to be best for the goal, or anywhere."""
    near = neighbours(memory, rows, task, goal, k=NEIGHBOURS)
    best = memory.sequences[near.rows[0]]
    model = inverse.action(memory, near, goal, jnp.array(setting.world.dims)[task])
    base = jnp.where((dice.model < BY_MODEL)[:, None, None], model, best)
    varied = noise(near) * dice.normal * (dice.varied < VARIED)
    others, lengths = anywhere(setting, dice)
    local = dice.local < chance_of_local(near)
    sequences = jnp.where(local[:, None, None], base + varied, others)
    return sequences, jnp.where(local, memory.lengths[near.rows[0]], lengths)


def mimicked(setting: Setting, order: Order, dice: Dice) -> tuple[Float[Array, "G L p"], Int[Array, "G"]]:
    """The teacher's demonstration that is nearest to the goal, or one at random if the task is another than his."""
    teacher = setting.of_way(order.way, "teacher")
    some = jnp.floor(dice.once[0] * setting.shown.counts[teacher]).astype(jnp.int32)
    number = jnp.where(setting.of_way(order.way, "task") == order.task, _nearest(setting, order), some)
    sequences = setting.shown.sequences[teacher, number] + RETRY * dice.normal * _but_first(setting, order)
    return sequences, jnp.full(setting.generation, setting.shown.lengths[teacher, number])


def _but_first(setting: Setting, order: Order) -> Float[Array, "G 1 1"]:
    """1, but 0 for the first sequence of a block."""
    return 1.0 - ((jnp.arange(setting.generation) == 0) * order.first)[:, None, None]


def composed(setting: Setting, memory: Memory, rows: Array, order: Order, dice: Dice) -> Two:
    """The subgoals that were best for such goals, with noise, or any two of tasks that were reached."""
    near = neighbours(memory, rows, order.task, order.goal, k=NEIGHBOURS, procedures=True)
    pairs, known = memory.pair[near.rows], memory.subgoals[near.rows]
    same = near.known & (pairs == pairs[0])
    model = inverse.regress(near.outcomes, known.reshape(NEIGHBOURS, -1), near.distances, same, order.goal)
    enough = same.sum() > jnp.array(setting.world.dims)[order.task]
    by_model = (dice.model < BY_REGRESSION)[:, None, None] & enough
    tasks = len(setting.world.tasks)
    mine = jnp.stack([pairs[0] // tasks, pairs[0] % tasks])
    any_two = jax.vmap(drawn, in_axes=(None, 0))(memory.reached > 0, dice.once[1:3])
    local = dice.once[3] < chance_of_local(near)
    chosen = jnp.where(local, mine, any_two)
    top = jnp.asarray(setting.scale.top)[chosen]  # [2, 4]
    goals = jnp.where(by_model, model.reshape(2, 4), known[0]) + noise(near) / 2 * top * dice.normal_goals
    return Two(chosen, jnp.where(local, goals, top * dice.goals))


def taught(setting: Setting, order: Order, dice: Dice) -> Two:
    """The subgoals that the teacher names for the goal, or for any one of his task if the goal is of another."""
    task = setting.of_way(order.way, "task")
    goal = jnp.where(task == order.task, order.goal, setting.scale.unit(task, dice.once[4:]))
    named: Two | None = None
    for known in {way.task: None for way in setting.ways if way.kind == "procedure"}:
        parts = setting.world.decompose(known, setting.scale.value(known, goal))
        lower, width = (jnp.asarray(one)[parts.tasks] for one in (setting.scale.lower, setting.scale.width))
        one = Two(parts.tasks, (parts.goals - lower) / width)
        named = one if named is None else where(task == known, one, named)
    assert named is not None
    top = jnp.asarray(setting.scale.top)[named.tasks]
    return Two(named.tasks, named.goals + RETRY * top * dice.normal_goals * _but_first(setting, order))


def refine(setting: Setting, memory: Memory, rows: Array, two: Two, dice: Dice) -> Proposals:
    """The sequences that reached the outcomes nearest to both goals, one after the other; anything if they do not fit.

    Nearest is by `rank`, and leaves room: for one more primitive, and for the first sequence.
    """
    longest = setting.world.longest

    def found(which: int, room: Array) -> tuple[Array, Array]:
        def value(part: Piece) -> Array:
            square = squared(part.outcomes, two.goals[:, which])
            return jnp.where(part.lengths <= room[:, None], rank(square, part.lengths), FAR)

        return least(memory, rows, two.tasks[which], value, (setting.generation,))

    first_rank, first = found(0, jnp.full(setting.generation, longest - 1))
    length = memory.lengths[first]
    second_rank, second = found(1, longest - length)
    place = jnp.arange(longest) - length[:, None]
    after = jnp.take_along_axis(memory.sequences[second], jnp.maximum(place, 0)[..., None], axis=1)
    sequences = jnp.where((place < 0)[..., None], memory.sequences[first], after)
    fits = jnp.maximum(first_rank, second_rank) < FAR / 2
    others, lengths = anywhere(setting, dice)
    subgoals = jnp.stack([memory.outcomes[two.tasks[n], :, row] for n, row in enumerate((first, second))], axis=1)
    return Proposals(
        sequences=jnp.where(fits[:, None, None], sequences, others),
        lengths=jnp.where(fits, length + memory.lengths[second], lengths),
        pair=jnp.where(fits, two.tasks[0] * len(setting.world.tasks) + two.tasks[1], -1),
        subgoals=jnp.where(fits[:, None, None], subgoals, 0.0),
    )
