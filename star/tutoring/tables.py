"""A user's own scores and the skills of their exercises, from two CSV files.

    scores.csv    student,exercise,correct    a row for each score, those of a student in the order of time
    skills.csv    exercise,skill              a row for each skill that an exercise needs

Other columns are ignored. The first fault is told in one line with its line number.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.common import reading
from envs.common.errors import UserError, shown
from envs.common.files import nearest_file

MOST_SKILLS = 256
_SCORES, _SKILLS = ("student", "exercise", "correct"), ("exercise", "skill")


@dataclass(frozen=True)
class Tables:
    """The content of both files; rows are sorted by student, and in the order of the file within each."""

    skills: list[str]
    students: int
    needs: np.ndarray
    """[E, n] bool: the skills that each exercise needs."""
    student: np.ndarray
    exercise: np.ndarray
    right: np.ndarray
    """[N]: number of the student, number of the exercise, whether the score is 1."""


def read(scores: Path, skills: Path) -> Tables:
    """Both files.

    Raises:
      UserError: in one line that names file, line, value and what is allowed.
    """
    needs, skill_lines = _needs(skills)
    students: dict[str, int] = {}
    exercises: dict[str, int] = {}
    rows: list[tuple[int, int, bool, int]] = []
    for line, (who, exercise, correct) in _rows(scores, _SCORES):
        if correct not in ("0", "1"):
            raise UserError(f"{scores}: line {line}: correct: {shown(correct)} is not allowed: should be 0 or 1")
        if exercise not in needs:
            raise UserError(
                f"{scores}: line {line}: exercise {shown(exercise)} needs no skill: {skills} has no such row"
            )
        number = students.setdefault(who, len(students)), exercises.setdefault(exercise, len(exercises))
        rows.append((*number, correct == "1", line))
    if not rows:
        raise UserError(f"{scores}: holds no score; at least 2 of one student are needed")
    student, which, right, lines = np.asarray(rows).T
    alone = np.flatnonzero(np.bincount(student) == 1)
    if len(alone):
        line = lines[student == alone[0]][0]
        name = shown(list(students)[alone[0]])
        raise UserError(f"{scores}: line {line}: is the only score of student {name}; at least 2 are needed")
    names = list(skill_lines)
    used = {skill for exercise in exercises for skill in needs[exercise]}
    for skill, line in skill_lines.items():
        if skill not in used:
            raise UserError(f"{skills}: line {line}: skill {shown(skill)} is needed by no exercise of {scores}")
    table = np.array([[skill in needs[exercise] for skill in names] for exercise in exercises], bool)
    order = np.argsort(student, kind="stable")
    return Tables(names, len(students), table, student[order], which[order], right[order] > 0)


def _needs(path: Path) -> tuple[dict[str, dict[str, int]], dict[str, int]]:
    """The skills of each exercise with the line of each, and the line on which each skill is first named."""
    needs: dict[str, dict[str, int]] = {}
    first: dict[str, int] = {}
    for line, (exercise, skill) in _rows(path, _SKILLS):
        of = needs.setdefault(exercise, {})
        if skill in of:
            need = f"exercise {shown(exercise)} needs skill {shown(skill)}"
            raise UserError(f"{path}: line {line}: {need} on line {of[skill]} already")
        of[skill] = line
        first.setdefault(skill, line)
        if len(first) > MOST_SKILLS:
            raise UserError(f"{path}: line {line}: skill {shown(skill)} is one too many; allowed: {MOST_SKILLS} skills")
    if len(first) < 2:
        how = f"line {next(iter(first.values()))}: names the only skill" if first else "names no skill"
        raise UserError(f"{path}: {how}; at least 2 are needed")
    return needs, first


def _rows(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """The number of each line that holds something, after the header, and its values in these columns."""
    try:
        reading.check_regular(path)
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file, strict=True)
            header = [name.strip() for name in next(lines, [])]
            for name in columns:
                if header.count(name) != 1:
                    how = "has no column" if name not in header else "has more than one column"
                    raise UserError(f"{path}: line 1: {how} {name}; needed: {', '.join(columns)}")
            places = [header.index(name) for name in columns]
            for row in lines:
                if not row:
                    continue
                if len(row) != len(header):
                    raise UserError(
                        f"{path}: line {lines.line_num}: has {len(row)} values; the header has {len(header)}"
                    )
                values = [row[place].strip() for place in places]
                for name, value in zip(columns, values, strict=True):
                    if not value or not value.isprintable():
                        fault = "is empty" if not value else f"{shown(value)} holds what cannot be printed"
                        raise UserError(f"{path}: line {lines.line_num}: {name}: {fault}")
                yield lines.line_num, values
    except FileNotFoundError:
        raise UserError(f"{path}: no such file{nearest_file(path, ('.csv',))}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: cannot be read: not UTF-8 text") from None
    except csv.Error as error:
        raise UserError(f"{path}: line {lines.line_num}: is not valid CSV: {error}") from None
