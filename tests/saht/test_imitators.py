"""DAgger and confidence-based autonomy, in a world whose outcome is twice the primitive, and whose teacher knows it."""

import dataclasses
from functools import cache
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import worlds
from star.saht import cba, dagger, imitators, loop, memory, proposals, teachers
from star.saht.memory import FAR, scale_of
from star.saht.proposals import Dice, Order, Setting
from star.saht.teachers import SKILFUL

G = 6


def twice(sequence, length):
    return worlds.outcomes((2 * sequence[0], True), (sequence[0, :1], True)), sequence


def goals():
    return np.random.default_rng(0).uniform(-1, 1, (60, 2))


TASKS = (
    worlds.Task("twice", (-1.0, -1.0), (1.0, 1.0), goals, demonstrate=lambda goal: goal[None, :2] / 2),
    worlds.Task("once", (-1.0,), (1.0,), goals, demonstrate=lambda goal: goal[None, :1] * jnp.ones(2)),
)
WORLD = worlds.World("twice", 2, 1, TASKS, twice)
SCALE = scale_of(WORLD)
SETTING = Setting(WORLD, SCALE, (), None, G)
DICE = jax.jit(lambda: Dice.thrown(WORLD, G, key=jax.random.key(3)))()
ORDER = Order(jnp.int32(0), jnp.array([0.5, 0.2, 0.0, 0.0]), jnp.int32(0), jnp.asarray(True))


@jax.jit
def daggers(mind, rows):
    return dagger.propose(SETTING, mind, rows, ORDER, DICE)


@jax.jit
def cbas(mind, rows, order):
    return cba.propose(SETTING, mind, rows, order, DICE, key=jax.random.key(0))


@jax.jit
def aims(order):
    return imitators.goals(SETTING, order, DICE)


@cache
def done():
    """A thousand random movements and what came of them."""
    sequences = np.random.default_rng(1).uniform(-0.5, 0.5, (1000, 1, 2)).astype(np.float32)

    @jax.jit
    def remembered():
        made = proposals.plain((jnp.asarray(sequences), jnp.ones(1000, jnp.int32)))
        found, _ = loop.execute(SimpleNamespace(world=WORLD, scale=SCALE), made, key=jax.random.key(0))
        return memory.write(memory.empty(WORLD, 1000), jnp.int32(0), found)

    return jax.device_get(remembered())


def known(n, *, twist=0.0):
    """A memory of the first n of them, each said to have led farther by `twist`."""
    outcomes = np.array(done().outcomes)
    outcomes[..., n:] = FAR
    outcomes[0, :2, :n] += twist
    return done().replace(outcomes=outcomes)


def reached(sequences, wanted):
    """How far each is from its goal, scaled."""
    found = SCALE.scaled(WORLD.execute(sequences, 1).value)[:, 0]
    return np.linalg.norm(found - wanted, axis=1)


def test_at_first_dagger_has_the_teacher_act_then_the_learner_and_he_shows_every_goal_that_it_tried():
    first = jax.device_get(daggers(memory.empty(WORLD, 50), 0))
    assert first.asked.all() and (first.lengths == 1).all()
    np.testing.assert_array_equal(first.sequences[::2], first.sequences[1::2])
    np.testing.assert_allclose(reached(first.sequences[:1], ORDER.goal[None]), 0, atol=1e-6)
    later = jax.device_get(daggers(known(50), 50))
    assert later.asked.tolist() == [False, True] * 3
    np.testing.assert_allclose(later.sequences[1::2], first.sequences[1::2], atol=1e-6)
    apart = np.linalg.norm(later.sequences[::2] - later.sequences[1::2], axis=(1, 2))
    assert (apart > 0).any() and apart.max() < 0.1  # it has learnt


def test_who_knows_nothing_asks_about_every_goal_of_any_task():
    nothing = memory.empty(WORLD, 50)
    for task in (0, 1):
        order = ORDER._replace(task=jnp.int32(task), goal=ORDER.goal * jnp.asarray(SCALE.used)[task])
        made = jax.device_get(cbas(nothing, 0, order))
        assert made.asked.all()
        found = SCALE.scaled(WORLD.execute(made.sequences, 1).value)[:, task]
        np.testing.assert_allclose(found, aims(order), atol=1e-6)


def test_who_is_confident_and_right_acts_alone():
    made = jax.device_get(cbas(known(1000), 1000, ORDER))
    wanted = aims(ORDER)
    own = ~np.asarray(made.asked)
    assert own.sum() >= G - 1 and reached(made.sequences, wanted)[own].max() < SKILFUL


def test_a_mistake_is_corrected_in_the_next_iteration():
    wrong = known(1000, twist=0.3)
    order = ORDER._replace(goal=jnp.array([0.6, 0.6, 0.0, 0.0]))
    made = jax.device_get(cbas(wrong, 1000, order))
    assert made.asked[:2].tolist() == [False, True]
    error = reached(made.sequences[:2], np.stack([order.goal] * 2))
    assert error[0] > SKILFUL and error[1] < 1e-6


@jax.jit
def confidence(mind, n, goal):
    return cba.confident(mind, memory.neighbours(mind, n, 0, goal, k=10), jnp.int32(2))


@pytest.mark.parametrize("n", [1, 3, 12, 200])
def test_confidence_agrees_with_a_slow_computation(n):
    mind = known(n)
    outcomes, sequences = np.asarray(mind.outcomes[0].T[:n, :2]), np.asarray(mind.sequences[:n, 0])
    answers = []
    for goal in np.random.default_rng(2).uniform(0, SCALE.top[0, 0] * 1.3, (30, 2)):
        order = np.argsort(np.linalg.norm(outcomes - goal, axis=1))[:10]
        gaps = [min((np.linalg.norm(outcomes[i] - outcomes[j]) for j in order if j != i), default=FAR) for i in order]
        usual = np.mean(gaps) if len(order) > 1 else 0.0
        alike = [np.sqrt(np.mean((sequences[i] - sequences[order[0]]) ** 2)) <= 0.5 for i in order]
        near = np.linalg.norm(outcomes[order[0]] - goal) <= 3 * usual
        answers.append(
            (bool(confidence(mind, n, np.array([*goal, 0.0, 0.0], np.float32))), bool(near and sum(alike) > 2))
        )
    assert [mine for mine, _ in answers] == [slow for _, slow in answers]
    if n == 200:
        assert len({mine for mine, _ in answers}) == 2


def test_a_teacher_shows_what_he_can_where_most_goals_are_out_of_reach():
    far = dataclasses.replace(TASKS[0], lower=(-40.0, -40.0), upper=(40.0, 40.0))
    world = dataclasses.replace(WORLD, tasks=(far,), simulate=lambda s, n: (worlds.outcomes((2 * s[0], True)), s))
    demos = teachers.demonstrated(world, [0], 5, scale_of(world))[0]  # of 320 goals one is within 2
    assert len(demos.lengths) == 5 and np.abs(demos.outcomes).max() <= 2
    np.testing.assert_allclose(demos.outcomes[:, :2], 2 * demos.sequences[:, 0], atol=1e-6)


def test_what_a_teacher_shows_does_not_depend_on_who_else_is_asked():
    scale = scale_of(WORLD)
    together = teachers.demonstrated(WORLD, [0, 1], 5, scale)
    for task, demos in together.items():
        (alone,) = teachers.demonstrated(WORLD, [task], 5, scale).values()
        jax.tree.map(np.testing.assert_array_equal, demos, alone)
    assert not np.array_equal(together[0].sequences, together[1].sequences)


def test_a_world_in_which_nobody_shows_a_task_has_no_such_learners():
    silent = dataclasses.replace(WORLD, tasks=(TASKS[0], dataclasses.replace(TASKS[1], demonstrate=None)))
    with pytest.raises(worlds.world.EnvError, match="nobody demonstrates once in twice"):
        imitators.shown(SETTING._replace(world=silent), jnp.int32(0), jnp.zeros((G, 4)))
