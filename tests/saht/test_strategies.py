"""What strategies make of a goal, in a world where one can see what comes of it."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from envs import worlds
from star.saht import loop, memory, proposals, strategies, teachers
from star.saht.memory import FAR, scale_of
from star.saht.proposals import Dice, Order, Setting, Way
from star.saht.sections import TeacherConfig

PEN = worlds.make("pen")
SCALE = scale_of(PEN)
TIP, LINE, STICK_1, STICK_2, CHARACTER = 0, 2, 3, 4, 5
G = 10


TEACHERS = (("action", CHARACTER), ("procedure", CHARACTER), ("action", LINE), ("outcome", STICK_1))
ALONE = ("random", "actions", "procedures")
RANDOM, ACTIONS, PROCEDURES, MIMIC, DECOMPOSE, ANOTHER, EMULATE = range(7)


@pytest.fixture(scope="module")
def chosen():
    """All kinds of strategies at once: what one of them does must not depend on the others."""
    configs = [
        TeacherConfig(kind=kind, task=PEN.names[task], name=f"{kind}_{task}", demos=4) for kind, task in TEACHERS
    ]
    asked = [Way(f"{kind}_{task}", kind, task, i) for i, (kind, task) in enumerate(TEACHERS)]
    ways = (*(Way(kind, kind) for kind in ALONE), *asked)
    return Setting(PEN, SCALE, ways, teachers.shown_by(configs, PEN, SCALE), G)


@pytest.fixture(scope="module")
def propose(chosen):
    made = jax.jit(lambda known, rows, order, key: strategies.propose(chosen, known, rows, order, key=key))
    return lambda *args: jax.device_get(made(*args))


def order(task, goal, way, first=True):
    scaled = (np.asarray(goal) - SCALE.lower[task]) / SCALE.width[task]
    return Order(np.int32(task), scaled.astype(np.float32), np.int32(way), np.asarray(first))


@jax.jit
def carried_out(made):
    """What comes of sequences, to be remembered."""
    return loop.execute(SimpleNamespace(world=PEN, scale=SCALE), made, key=jax.random.key(0))[0]


write = jax.jit(memory.write)


@pytest.fixture(scope="module")
def skilled():
    """A memory with what the teacher of the tip and of each joystick does for 60 goals each."""
    known, row = memory.empty(PEN, 200), 0
    for task in (TIP, STICK_1, STICK_2):
        sequences, lengths = PEN.demonstrate(task, PEN.benchmark(task)[:60])
        plain = jax.jit(proposals.plain)((sequences, lengths))
        known, row = write(known, np.int32(row), carried_out(plain)), row + 60
    return known, row


def executed(made):
    return jax.device_get(PEN.execute(made.sequences, made.lengths))


def test_random_sequences_are_anywhere_and_each_primitive_more_is_half_as_likely():
    setting = Setting(PEN, SCALE, (), None, 4000)
    sequences, lengths = jax.device_get(
        jax.jit(lambda key: strategies.anywhere(setting, Dice.thrown(PEN, 4000, key=key)))(jax.random.key(0))
    )
    counts = np.bincount(np.asarray(lengths), minlength=5)[1:] / 4000
    np.testing.assert_allclose(counts, np.array([8, 4, 2, 1]) / 15, atol=0.03)
    assert abs(sequences.mean()) < 0.01 and sequences.min() < -0.99 and sequences.max() > 0.99


def test_alone_a_learner_stays_near_what_is_known_the_more_the_nearer_it_is(skilled, propose):
    known, rows = skilled
    goal = PEN.benchmark(TIP)[3]  # which is in memory
    made = propose(known, rows, order(TIP, goal, ACTIONS), jax.random.key(1))
    near = np.linalg.norm(executed(made).value[:, TIP] - goal, axis=-1) < 0.2
    assert near.sum() >= 7 and (made.pair == -1).all()  # nine of ten stay near, with little noise
    far = propose(memory.empty(PEN, 200), 0, order(TIP, goal, ACTIONS), jax.random.key(1))
    assert (np.linalg.norm(executed(far).value[:, TIP] - goal, axis=-1) < 0.2).sum() <= 2


def test_a_teacher_of_actions_is_repeated_exactly_at_first_and_then_with_noise(skilled, chosen, propose):
    asked = order(CHARACTER, PEN.benchmark(CHARACTER)[0], MIMIC)
    made = propose(*skilled, asked, jax.random.key(0))
    shown = np.asarray(chosen.shown.sequences)[0]
    nearest = np.argmin(np.linalg.norm(np.asarray(chosen.shown.outcomes)[0] - asked.goal, axis=-1))
    assert np.array_equal(made.sequences[0], shown[nearest])
    varied = made.sequences[1:] - shown[nearest]
    assert 0.03 < varied.std() < 0.06 and (made.lengths == 4).all()
    later = propose(*skilled, asked._replace(first=np.asarray(False)), jax.random.key(0))
    assert not np.array_equal(later.sequences[0], shown[nearest])


def test_a_teacher_of_another_task_shows_any_of_his(skilled, chosen, propose):
    asked = order(TIP, np.zeros(4), ANOTHER)
    first = [propose(*skilled, asked, jax.random.key(seed)).sequences[0] for seed in range(12)]
    shown = np.asarray(chosen.shown.sequences)[2]
    which = [int(np.abs(shown - one).sum((1, 2)).argmin()) for one in first]
    assert len(set(which)) >= 3
    np.testing.assert_allclose(first, shown[which], atol=1e-6)


def test_a_teacher_of_outcomes_makes_his_outcome_the_goal(skilled, chosen, propose):
    aim = jax.jit(lambda order: strategies.aim(chosen, order))
    task, goal = jax.device_get(aim(order(STICK_1, PEN.benchmark(STICK_1)[0], EMULATE)))
    assert task == STICK_1 and (np.linalg.norm(np.asarray(chosen.shown.outcomes)[3] - goal, axis=-1) == 0).any()
    task, goal = aim(order(TIP, np.zeros(4), ACTIONS))
    assert task == TIP and np.array_equal(goal, order(TIP, np.zeros(4), ACTIONS).goal)
    made = propose(*skilled, order(TIP, np.zeros(4), EMULATE), jax.random.key(0))
    assert executed(made).reached[:, STICK_1].mean() > 0.4  # though the task is another


def test_a_teacher_of_procedures_names_two_goals_and_what_reached_the_nearest_is_executed(skilled, propose):
    made = propose(*skilled, order(CHARACTER, PEN.benchmark(CHARACTER)[7], DECOMPOSE), jax.random.key(0))
    assert (made.pair == STICK_1 * 6 + STICK_2).all() and (made.lengths == 4).all()
    found = executed(made)
    assert found.reached[:, CHARACTER].all()
    x = made.subgoals[0, 0] * SCALE.width[STICK_1] + SCALE.lower[STICK_1]
    y = made.subgoals[0, 1] * SCALE.width[STICK_2] + SCALE.lower[STICK_2]
    np.testing.assert_allclose(found.value[0, CHARACTER, :2], [x[0], y[1]], atol=1e-4)


def test_alone_a_learner_makes_procedures_of_any_two_tasks_that_were_reached(skilled, propose):
    pairs = set()
    for seed in range(20):
        made = propose(*skilled, order(CHARACTER, np.zeros(4), PROCEDURES), jax.random.key(seed))
        pairs |= {divmod(int(pair), 6) for pair in made.pair if pair >= 0}
        assert ((made.pair < 0) | (np.abs(made.subgoals[..., 0]) < FAR / 2).all(axis=1)).all()
    assert len(pairs) >= 5 and {task for pair in pairs for task in pair} == {TIP, STICK_1, STICK_2, CHARACTER}


def test_procedures_that_reached_a_goal_are_made_again_for_goals_near_it(skilled, propose):
    known, rows = skilled
    goals = PEN.benchmark(CHARACTER)
    for number in range(8):
        taught = propose(known, rows, order(CHARACTER, goals[number], DECOMPOSE), jax.random.key(0))
        known, rows = write(known, np.int32(rows), carried_out(taught)), rows + G
    asked, mine = order(CHARACTER, goals[3], PROCEDURES), STICK_1 * 6 + STICK_2
    made = [propose(known, rows, asked, jax.random.key(seed)) for seed in range(10)]
    local = [one for one in made if (one.pair == mine).all()]
    assert len(local) >= 6
    error = [np.linalg.norm(executed(one).value[:, CHARACTER] - goals[3], axis=-1).min() for one in local]
    assert np.median(error) < 0.25


def test_what_does_not_fit_into_a_sequence_is_not_made(propose):
    """Two sequences of the character's, of four primitives each, make none: then anything is tried."""
    taught = jax.jit(proposals.plain)(PEN.demonstrate(CHARACTER, PEN.benchmark(CHARACTER)[:60]))
    full = write(memory.empty(PEN, 200), np.int32(0), carried_out(taught))
    made = propose(full, 60, order(CHARACTER, np.zeros(4), PROCEDURES), jax.random.key(0))
    assert (made.pair == -1).all() and (made.lengths < 4).any()
