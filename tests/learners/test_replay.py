"""Rings keep the latest items, and only what was written can be drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.learners import replay

SIZE = 7


@pytest.fixture(scope="module")
def add():
    return jax.jit(replay.add)


def written(ring):
    items, mask = replay.contents(ring)
    return sorted(np.asarray(items["x"])[np.asarray(mask) > 0].tolist())


def test_a_ring_keeps_the_latest_items(add):
    ring = replay.create({"x": jnp.zeros((), jnp.int32)}, size=SIZE)
    assert replay.capacity(ring) == SIZE
    assert int(replay.filled(ring)) == 0 and written(ring) == []
    history = []
    for batch in range(6):
        items = list(range(100 + 3 * batch, 103 + 3 * batch))
        ring = add(ring, {"x": jnp.array(items, jnp.int32)})
        history += items
        assert int(replay.filled(ring)) == min(len(history), SIZE)
        assert written(ring) == history[-SIZE:]


def test_a_batch_of_the_rings_size_replaces_everything(add):
    ring = replay.create({"x": jnp.zeros((), jnp.int32)}, size=SIZE)
    for start in (0, 50):
        ring = add(ring, {"x": jnp.arange(start, start + SIZE)})
        assert written(ring) == list(range(start, start + SIZE))


def test_samples_are_uniform_over_what_was_written(add):
    ring = add(replay.create({"x": jnp.zeros((), jnp.int32)}, size=3000), {"x": jnp.array([5, 6, 7])})
    drawn = replay.sample(ring, jax.random.key(0), batch_size=3000)["x"]
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [5, 6, 7]
    np.testing.assert_allclose(counts / 3000, 1 / 3, atol=0.04)


def test_flatten_merges_time_and_environments():
    batch = {"a": jnp.arange(6).reshape(2, 3), "b": jnp.arange(12).reshape(2, 3, 2)}
    flat = replay.flatten(batch)
    assert flat["a"].tolist() == list(range(6))
    np.testing.assert_array_equal(flat["b"], jnp.arange(12).reshape(6, 2))
