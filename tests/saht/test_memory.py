"""Memory, its exact neighbours and the inverse model, against slow ones in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import worlds
from star.saht import inverse, memory
from star.saht.memory import CHUNK, FAR, GAMMA, OFFSET, Memory, Neighbours

WORLD = worlds.make("pen")
ROWS = CHUNK + 400  # so that a search goes over a border


def filled(seed, rows=ROWS, *, share=0.6):
    """A memory whose outcomes lie on a coarse grid, so that many are equal, and of which many tasks have none."""
    rng = np.random.default_rng(seed)
    known = memory.empty(WORLD, ROWS)
    n, tasks = len(known.lengths), len(WORLD.tasks)
    outcomes = rng.integers(0, 40, (tasks, 4, n)) / 80
    none = (rng.random((tasks, 1, n)) > share) | (np.arange(n) >= rows)
    return known.replace(
        sequences=jnp.asarray(rng.uniform(-1, 1, known.sequences.shape), jnp.float32),
        outcomes=jnp.asarray(np.where(none, FAR, outcomes), jnp.float32),
        lengths=jnp.asarray(rng.integers(1, 5, n), jnp.int32),
        pair=jnp.asarray(np.where(rng.random(n) < 0.2, rng.integers(0, 36, n), -1), jnp.int32),
    )


def slow_ranks(known, task, goal, *, procedures=False):
    """(distance, rank) of every row, one by one; infinite where there is no outcome."""
    outcomes, lengths, pair = (np.asarray(x, float) for x in (known.outcomes, known.lengths, known.pair))
    distances = np.full(len(lengths), np.inf)
    for row in range(len(lengths)):
        if outcomes[task, 0, row] < FAR / 2 and not (procedures and pair[row] < 0):
            distances[row] = np.linalg.norm(outcomes[task, :, row] - np.asarray(goal, float))
    return distances, (distances + OFFSET) * GAMMA**lengths


find = jax.jit(memory.neighbours, static_argnames=("k", "procedures"))
distances, nearest = jax.jit(memory.distances), jax.jit(memory.nearest)
regress, action = jax.jit(inverse.regress), jax.jit(inverse.action)


@settings(max_examples=8)
@given(st.integers(0, 10**6), st.integers(0, 5), st.integers(1, ROWS), st.booleans(), st.sampled_from([0.6, 0.004]))
def test_neighbours_are_those_that_a_slow_search_finds(seed, task, rows, procedures, share):
    known = filled(seed, rows, share=share)
    goal = np.random.default_rng(seed).uniform(0, 0.5, 4)
    near = find(known, rows, task, jnp.asarray(goal, jnp.float32), k=10, procedures=procedures)
    distances, ranks = slow_ranks(known, task, goal, procedures=procedures)
    there = np.sort(ranks[np.isfinite(ranks)])[:10]
    assert int(near.known.sum()) == len(there)
    chosen = np.asarray(near.rows)[: len(there)]
    np.testing.assert_allclose(ranks[chosen], there, rtol=1e-5)  # of equal ones any
    assert len(set(chosen.tolist())) == len(there)
    np.testing.assert_allclose(near.distances[: len(there)], distances[chosen], atol=1e-6)


@settings(max_examples=4)
@given(st.integers(0, 10**6), st.integers(1, ROWS))
def test_distances_to_what_is_known_are_those_of_a_slow_search(seed, rows):
    known = filled(seed, rows, share=0.01)
    found = np.random.default_rng(seed).uniform(0, 0.5, (3, 6, 4)).astype(np.float32)
    fast = distances(known, rows, jnp.asarray(found))
    slow = [[slow_ranks(known, task, goal)[0].min() for task, goal in enumerate(one)] for one in found]
    np.testing.assert_allclose(fast, np.minimum(slow, FAR), atol=1e-6, rtol=1e-6)
    one = nearest(known, rows, 4, jnp.asarray(found[1, 4]))
    assert float(one) == pytest.approx(float(fast[1, 4]), abs=1e-6)


def test_an_empty_memory_knows_nothing_and_rows_are_found_as_soon_as_they_are_written():
    known = jax.device_get(memory.empty(WORLD, 10))
    goal = np.zeros(4, np.float32)
    assert nearest(known, 0, 0, goal) == FAR and not np.asarray(find(known, 0, 0, goal, k=3).known).any()
    outcomes = np.full((6, 4, 2), FAR, np.float32)
    outcomes[0, :, 1] = 0.25
    new = jax.tree.map(lambda leaf: leaf[:2], known).replace(outcomes=outcomes, reached=np.array([1, 0, 0, 0, 0, 0]))
    known = jax.jit(memory.write)(known, np.int32(CHUNK - 2), new)
    near = jax.device_get(find(known, CHUNK, 0, goal, k=3))
    assert near.rows[0] == CHUNK - 1 and near.distances[0] == 0.5 and near.known.tolist() == [True, False, False]
    assert known.reached.tolist() == [1, 0, 0, 0, 0, 0]


def test_scaled_outcomes_are_at_most_1_apart_and_come_back_as_they_were():
    scale = memory.scale_of(WORLD)
    low, high = scale.scaled(WORLD.lower), scale.scaled(WORLD.upper)
    np.testing.assert_allclose(np.linalg.norm(high - low, axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(high, scale.top, rtol=1e-6)
    for task in range(6):
        np.testing.assert_allclose(scale.value(task, high[task]), WORLD.upper[task], rtol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 10))
def test_the_inverse_model_is_weighted_ridge_regression(seed, count):
    """The same by least squares on rows that are weighted, with as many more rows that pull slopes to 0."""
    rng = np.random.default_rng(seed)
    inputs, outputs = rng.uniform(0, 0.5, (10, 4)), rng.uniform(-1, 1, (10, 6))
    goal, used = rng.uniform(0, 0.5, 4), np.arange(10) < count
    distances = np.linalg.norm(inputs - goal, axis=1)
    fast = regress(*(x.astype(np.float32) for x in (inputs, outputs, distances)), used, goal.astype(np.float32))
    reach = 2 * (distances[used].min() + inverse.CLOSE)
    weights = np.exp(-((distances[used] / reach) ** 2))
    weights /= weights.sum()
    middle, mean = weights @ inputs[used], weights @ outputs[used]
    root = np.sqrt(weights)[:, None]
    rows = np.concatenate([root * (inputs[used] - middle) / reach, np.sqrt(inverse.RIDGE) * np.eye(4)])
    wanted = np.concatenate([root * (outputs[used] - mean), np.zeros((4, 6))])
    slopes = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    np.testing.assert_allclose(fast, mean + (goal - middle) / reach @ slopes, atol=2e-3)


def test_two_ways_of_doing_it_are_not_averaged():
    """Neighbours of another length, or of quite other actions, do not count; too few leave the best one as it is."""
    rng = np.random.default_rng(0)
    known = jax.device_get(memory.empty(WORLD, 10))
    one, other = np.full((4, 14), 0.5), np.full((4, 14), -0.5)
    ways = np.stack([one, *[one + 0.02 * rng.normal(size=one.shape) for _ in range(5)], *[other] * 4])
    sequences, lengths = known.sequences.copy(), known.lengths.copy()
    sequences[:10], lengths[:10] = ways, [2] * 5 + [3] * 5
    known = known.replace(sequences=sequences, lengths=lengths)
    outcomes = rng.uniform(0.2, 0.3, (10, 4)).astype(np.float32)
    goal = np.full(4, 0.25, np.float32)
    near = Neighbours(np.arange(10), outcomes, np.linalg.norm(outcomes - goal, axis=1))
    found = np.asarray(action(known, near, goal, 3))
    assert np.abs(found[:2] - 0.5).max() < 0.1 and not np.array_equal(found, sequences[0])
    np.testing.assert_array_equal(action(known, near, goal, 5), sequences[0])


def test_a_memory_has_room_for_what_is_asked_for():
    assert memory.capacity(1) == CHUNK and memory.capacity(CHUNK) == CHUNK and memory.capacity(CHUNK + 1) == 2 * CHUNK
    shapes = jax.eval_shape(lambda: memory.empty(WORLD, 25_000))
    assert isinstance(shapes, Memory) and shapes.sequences.shape == (25 * CHUNK, 4, 14)
