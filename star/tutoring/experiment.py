"""Tutoring as an experiment: each seed is a course of its own, whose students are taught side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import random
from jaxtyping import Array, Bool, Float, Int

from star.training.experiment import Experiment, numbers, over_seeds
from star.training.journal import mean
from star.tutoring import graphs, tracing, tutors
from star.tutoring import students as pupils
from star.tutoring.sections import Config
from star.tutoring.students import MASTERED, Course, Student
from star.tutoring.tracing import Found, Scores
from star.tutoring.tutors import Plan, Seen


class State(struct.PyTreeNode):
    """A course, its students, and what the tutor knows of them."""

    course: Course
    plan: Plan
    found: Found
    """The graph found from scores; without edges, if the tutor was told or has none."""
    students: Student
    """[P]"""
    seen: Seen
    """[P]"""
    practised: Float[Array, "n"]
    """Share of each skill in the needs of the exercises of the last epoch."""
    epoch: Int[Array, ""]
    key: Array


class Tutoring(Experiment):
    """Students taught by one tutor."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.steps_per_epoch = config.teaching.exercises

    @over_seeds
    def init(self, hyper: Any, key: Array) -> State:
        """A new course and new students; the same for all tutors. If the graph is to be found, it is found here."""
        course_key, student_key, graph_key, key = random.split(key, 4)
        course = pupils.draw_course(hyper.course, key=course_key)
        parents, found = _graph(hyper, course, key=graph_key)
        count = hyper.students.number
        seen = tutors.init(hyper.teaching, hyper.course.skills)
        return State(
            course=course,
            plan=Plan(needs=course.needs, parents=parents),
            found=found,
            students=_new_students(hyper, count, key=student_key),
            seen=jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), seen),
            practised=jnp.zeros(hyper.course.skills),
            epoch=jnp.zeros((), jnp.int32),
            key=key,
        )

    @over_seeds
    def epoch(self, hyper: Any, data: Any, state: State) -> tuple[State, dict[str, Array]]:
        """Some exercises of every student, and what tutor and students learn of each."""
        key, *keys = random.split(state.key, 1 + hyper.teaching.exercises)
        students, seen, (exercises, scores) = _taught(hyper, state, jnp.stack(keys))
        needs = state.course.needs[exercises].sum(axis=(0, 1))
        state = state.replace(
            students=students, seen=seen, practised=needs / needs.sum(), epoch=state.epoch + 1, key=key
        )
        metrics = {"students/success": scores.mean()} | _levels(students)
        if hyper.teaching.graph == "found":
            good = graphs.quality(state.course.parents, state.found.parents, state.found.strength)
            metrics |= {f"graph/{name}": value for name, value in good.items()}
        return state, metrics

    @over_seeds
    def evaluate(self, hyper: Any, state: State, key: Array) -> dict[str, Array]:
        """The lasting part of the students' learning."""
        found = _levels(state.students)
        return {name.removeprefix("students/"): value for name, value in found.items()}

    def rows(self, evaluated: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
        """The same as numbers."""
        return numbers(evaluated)

    def tables(self, hyper: Any, state: State, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """Levels and practice of each skill, and the graphs."""
        lasting = np.asarray(state.students.lasting, float)
        true, known, practised, found = jax.device_get(
            (state.course.parents, state.plan.parents, state.practised, state.found)
        )
        return [
            {
                "seed": seed,
                "level": lasting[i].mean(axis=0).round(1).tolist(),
                "mastered": (lasting[i] > MASTERED).mean(axis=0).round(4).tolist(),
                "practised": practised[i].astype(float).round(4).tolist(),
                "prerequisites": np.argwhere(true[i]).tolist(),
                "known": np.argwhere(known[i]).tolist(),
                "found": [
                    [*map(int, edge), *(round(float(x[i][edge]), 4) for x in (found.strength, found.share))]
                    for edge in zip(*np.nonzero(found.parents[i]), strict=True)
                ],
            }
            for i, seed in enumerate(seeds)
        ]

    def figures(self, rows: Sequence[Mapping[str, Any]], tables: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """Levels, practice of each skill, and the tutor's graph beside the true one."""
        from star.tutoring import figures  # Matplotlib is slow to import: a run need not wait for it to begin

        found = dict(super().figures(rows, tables))
        if tables:
            found["skills"] = figures.skills_figure(tables)
            found["graph"] = figures.graphs_figure(tables)
        return found

    def notes(self) -> list[str]:
        """The source of the graph, if finding it takes time."""
        if self.config.teaching.graph != "found":
            return []
        section = self.config.discovery
        return [f"before the first epoch the graph is found from {section.students} earlier students"]

    def facts(self, rows: Sequence[Mapping[str, Any]]) -> Mapping[str, str]:
        """Success in the exercises, and the graph found."""
        found = {"success": mean(rows, "students/success"), "precision": mean(rows, "graph/precision")}
        return {name: f"{value:.2f}" for name, value in found.items() if value is not None}

    def scratch(self, seeds: int) -> Mapping[str, int]:
        """Bytes of what the models see of earlier students, before the first epoch."""
        section, skills = self.config.discovery, self.config.course.skills
        if self.config.teaching.graph != "found":
            return {}
        return {"discovery.students": 4 * seeds * section.students * section.exercises * tracing.FEATURES * skills}


def earlier_scores(hyper: Any, course: Course, *, withheld: Int[Array, "P"] | None = None, key: Array) -> Scores:
    """Those of students of `course` who chose exercises at random, each with its own preferences among skills.

    None chose an exercise that needs the skill `withheld` from it, if there is another exercise.
    """
    section = hyper.discovery
    student_key, taste_key, exercise_key, key = random.split(key, 4)
    students = _new_students(hyper, section.students, key=student_key)
    shape = (section.exercises, section.students)
    taste = section.preference * random.normal(taste_key, (section.students, hyper.course.skills))
    odds = taste @ course.needs.T
    if withheld is not None:
        odds = jnp.where(course.needs[:, withheld].T, -jnp.inf, odds)
    exercises = random.categorical(exercise_key, odds, shape=shape)

    def step(students: Student, given: tuple[Array, Array]) -> tuple[Student, Array]:
        exercise, key = given
        return _practise(hyper, course, students, exercise, key=key)

    right = jax.lax.scan(step, students, (exercises, random.split(key, section.exercises)))[1]
    number = jnp.broadcast_to(jnp.arange(section.students), shape)
    return Scores(student=number.T.ravel(), exercise=exercises.T.ravel(), right=right.T.ravel())


def withheld_scores(hyper: Any, course: Course, *, key: Array) -> tuple[Int[Array, "P"], Scores]:
    """The skill withheld from each of the earlier students, and their scores: each from as many, drawn by lot."""
    lot_key, key = random.split(key)
    withheld = random.permutation(lot_key, jnp.arange(hyper.discovery.students) % hyper.course.skills)
    return withheld, earlier_scores(hyper, course, withheld=withheld, key=key)


def _graph(hyper: Any, course: Course, *, key: Array) -> tuple[Bool[Array, "n n"], Found]:
    """The graph that the tutor obeys, and the one that was found."""
    unknown = jnp.zeros(course.parents.shape)
    nothing = Found(parents=unknown > 0, strength=unknown, share=unknown)
    wanted = hyper.teaching.graph
    if wanted == "true":
        return course.parents, nothing
    if wanted == "none":
        return nothing.parents, nothing
    scores_key, other_key = random.split(key)
    if wanted == "wrong":
        return graphs.draw(hyper.course.skills, key=other_key), nothing
    scores = earlier_scores(hyper, course, key=scores_key)
    found = tracing.discover(hyper.discovery, course.needs, scores, hyper.discovery.students, key=other_key)
    return found.parents & (found.share >= hyper.teaching.sure), found


def _new_students(hyper: Any, count: int, *, key: Array) -> Student:
    return jax.vmap(lambda key: pupils.draw_student(hyper.course, key=key))(random.split(key, count))


def _practise(
    hyper: Any, course: Course, students: Student, exercises: Int[Array, "P"], *, key: Array
) -> tuple[Student, Bool[Array, "P"]]:
    """One exercise of each student."""

    def one(student: Student, exercise: Array, key: Array) -> tuple[Student, Array]:
        return pupils.practise(hyper.students, course, student, exercise, key=key)

    return jax.vmap(one)(students, exercises, random.split(key, len(exercises)))


def _taught(hyper: Any, state: State, keys: Array) -> tuple[Student, Seen, tuple[Array, Array]]:
    """Students and tutor after one exercise for each of the `keys`; exercises and scores, each [len(keys), P]."""
    section, plan = hyper.teaching, state.plan

    def step(both: tuple[Student, Seen], key: Array) -> tuple[tuple[Student, Seen], tuple[Array, Array]]:
        students, seen = both
        choice_key, key = random.split(key)
        each = random.split(choice_key, len(seen.success))
        exercises = jax.vmap(lambda seen, key: tutors.choose(section, plan, seen, key=key))(seen, each)
        students, scores = _practise(hyper, state.course, students, exercises, key=key)
        seen = jax.vmap(lambda *known: tutors.update(section, plan, *known))(seen, exercises, scores)
        return (students, seen), (exercises, scores)

    (students, seen), course = jax.lax.scan(step, (state.students, state.seen), keys)
    return students, seen, course


def _levels(students: Student) -> dict[str, Array]:
    """Means over students and skills."""
    lasting = students.lasting
    return {"students/level": lasting.mean(), "students/mastered": (lasting > MASTERED).mean()}
