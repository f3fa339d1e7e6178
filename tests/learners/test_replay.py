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


def empty(size=SIZE):
    return replay.create({"x": np.zeros((), np.int32)}, size=size)


contents, filled = jax.jit(replay.contents), jax.jit(replay.filled)


def written(ring):
    items, mask = jax.device_get(contents(ring))
    return sorted(items["x"][mask > 0].tolist())


def test_a_ring_keeps_the_latest_items(add):
    ring = empty()
    assert replay.capacity(ring) == SIZE
    assert int(filled(ring)) == 0 and written(ring) == []
    history = []
    for batch in range(6):
        items = list(range(100 + 3 * batch, 103 + 3 * batch))
        ring = add(ring, {"x": np.int32(items)})
        history += items
        assert int(filled(ring)) == min(len(history), SIZE)
        assert written(ring) == history[-SIZE:]


def test_a_new_ring_holds_nothing_of_what_was_in_the_memory_before(monkeypatch):
    monkeypatch.setattr(jnp, "empty_like", lambda x, **_: jnp.full_like(x, jnp.nan))
    ring = replay.create({"x": np.zeros(3, np.float32)}, size=SIZE)
    assert np.array_equal(ring.experience["x"], np.zeros((1, SIZE, 3)))


def test_a_batch_of_the_rings_size_replaces_everything(add):
    ring = empty()
    for start in (0, 50):
        ring = add(ring, {"x": np.arange(start, start + SIZE)})
        assert written(ring) == list(range(start, start + SIZE))


def test_samples_are_uniform_over_what_was_written(add):
    ring = add(empty(size=3000), {"x": np.array([5, 6, 7])})
    drawn = jax.jit(replay.sample, static_argnames="batch_size")(ring, jax.random.key(0), batch_size=3000)["x"]
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [5, 6, 7]
    np.testing.assert_allclose(counts / 3000, 1 / 3, atol=0.04)


def test_flatten_merges_time_and_environments():
    batch = {"a": np.arange(6).reshape(2, 3), "b": np.arange(12).reshape(2, 3, 2)}
    flat = jax.jit(replay.flatten)(batch)
    assert flat["a"].tolist() == list(range(6))
    np.testing.assert_array_equal(flat["b"], np.arange(12).reshape(6, 2))
