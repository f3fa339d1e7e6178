"""The withheld-skill test, an experiment that finds prerequisites: each student practises without one skill.

A skill is a prerequisite of another, near or far, if students without it succeed less in the other.

    score     y = right - mean score of the exercise, of the later half of each student's scores
    success   u_s = argmin_u sum (y - sum_{k needed} u_k)^2 + |u|^2    of student s in each skill
    drop      d_ij = mean u_i of students who may practise j - mean u_i of students without j
    p         of the one-sided Welch t-test of d_ij > 0, over students who practised i
    pairs     the step-up of Benjamini and Hochberg takes them from all n (n - 1)
    graph     pairs from the largest drop down, but for those that close a cycle; what others imply is taken out

Least squares share a score out among the skills of its exercise, so that none is blamed for what another lacks.

The skill that a student does without must be drawn by lot. Groups that are not differ in more than the skill: weak
students never come to hard skills, so that a hard skill would look like a prerequisite of easy ones.

Sources: Welch, Biometrika 1947; Benjamini and Hochberg, JRSS B 1995. Both the experiment and the estimate of success
are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from envs.common.errors import UserError
from star.tutoring import graphs
from star.tutoring.tracing import Scores

RATE = 0.05
"""False discovery rate: the expected share of pairs that are wrong among those found."""


class Effects(NamedTuple):
    """The effects on success in skill i of withholding skill j: [i, j]."""

    parents: Bool[np.ndarray, "n n"]
    """j is a prerequisite of i; without cycles and edges that others imply."""
    pairs: Bool[np.ndarray, "n n"]
    """The drop is significant: j comes before i, directly or not."""
    drop: Float[np.ndarray, "n n"]
    """Of the share of right scores; 0 where `p` is not defined."""
    p: Float[np.ndarray, "n n"]
    """Not adjusted; 1 on the diagonal, and where fewer than two students of either group practised i."""


def discover(
    needs: Bool[np.ndarray, "E n"], scores: Scores, withheld: Int[np.ndarray, "P"], *, rate: float = RATE
) -> Effects:
    """The prerequisites among the skills of `needs`; `withheld` is the skill that each student did without.

    Raises:
      UserError: in one line, if a student practised it.
    """
    needs, withheld = np.asarray(needs, bool), np.asarray(withheld)
    student, exercise = np.asarray(scores.student), np.asarray(scores.exercise)
    broken = np.flatnonzero(needs[exercise, withheld[student]])
    if len(broken):
        who = student[broken[0]]
        raise UserError(f"withheld: student {who} practised skill {withheld[who]}; allowed: a skill never practised")
    success, practised = successes(needs, *totals(scores, len(withheld), len(needs)))
    drop, p = drops(success, practised, withheld)
    pairs = significant(p, rate)
    parents = _acyclic(np.where(pairs, drop, 0.0), 0.0)
    return Effects(np.asarray(parents), pairs, drop, p)


_acyclic = jax.jit(graphs.acyclic)


def totals(scores: Scores, students: int, exercises: int) -> tuple[Int[np.ndarray, "P E"], Int[np.ndarray, "P E"]]:
    """Numbers of scores and of right ones that each student has in each exercise, of the later half of its scores."""
    student, exercise, right = (np.asarray(column) for column in (scores.student, scores.exercise, scores.right))
    order = np.argsort(student, kind="stable")
    number = np.bincount(student, minlength=students)
    place = np.arange(len(student)) - np.repeat(np.cumsum(number) - number, number)
    later = order[2 * place >= np.repeat(number, number)]
    count, good = np.zeros((2, students, exercises), int)
    np.add.at(count, (student[later], exercise[later]), 1)
    np.add.at(good, (student[later], exercise[later]), right[later])
    return count, good


def successes(
    needs: Bool[np.ndarray, "E n"], count: Int[np.ndarray, "P E"], right: Int[np.ndarray, "P E"]
) -> tuple[Float[np.ndarray, "P n"], Bool[np.ndarray, "P n"]]:
    """Each student's success in each skill, above the mean; and whether the student practised it."""
    needed = needs.astype(float)
    above = right - count * (right.sum(axis=0) / np.maximum(count.sum(axis=0), 1))
    squares = np.einsum("ej,pe,ek->pjk", needed, count, needed, optimize=True) + np.eye(needs.shape[1])
    return np.linalg.solve(squares, (above @ needed)[..., None])[..., 0], count @ needed > 0


def drops(
    success: Float[np.ndarray, "P n"], practised: Bool[np.ndarray, "P n"], withheld: Int[np.ndarray, "P"]
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
    """`drop` and `p` of all pairs."""
    n = success.shape[1]
    without = withheld[:, None] == np.arange(n)
    groups = [_moments(success, practised, group) for group in (without, ~without)]
    (lower, _, few), (higher, _, many) = groups
    told = (few > 1) & (many > 1) & ~np.eye(n, dtype=bool)
    with np.errstate(invalid="ignore", divide="ignore"):  # where nobody tells, or all tell the same
        p = stats.ttest_ind_from_stats(*groups[0], *groups[1], equal_var=False, alternative="less").pvalue
    return np.where(told, higher - lower, 0.0), np.where(told & ~np.isnan(p), p, 1.0)


def significant(p: Float[np.ndarray, "n n"], rate: float) -> Bool[np.ndarray, "n n"]:
    """The pairs of different skills that are found at the false discovery rate `rate`, by Benjamini and Hochberg."""
    pairs = ~np.eye(len(p), dtype=bool)
    pairs[pairs] = stats.false_discovery_control(p[pairs], method="bh") <= rate
    return pairs


def _moments(
    success: Float[np.ndarray, "P n"], practised: Bool[np.ndarray, "P n"], group: Bool[np.ndarray, "P n"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard deviation and number, each [i, j]: of success in skill i of those in group j who practised i."""
    number = practised.T.astype(float) @ group
    known = np.where(practised, success, 0.0).T
    mean = known @ group / np.maximum(number, 1)
    variance = (known**2 @ group - number * mean**2) / np.maximum(number - 1, 1)
    return mean, np.sqrt(np.maximum(variance, 0.0)), number
