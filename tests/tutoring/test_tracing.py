"""Knowledge tracing with a learnable graph."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.tutoring import discover, tracing
from star.tutoring.sections import DiscoveryConfig
from star.tutoring.tables import Tables
from star.tutoring.tracing import Scores
from tests.tutoring import slow

NEEDS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], bool)


def some_scores(seed, n, students):
    rng = np.random.default_rng(seed)
    student = np.sort(rng.integers(0, students, n))
    return Scores(
        student=jnp.asarray(student),
        exercise=jnp.asarray(rng.integers(0, len(NEEDS), n)),
        right=jnp.asarray(rng.random(n) < 0.5),
    )


def test_features_are_those_of_the_exercises_before_of_the_same_student():
    scores = some_scores(0, 40, 4)
    rows = list(zip(*map(np.asarray, (scores.student, scores.exercise, scores.right)), strict=True))
    found = jax.jit(tracing.features)(NEEDS, scores)
    np.testing.assert_allclose(found, slow.features(NEEDS, rows, tracing.RATES), rtol=1e-5, atol=1e-6)


def test_the_chance_is_that_of_the_weakest_skill_involved():
    rng = np.random.default_rng(1)
    scores = some_scores(1, 12, 3)
    seen = rng.random((12, tracing.FEATURES, 3)).astype(np.float32)
    params = {
        "graph": rng.normal(size=(3, 3)),
        "level": rng.normal(size=3),
        "weights": rng.normal(size=(tracing.FEATURES, 3)),
        "ability": rng.normal(size=3),
        "difficulty": rng.normal(size=4),
        "guess": np.array(-1.0),
        "slip": np.array(-2.0),
    }
    found = jax.jit(tracing.chances)(jax.tree.map(jnp.float32, params), NEEDS, scores, seen)
    guess, slip = slow.sigma(-1.0) / 2, slow.sigma(-2.0) / 2
    for row in range(12):
        student, exercise = int(scores.student[row]), int(scores.exercise[row])
        top = bottom = 0.0
        for j in range(3):
            kept = 1.0
            for i in np.flatnonzero(NEEDS[exercise]):
                if i != j:
                    kept *= 1 - 0.999 * slow.sigma(params["graph"][i, j])
            involved = 1.0 if NEEDS[exercise, j] else 1 - kept
            level = params["level"][j] + params["ability"][student] + (params["weights"][:, j] * seen[row, :, j]).sum()
            top, bottom = top + involved * np.exp(-level) * level, bottom + involved * np.exp(-level)
        z = slow.sigma(top / bottom - params["difficulty"][exercise])
        assert found[row] == pytest.approx(guess + (1 - guess - slip) * z, rel=1e-4)


def chain(seed, students=150, length=40):
    """Students who solve exercise 1 only once they can do exercise 0; exercise 2 is of a skill apart."""
    rng, rows = np.random.default_rng(seed), []
    for student in range(students):
        able, given = [0.0, 0.0, 0.0], rng.integers(0, 3, length)
        for exercise in given:
            able[exercise] += rng.choice([0.0, 0.4])
            level = min(able[:2]) if exercise == 1 else able[exercise]
            rows.append((student, exercise, rng.random() < 0.05 + 0.9 * (level > 1.5)))
    return Scores(*(jnp.asarray(column) for column in zip(*rows, strict=True)))


def test_a_prerequisite_is_found_and_the_same_seed_finds_the_same():
    config = DiscoveryConfig(members=2, steps=300, batch=256)
    scores = chain(0)
    rows = Tables(
        ["a", "b", "c"], 150, np.eye(3, dtype=bool), *map(np.asarray, (scores.student, scores.exercise, scores.right))
    )
    found, again, other = (discover.of_tables(config, rows, seed=seed) for seed in (0, 0, 1))
    assert np.argwhere(found.parents).tolist() == [[1, 0]]
    assert found.share[1, 0] == 1 and 0.3 < found.strength[1, 0] <= 1 and not found.strength.diagonal().any()
    np.testing.assert_array_equal(found.strength, again.strength)
    assert (found.strength != other.strength).any()
