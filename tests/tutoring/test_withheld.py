"""The withheld-skill test, beside textbook formulas in plain Python."""

from itertools import pairwise

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import random
from scipy import stats

from envs.common.errors import UserError
from star.config.loading import parse
from star.tutoring import experiment, students, withheld
from star.tutoring.tracing import Scores
from tests.tutoring import slow

N = 3
SKILLS = 6
chances = st.lists(
    st.sampled_from([0.0, 1e-6, 0.004, 0.01, 0.02, 0.03, 0.05, 0.4, 1.0]), min_size=N * N, max_size=N * N
)


def matrix(values):
    p = np.array(values).reshape(N, N)
    np.fill_diagonal(p, 1.0)
    return p


@given(chances, st.sampled_from([0.01, 0.05, 0.2]))
def test_pairs_are_those_of_the_step_up_of_benjamini_and_hochberg(values, rate):
    p = matrix(values)
    taken = slow.step_up([p[i, j] for i in range(N) for j in range(N) if i != j], rate)
    found = withheld.significant(p, rate)
    assert [found[i, j] for i in range(N) for j in range(N) if i != j] == taken
    assert not found.diagonal().any()


@given(chances, st.integers(0, N * N - 1), st.sampled_from([(0.01, 0.05), (0.05, 0.2)]))
def test_a_smaller_p_or_a_higher_rate_never_loses_a_pair(values, place, rates):
    p = matrix(values)
    smaller = p.copy()
    smaller.flat[place] = min(p.flat[place], 0.001)
    found = withheld.significant(p, rates[0])
    assert not (found & ~withheld.significant(smaller, rates[0])).any()
    assert not (found & ~withheld.significant(p, rates[1])).any()
    in_order = [found[i, j] for _, i, j in sorted((p[i, j], i, j) for i in range(N) for j in range(N) if i != j)]
    assert all(first or not second for first, second in pairwise(in_order))


def chain(seed, *, number=180, length=60, effect=True):
    """Scores of students of six skills: without skill 0 nobody learns skill 1; the others stand apart.

    The last exercise needs skills 1 and 2: who lacks skill 0 fails in it, though nothing is wrong with skill 2.
    """
    rng = np.random.default_rng(seed)
    needs = np.vstack([np.eye(SKILLS, dtype=bool), np.isin(np.arange(SKILLS), (1, 2))])
    lot = rng.permutation(np.arange(number) % SKILLS)
    student = np.repeat(np.arange(number), length)
    exercise = np.concatenate([rng.choice(np.flatnonzero(~needs[:, skill]), length) for skill in lot])
    fails = effect & (lot[student] == 0) & needs[exercise, 1]
    right = rng.random(number * length) < np.where(fails, 0.2, 0.6 + 0.2 * rng.random(number)[student])
    return needs, Scores(student=student, exercise=exercise, right=right), lot


def test_a_prerequisite_is_found_and_a_skill_is_not_blamed_for_another():
    found = withheld.discover(*chain(0))
    assert np.argwhere(found.parents).tolist() == np.argwhere(found.pairs).tolist() == [[1, 0]]
    assert 0.3 < found.drop[1, 0] < 0.7 and abs(found.drop[2, 0]) < 0.1
    assert not found.drop.diagonal().any() and (found.p.diagonal() == 1).all()


def test_drops_and_p_are_those_of_plain_python():
    needs, scores, lot = chain(1, number=36, length=13)
    mixed = np.random.default_rng(0).permutation(36)[scores.student]  # students need not stand in the order of numbers
    lot_mixed = np.empty_like(lot)
    lot_mixed[mixed] = lot[scores.student]
    rows = list(
        zip(mixed.tolist(), np.asarray(scores.exercise).tolist(), np.asarray(scores.right).tolist(), strict=True)
    )
    success = slow.successes(needs, rows, 36)
    found = withheld.discover(needs, scores.replace(student=mixed), lot_mixed)
    for i in range(3):
        for j in range(SKILLS):
            if i == j:
                continue
            own = [s[i] for s, skill in zip(success, lot_mixed, strict=True) if i in s and skill == j]
            other = [s[i] for s, skill in zip(success, lot_mixed, strict=True) if i in s and skill != j]
            drop, t, freedom = slow.welch(own, other)
            assert found.drop[i, j] == pytest.approx(drop, abs=1e-9)
            assert found.p[i, j] == pytest.approx(stats.t.sf(t, freedom), abs=1e-9)


def test_where_nothing_depends_on_the_skill_withheld_p_is_spread_evenly():
    p = np.concatenate(
        [withheld.discover(*chain(seed, effect=False)).p[~np.eye(SKILLS, dtype=bool)] for seed in range(20)]
    )
    shares = [(p <= level).mean() for level in (0.05, 0.25, 0.5, 0.75)]
    assert shares == pytest.approx([0.05, 0.25, 0.5, 0.75], abs=0.06)


def test_where_a_skill_is_withheld_from_one_student_alone_nothing_is_found():
    found = withheld.discover(*chain(2, number=SKILLS))
    assert (found.p == 1).all() and not (found.drop.any() or found.pairs.any() or found.parents.any())


def test_a_student_who_practised_the_skill_withheld_is_told_of():
    needs, scores, lot = chain(3, number=12)
    first = scores.replace(exercise=np.where(np.arange(len(scores.right)) == 0, lot[0], scores.exercise))
    with pytest.raises(UserError, match=rf"^withheld: student 0 practised skill {lot[0]}; allowed: a skill never "):
        withheld.discover(needs, first, lot)


def test_simulated_students_do_without_the_skill_that_was_drawn_for_them(monkeypatch):
    monkeypatch.setattr(
        experiment, "_practise", lambda hyper, course, students, exercises, key: (students, exercises > 0)
    )
    hyper = parse(
        {
            "experiment": "tutoring",
            "course": {"skills": 4, "exercises": 8, "needs": 4},
            "discovery": {"students": 12, "exercises": 20},
        }
    )

    @jax.jit
    def drawn(key):
        course = students.draw_course(hyper.course, key=key)
        return course, experiment.withheld_scores(hyper, course, key=random.fold_in(key, 1))

    course, (lot, scores) = jax.device_get(drawn(random.key(0)))
    assert np.bincount(lot).tolist() == [3, 3, 3, 3] and lot.tolist() != (np.arange(12) % 4).tolist()
    needed = np.asarray(course.needs)[scores.exercise]
    assert scores.student.tolist() == np.repeat(np.arange(12), 20).tolist()
    assert not needed[np.arange(240), np.asarray(lot)[scores.student]].any()
    assert needed.any(axis=0).all()
