"""Courses and simulated students: exercises need skills, skills have prerequisites, and practice moves levels.

A level is in Elo points: of two that lie 400 apart, the odds of success differ by a factor of ten.

    chance       p = sigma(ln 10 / 400 (softmin(levels of the skills needed and of their parents) - difficulty))
    softmin      sum_k w_k l_k / sum_k w_k,  w_k = 10^(-l_k / 400)
    practice     each skill needed grows by g = speed (e^4 right, e^2 wrong) 4 p (1 - p) readiness
    readiness    sigma(ln 10 / 400 (softmin(levels of its parents) - 2000)), 1 without parents
    forgetting   half of g stays; the other half fades by e^(-1/e) an exercise
    score        right by 1 - slip where the student succeeds, by guess where not

Source: the model of Annabi and Nguyen (ICDL 2023, arXiv 2402.01672) in our own form and with our own constants.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct
from jax import random
from jaxtyping import Array, Bool, Float, Int

from star.tutoring import graphs
from star.tutoring.sections import CourseConfig, StudentsConfig

MASTERED = 2000.0
"""Level from which on a skill is mastered."""
LOWEST, HIGHEST = 500.0, 2500.0
_ELO = math.log(10.0) / 400.0
_FADES = math.exp(-1.0 / math.e)


class Course(struct.PyTreeNode):
    """Skills and exercises."""

    parents: Bool[Array, "n n"]
    """[i, j]: skill j is a prerequisite of skill i; the graph has no cycle and no edge that others imply."""
    needs: Bool[Array, "E n"]
    """The skills that each exercise needs: one or more, none of them an ancestor of another."""
    difficulty: Float[Array, "E"]


class Student(struct.PyTreeNode):
    """One student's ability and speed of learning."""

    level: Float[Array, "n"]
    """Now: what lasts, and what will fade."""
    lasting: Float[Array, "n"]
    speed: Float[Array, ""]


def draw_course(config: CourseConfig, *, key: Array) -> Course:
    """A random course: each pair of skills is an edge with probability 2 / (n - 1) before edges implied are taken out.

    The first needs give each skill an exercise; `config.needs` more are dealt out among the pairs that are left.
    """
    graph_key, first_key, more_key, difficulty_key = random.split(key, 4)
    parents = graphs.draw(config.skills, key=graph_key)
    above = graphs.ancestors(parents)
    related = above | above.T
    n, count = config.skills, config.exercises
    first = jnp.where(jnp.arange(count) < n, jnp.arange(count) % n, random.randint(first_key, (count,), 0, n))

    def deal(needs: Array, key: Array) -> tuple[Array, None]:
        free = ~needs & ~(needs.astype(jnp.float32) @ related > 0)
        pair = random.categorical(key, jnp.where(free, 0.0, -jnp.inf).ravel())
        return needs.at[pair // n, pair % n].max(free.any()), None

    needs = jax.lax.scan(deal, jax.nn.one_hot(first, n, dtype=bool), random.split(more_key, config.needs))[0]
    difficulty = 1500.0 + 300.0 * random.normal(difficulty_key, (count,))
    return Course(parents=parents, needs=needs, difficulty=difficulty)


def draw_student(config: CourseConfig, *, key: Array) -> Student:
    """A new student: levels 1000 + N(0, 200) + N(0, 200) for each skill, speed exp(N(3, .3))."""
    own, each, speed = random.split(key, 3)
    level = 1000.0 + 200.0 * random.normal(own) + 200.0 * random.normal(each, (config.skills,))
    level = jnp.clip(level, LOWEST, HIGHEST)
    return Student(level=level, lasting=level, speed=jnp.exp(3.0 + 0.3 * random.normal(speed)))


def softmin(levels: Float[Array, "n"], mask: Bool[Array, "*m n"]) -> Float[Array, "*m"]:
    """The softmin of the levels where `mask`; infinite where there are none."""
    weight = jnp.where(mask, 10.0 ** (-(levels - levels.min()) / 400.0), 0.0)
    total = weight.sum(axis=-1)
    return jnp.where(total > 0, weight @ levels / jnp.where(total > 0, total, 1.0), jnp.inf)


def chance(course: Course, levels: Float[Array, "n"], exercise: Int[Array, ""]) -> Float[Array, ""]:
    """The chance of success in an exercise."""
    needed = course.needs[exercise]
    involved = needed | (course.parents & needed[:, None]).any(axis=0)
    return jax.nn.sigmoid(_ELO * (softmin(levels, involved) - course.difficulty[exercise]))


def practise(
    config: StudentsConfig, course: Course, student: Student, exercise: Int[Array, ""], *, key: Array
) -> tuple[Student, Bool[Array, ""]]:
    """The student after one exercise, and its score: right or wrong."""
    success_key, score_key = random.split(key)
    p = chance(course, student.level, exercise)
    right = random.bernoulli(success_key, p)
    ready = jax.nn.sigmoid(_ELO * (softmin(student.level, course.parents) - MASTERED))
    growth = student.speed * jnp.exp(jnp.where(right, 4.0, 2.0)) * 4.0 * p * (1.0 - p) * ready
    growth = jnp.where(course.needs[exercise], growth, 0.0)
    lasting = jnp.clip(student.lasting + growth / 2, LOWEST, HIGHEST)
    level = student.lasting + (student.level - student.lasting) * _FADES + growth
    student = student.replace(lasting=lasting, level=jnp.clip(level, lasting, HIGHEST))
    return student, random.bernoulli(score_key, jnp.where(right, 1.0 - config.slip, config.guess))
