"""Strategies: what a learner executes for a goal, alone or as a teacher shows.

    random        sequences anywhere
    actions       near what is known to be best for the goal, by the inverse model or the best neighbour with noise;
                  with a chance that grows with its distance, anywhere
    procedures    by two subgoals: those that were best for such goals, or two at random
    action        a teacher's demonstration, then the same with noise (mimicry)
    outcome       the goal becomes what a teacher has reached, then as `actions` (emulation)
    procedure     by the two subgoals that a teacher names
    dagger, cba   imitation learning of others, in files of their own

Each subgoal becomes the nearest outcome that was reached, and what reached the two is executed, one after the other.

All functions are of one learner and make a generation of G sequences. docs/saht.md says where the numbers come from.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from envs.common.batching import where
from star.saht import cba, dagger, inverse
from star.saht.choose import drawn
from star.saht.memory import FAR, NEIGHBOURS, Memory, Neighbours, Piece, least, neighbours, rank, squared
from star.saht.proposals import Dice, Order, Proposals, Setting, anywhere, plain

ASKED = ("action", "outcome", "procedure")
"""Kinds of strategies that are teachers."""
CERTAIN = 0.3  # distance of the best known outcome from which on a learner explores most
LOCAL = (0.1, 0.9)  # least and largest chance of staying near what is known
BY_MODEL, BY_REGRESSION = 0.5, 0.7  # chance of a regression rather than the best neighbour: of actions, of procedures
NOISE, NOISE_MORE, NOISE_MOST = 0.01, 0.5, 0.3  # standard deviation: at distance 0, what a distance of 1 adds, at most
VARIED = 0.5  # chance of each number of a sequence to get noise
RETRY = 0.05  # standard deviation of what is added to what a teacher has shown


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
        made["random"] = plain(anywhere(setting, dice))
    if kinds & {"actions", "outcome"}:
        aimed = plain(actions(setting, memory, rows, *aim(setting, order), dice))
        made |= {kind: aimed for kind in ("actions", "outcome") if kind in kinds}
    if "action" in kinds:
        made["action"] = plain(mimicked(setting, order, dice))
    two: dict[str, Two] = {}
    if "procedures" in kinds:
        two["procedures"] = composed(setting, memory, rows, order, dice)
    if "procedure" in kinds:
        two["procedure"] = taught(setting, order, dice)
    if two:
        made |= dict.fromkeys(two, refine(setting, memory, rows, _of_kind(setting, order, two), dice))
    if "dagger" in kinds:
        made["dagger"] = dagger.propose(setting, memory, rows, order, dice)
    if "cba" in kinds:
        made["cba"] = cba.propose(setting, memory, rows, order, dice, key=key)
    chosen = _of_kind(setting, order, made)
    played = jnp.arange(setting.world.longest) < chosen.lengths[:, None]
    return chosen.replace(
        sequences=jnp.where(played[..., None], jnp.clip(chosen.sequences, -1.0, 1.0), 0.0),
        asked=chosen.asked | jnp.array([way.kind in ASKED for way in setting.ways])[order.way],
    )


def _of_kind(setting: Setting, order: Order, made: Mapping[str, Any]) -> Any:
    """That of the strategy's kind; the last one if there is none."""
    (*others, (_, chosen)) = made.items()
    for kind, one in others:
        mine = jnp.array([way.kind == kind for way in setting.ways])[order.way]
        chosen = where(mine, one, chosen)
    return chosen


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
    """The subgoals that the teacher names for the goal, or for any one of his task if the goal is of another.

    One from a file names those of the procedure whose outcome is nearest.
    """
    task = setting.of_way(order.way, "task")
    goal = jnp.where(task == order.task, order.goal, setting.scale.unit(task, dice.once[4:]))
    named: Two | None = None
    asked = [way for way in setting.ways if way.kind == "procedure"]
    for known in {way.task: None for way in asked if not way.recorded}:
        parts = setting.world.decompose(known, setting.scale.value(known, goal))
        lower, width = (jnp.asarray(one)[parts.tasks] for one in (setting.scale.lower, setting.scale.width))
        one = Two(parts.tasks, (parts.goals - lower) / width)
        named = one if named is None else where(task == known, one, named)
    if any(way.recorded for way in asked):
        teacher, nearest = setting.of_way(order.way, "teacher"), _nearest(setting, order._replace(goal=goal))
        one = Two(setting.shown.pairs[teacher, nearest], setting.shown.subgoals[teacher, nearest])
        named = one if named is None else where(setting.of_way(order.way, "recorded"), one, named)
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
        asked=jnp.zeros(setting.generation, bool),
    )
