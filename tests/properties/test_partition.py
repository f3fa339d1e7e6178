"""The regions always cover the space exactly and never overlap, whatever is cut."""

from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from star.abstraction import regions
from star.abstraction.regions import Cut

CUTS = 1000
POINTS = 500
SPACES = {
    2: (((-4.0, -4.0), (20.0, 20.0)), ((8.0,), (8.0,))),
    3: (((-8.0, 0.0, 0.1), (16.0, 32.0, 5.3)), ((4.0,), (16.0,), ())),
}
CASES = [(2, 1024), (3, 1024), (2, 7)]


@cache
def cutter(d, capacity):
    """1000 random cuts, some of them outside their region or of a region that does not exist."""
    space, cuts = SPACES[d]

    def step(abstraction, key):
        pick, axis, where = jax.random.split(key, 3)
        region = jax.random.randint(pick, (), 0, jnp.minimum(abstraction.count + 1, capacity))
        dimension = jax.random.randint(axis, (), 0, d)
        low, high = abstraction.lower[region, dimension], abstraction.upper[region, dimension]
        share = jax.random.uniform(where, (), minval=-0.05, maxval=1.05)
        cut = Cut(region, dimension, low + share * (high - low))
        after, done = regions.split(abstraction, cut, min_width=1e-3)
        return after, (cut, done)

    def run(key):
        start = regions.create(space, cuts, max_regions=capacity)
        return jax.lax.scan(step, start, jax.random.split(key, CUTS))

    return jax.jit(run)


@cache
def locator(d, capacity):
    return jax.jit(jax.vmap(regions.locate, in_axes=(None, 0)))


def cut_slowly(d, capacity, cuts, done):
    """The same cuts on a plain list of boxes."""
    (low, high), positions = SPACES[d]
    start = regions.create((low, high), positions, max_regions=capacity)
    boxes = [[np.array(start.lower[i]), np.array(start.upper[i])] for i in range(int(start.count))]
    for region, axis, position, was_done in zip(*cuts, done, strict=True):
        allowed = region < len(boxes) < capacity
        if allowed:
            lower, upper = boxes[region]
            allowed = position - lower[axis] >= np.float32(1e-3) and upper[axis] - position >= np.float32(1e-3)
        assert was_done == allowed
        if allowed:
            child = [lower.copy(), upper.copy()]
            upper[axis] = child[0][axis] = position
            boxes.append(child)
    return np.array([box[0] for box in boxes]), np.array([box[1] for box in boxes])


def volume(lower, upper):
    """Exact: floats are fractions."""
    product = Fraction(1)
    for a, b in zip(lower.tolist(), upper.tolist(), strict=True):
        product *= Fraction(b) - Fraction(a)
    return product


def holders(lower, upper, points, top):
    """How many of the half-open boxes hold each point; the upper faces of the space count as inside."""
    below = (points[:, None] < upper) | ((points[:, None] == top) & (upper == top))
    return ((lower <= points[:, None]) & below).all(-1)


@pytest.mark.parametrize(("d", "capacity"), CASES)
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1))
def test_regions_tile_the_space_exactly_after_any_cuts(d, capacity, seed):
    made, (cuts, done) = cutter(d, capacity)(jax.random.key(seed))
    count = int(made.count)
    lower, upper = np.asarray(made.lower)[:count], np.asarray(made.upper)[:count]
    low, high = (np.float32(corner) for corner in SPACES[d][0])
    assert count == capacity if capacity < 100 else count > 500

    slow_lower, slow_upper = cut_slowly(d, capacity, [np.asarray(x) for x in cuts], np.asarray(done))
    np.testing.assert_array_equal(lower, slow_lower)
    np.testing.assert_array_equal(upper, slow_upper)

    # Inside the space, disjoint, and of its volume to the last bit: an exact cover.
    assert (low <= lower).all() and (lower < upper).all() and (upper <= high).all()
    overlap = (np.maximum(lower[:, None], lower) < np.minimum(upper[:, None], upper)).all(-1)
    np.testing.assert_array_equal(overlap, np.eye(count, dtype=bool))
    assert sum(volume(a, b) for a, b in zip(lower, upper, strict=True)) == volume(low, high)
    sizes = np.prod(upper.astype(np.float64) - lower, axis=-1)
    np.testing.assert_allclose(sizes.sum(), np.prod(high.astype(np.float64) - low), rtol=1e-12)

    rng = np.random.default_rng(seed)
    pick = lambda a: a[rng.integers(count, size=POINTS)]  # noqa: E731
    inside = rng.uniform(low, high, (POINTS, d)).astype(np.float32)
    corners = np.where(rng.random((POINTS, d)) < 0.5, pick(lower), pick(upper))
    edges = np.where(rng.random((POINTS, d)) < 0.5, inside, corners)
    points = np.concatenate([inside, corners, edges])
    holds = holders(lower, upper, points, high)
    np.testing.assert_array_equal(holds.sum(1), 1)
    np.testing.assert_array_equal(locator(d, capacity)(made, points), holds.argmax(1))


@pytest.mark.parametrize(("d", "capacity"), CASES)
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1), far=st.sampled_from([1e-3, 1.0, 1e4]))
def test_points_outside_go_to_the_nearest_region(d, capacity, seed, far):
    made, _ = cutter(d, capacity)(jax.random.key(seed))
    count = int(made.count)
    lower, upper = (np.asarray(x, np.float64)[:count] for x in (made.lower, made.upper))
    rng = np.random.default_rng(seed)
    low, high = (np.float64(np.float32(corner)) for corner in SPACES[d][0])
    points = rng.uniform(low - far, high + far, (3 * POINTS, d)).astype(np.float32)
    away = np.maximum(np.maximum(lower - points[:, None], points[:, None] - upper), 0)
    distance = np.linalg.norm(away, axis=-1)
    found = np.asarray(locator(d, capacity)(made, points))
    assert (found < count).all()
    np.testing.assert_allclose(distance[np.arange(len(points)), found], distance.min(1), rtol=1e-9, atol=1e-9)
