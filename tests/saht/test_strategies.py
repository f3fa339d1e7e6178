"""What strategies make of a goal, in a world where one can see what comes of it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs import worlds
from star.saht import loop, memory, strategies, teachers
from star.saht.memory import FAR, scale_of
from star.saht.sections import TeacherConfig
from star.saht.strategies import Dice, Order, Setting, Way, propose

PEN = worlds.make("pen")
SCALE = scale_of(PEN)
TIP, LINE, STICK_1, STICK_2, CHARACTER = 0, 2, 3, 4, 5
G = 10


def setting(*kinds, tasks=(CHARACTER,)):
    """The strategies alone among `kinds`, and teachers of the other kinds for each of the tasks."""
    alone = [Way(kind, kind) for kind in kinds if kind in ("random", "actions", "procedures")]
    asked = [(kind, task) for kind in kinds for task in tasks if kind not in ("random", "actions", "procedures")]
    configs = [TeacherConfig(kind=kind, task=PEN.names[task], name=f"{kind}_{task}", demos=4) for kind, task in asked]
    ways = [*alone, *(Way(f"{kind}_{task}", kind, task, i) for i, (kind, task) in enumerate(asked))]
    return Setting(PEN, SCALE, tuple(ways), teachers.shown_by(configs, PEN, SCALE), G)


def order(task, goal, way=0, first=True):
    scaled = (jnp.asarray(goal) - SCALE.lower[task]) / SCALE.width[task]
    return Order(jnp.asarray(task), scaled.astype(jnp.float32), jnp.asarray(way), jnp.asarray(first))


@pytest.fixture(scope="module")
def skilled():
    """A memory with what the teacher of the tip and of each joystick does for 60 goals each."""
    known, row = memory.empty(PEN, 200), 0
    for task in (TIP, STICK_1, STICK_2):
        sequences, lengths = PEN.demonstrate(task, PEN.benchmark(task)[:60])
        plain = strategies._plain((sequences, lengths))
        found, _ = loop.execute(SimpleNamespace(world=PEN, scale=SCALE), plain, key=jax.random.key(0))
        known, row = memory.write(known, jnp.int32(row), found), row + 60
    return known, row


def executed(made):
    return PEN.execute(made.sequences, made.lengths)


def test_random_sequences_are_anywhere_and_each_primitive_more_is_half_as_likely():
    dice = Dice.thrown(PEN, 4000, key=jax.random.key(0))
    sequences, lengths = strategies.anywhere(Setting(PEN, SCALE, (), None, 4000), dice)
    counts = np.bincount(np.asarray(lengths), minlength=5)[1:] / 4000
    np.testing.assert_allclose(counts, np.array([8, 4, 2, 1]) / 15, atol=0.03)
    assert jnp.abs(sequences.mean()) < 0.01 and sequences.min() < -0.99 and sequences.max() > 0.99


def test_alone_a_learner_stays_near_what_is_known_the_more_the_nearer_it_is(skilled):
    known, rows = skilled
    goal = PEN.benchmark(TIP)[3]  # which is in memory
    made = propose(setting("actions"), known, rows, order(TIP, goal), key=jax.random.key(1))
    near = jnp.linalg.norm(executed(made).value[:, TIP] - goal, axis=-1) < 0.2
    assert near.sum() >= 7 and (made.pair == -1).all()  # nine of ten stay near, with little noise
    nothing = memory.empty(PEN, 200)
    far = propose(setting("actions"), nothing, 0, order(TIP, goal), key=jax.random.key(1))
    assert (jnp.linalg.norm(executed(far).value[:, TIP] - goal, axis=-1) < 0.2).sum() <= 2


def test_a_teacher_of_actions_is_repeated_exactly_at_first_and_then_with_noise():
    chosen = setting("action")
    goal = PEN.benchmark(CHARACTER)[0]
    made = propose(chosen, memory.empty(PEN, 10), 0, order(CHARACTER, goal), key=jax.random.key(0))
    shown, outcomes = chosen.shown.sequences[0], chosen.shown.outcomes[0]
    nearest = jnp.argmin(jnp.linalg.norm(outcomes - order(CHARACTER, goal).goal, axis=-1))
    assert jnp.array_equal(made.sequences[0], shown[nearest])
    varied = made.sequences[1:] - shown[nearest]
    assert 0.03 < varied.std() < 0.06 and (made.lengths == 4).all()
    later = propose(chosen, memory.empty(PEN, 10), 0, order(CHARACTER, goal, first=False), key=jax.random.key(0))
    assert not jnp.array_equal(later.sequences[0], shown[nearest])


def test_a_teacher_of_another_task_shows_any_of_his():
    chosen = setting("action", tasks=(LINE,))
    first = [
        propose(chosen, memory.empty(PEN, 10), 0, order(TIP, jnp.zeros(4)), key=jax.random.key(seed)).sequences[0]
        for seed in range(12)
    ]
    which = {int(jnp.argmin(jnp.abs(chosen.shown.sequences[0] - one).sum((1, 2)))) for one in first}
    assert len(which) >= 3


def test_a_teacher_of_outcomes_makes_his_outcome_the_goal(skilled):
    known, rows = skilled
    chosen = setting("outcome", tasks=(STICK_1,))
    task, goal = strategies.aim(chosen, order(STICK_1, PEN.benchmark(STICK_1)[0]))
    assert task == STICK_1 and (jnp.linalg.norm(chosen.shown.outcomes[0] - goal, axis=-1) == 0).any()
    made = propose(chosen, known, rows, order(TIP, jnp.zeros(4)), key=jax.random.key(0))
    assert executed(made).reached[:, STICK_1].mean() > 0.4  # though the task is another


def test_a_teacher_of_procedures_names_two_goals_and_what_reached_the_nearest_is_executed(skilled):
    known, rows = skilled
    goal = PEN.benchmark(CHARACTER)[7]
    made = propose(setting("procedure"), known, rows, order(CHARACTER, goal), key=jax.random.key(0))
    assert (made.pair == STICK_1 * 6 + STICK_2).all() and (made.lengths == 4).all()
    found = executed(made)
    assert found.reached[:, CHARACTER].all()
    x = made.subgoals[0, 0] * SCALE.width[STICK_1] + SCALE.lower[STICK_1]
    y = made.subgoals[0, 1] * SCALE.width[STICK_2] + SCALE.lower[STICK_2]
    np.testing.assert_allclose(found.value[0, CHARACTER, :2], [x[0], y[1]], atol=1e-4)


def test_alone_a_learner_makes_procedures_of_any_two_tasks_that_were_reached(skilled):
    known, rows = skilled
    pairs = set()
    for seed in range(20):
        made = propose(setting("procedures"), known, rows, order(CHARACTER, jnp.zeros(4)), key=jax.random.key(seed))
        pairs |= {divmod(int(pair), 6) for pair in made.pair if pair >= 0}
        there = (made.pair < 0) | (jnp.abs(made.subgoals[..., 0]) < FAR / 2).all(axis=1)
        assert there.all()
    assert len(pairs) >= 5 and {task for pair in pairs for task in pair} == {TIP, STICK_1, STICK_2, CHARACTER}


def test_procedures_that_reached_a_goal_are_made_again_for_goals_near_it(skilled):
    known, rows = skilled
    chosen = setting("procedures", "procedure")
    for number in range(8):
        taught = propose(
            chosen, known, rows, order(CHARACTER, PEN.benchmark(CHARACTER)[number], way=1), key=jax.random.key(0)
        )
        found, _ = loop.execute(chosen, taught, key=jax.random.key(0))
        known, rows = memory.write(known, jnp.int32(rows), found), rows + G
    goal, mine = PEN.benchmark(CHARACTER)[3], STICK_1 * 6 + STICK_2
    made = [propose(chosen, known, rows, order(CHARACTER, goal), key=jax.random.key(seed)) for seed in range(10)]
    local = [one for one in made if (one.pair == mine).all()]
    assert len(local) >= 6
    error = [jnp.linalg.norm(executed(one).value[:, CHARACTER] - goal, axis=-1).min() for one in local]
    assert np.median(error) < 0.25


def test_what_does_not_fit_into_a_sequence_is_not_made(skilled):
    """Two sequences of the character's, of four primitives each, make none: then anything is tried."""
    known, rows = skilled
    sequences, lengths = PEN.demonstrate(CHARACTER, PEN.benchmark(CHARACTER)[:60])
    nothing = memory.empty(PEN, 200)
    chosen = setting("procedures")
    found, _ = loop.execute(chosen, strategies._plain((sequences, lengths)), key=jax.random.key(0))
    full = memory.write(nothing, jnp.int32(0), found)
    made = propose(chosen, full, 60, order(CHARACTER, jnp.zeros(4)), key=jax.random.key(0))
    assert (made.pair == -1).all() and (made.lengths < 4).any()


def test_learners_with_different_strategies_do_what_each_would_alone(skilled):
    known, rows = skilled
    chosen = setting("random", "actions", "procedures", "action", "outcome", "procedure")
    goal = PEN.benchmark(CHARACTER)[1]
    for way, one in enumerate(chosen.ways):
        alone = setting(one.kind)
        mine = propose(chosen, known, rows, order(CHARACTER, goal, way), key=jax.random.key(5))
        same = propose(alone, known, rows, order(CHARACTER, goal), key=jax.random.key(5))
        np.testing.assert_allclose(mine.sequences, same.sequences, atol=1e-5, err_msg=one.kind)
        assert mine.lengths.tolist() == same.lengths.tolist()
