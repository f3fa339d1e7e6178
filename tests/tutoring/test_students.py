"""Courses and simulated students."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import random

from star.tutoring import students
from star.tutoring.sections import CourseConfig, StudentsConfig
from tests.tutoring import slow

SIZE = CourseConfig(skills=5, exercises=8, needs=9)
course_of = jax.jit(lambda key: students.draw_course(SIZE, key=key))
student_of = jax.jit(lambda key: students.draw_student(SIZE, key=key))
practise = jax.jit(
    lambda course, student, exercise, key: students.practise(StudentsConfig(), course, student, exercise, key=key)
)


@given(st.integers(0, 2**31 - 1))
def test_every_skill_has_an_exercise_and_none_needs_a_skill_with_its_own_ancestor(seed):
    course = course_of(random.key(seed))
    needs, above = np.asarray(course.needs), slow.reachable(np.asarray(course.parents))
    assert needs.any(axis=0).all() and needs.any(axis=1).all()
    for needed in needs:
        assert not above[np.ix_(needed, needed)].any()
    free = [
        (e, k) for e, k in np.argwhere(~needs) if not (above[k] & needs[e]).any() and not (above[:, k] & needs[e]).any()
    ]
    assert needs.sum() == SIZE.exercises + SIZE.needs or not free  # all needs are dealt out, as long as one fits


@given(st.integers(0, 2**31 - 1), st.integers(0, SIZE.exercises - 1))
def test_practice_moves_levels_as_the_equations_say(seed, exercise):
    keys = random.split(random.key(seed), 3)
    course, student = course_of(keys[0]), student_of(keys[1])
    student = student.replace(level=student.level + 700 * (np.arange(SIZE.skills) % 2))
    after, _ = practise(course, student, exercise, keys[2])
    known = [np.asarray(x, float) for x in (student.level, student.lasting, student.speed, course.difficulty[exercise])]
    needed = np.flatnonzero(course.needs[exercise]).tolist()
    both = [slow.practised(np.asarray(course.parents), needed, *known, right) for right in (False, True)]
    levels = np.asarray(after.level), np.asarray(after.lasting)
    assert any(np.allclose(levels, expected, rtol=1e-4) for expected in both)
    assert (levels[1] >= known[1] - 1e-3).all() and (levels[0] <= students.HIGHEST).all()


def test_scores_are_right_as_often_as_chance_guess_and_slip_say():
    course, student = course_of(random.key(1)), student_of(random.key(2))
    for exercise in (0, 5):
        needed = np.flatnonzero(course.needs[exercise]).tolist()
        p = slow.chance(np.asarray(course.parents), needed, student.level, course.difficulty[exercise])
        keys = random.split(random.key(3), 4000)
        right = jax.vmap(lambda key, e=exercise: practise(course, student, e, key)[1])(keys)
        assert float(right.mean()) == pytest.approx(0.2 + 0.7 * p, abs=0.03)
