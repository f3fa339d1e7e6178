"""Regions: where a point belongs, and what a cut may do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import regions
from star.abstraction.regions import Cut

SPACE = ((-4.0, -4.0), (20.0, 20.0))


def grid(space=SPACE, cuts=((8.0,), (8.0,)), max_regions=6):
    return regions.create(space, cuts, max_regions=max_regions)


@pytest.fixture(scope="module")
def locate():
    return jax.jit(jax.vmap(regions.locate, in_axes=(None, 0)))


@pytest.fixture(scope="module")
def split():
    return jax.jit(lambda abstraction, cut, width: regions.split(abstraction, cut, min_width=width))


def cut(region, dimension, position):
    return Cut(jnp.int32(region), jnp.int32(dimension), jnp.float32(position))


def test_create_makes_the_grid_between_the_cuts():
    made = grid(cuts=((0.0, 8.0), (8.0,)), max_regions=9)
    boxes = {(*made.lower[i].tolist(), *made.upper[i].tolist()) for i in range(int(made.count))}
    assert boxes == {
        (x, y, X, Y) for x, X in ((-4.0, 0.0), (0.0, 8.0), (8.0, 20.0)) for y, Y in ((-4.0, 8.0), (8.0, 20.0))
    }
    assert made.active.tolist() == [True] * 6 + [False] * 3


def test_create_without_cuts_makes_one_region():
    made = grid(cuts=((), ()), max_regions=1)
    assert int(made.count) == 1
    np.testing.assert_array_equal(made.lower[0], [-4, -4])
    np.testing.assert_array_equal(made.upper[0], [20, 20])


@pytest.mark.parametrize(
    ("cuts", "max_regions", "says"),
    [
        (((8.0, 8.0), ()), 6, "do not increase"),
        (((9.0, 8.0), ()), 6, "do not increase"),
        (((-4.0,), ()), 6, "do not increase"),
        (((20.0,), ()), 6, "do not increase"),
        (((), (25.0,)), 6, "abstract dimension 1"),
        (((float("nan"),), ()), 6, "do not increase"),
        (((8.0,),), 6, "1 lists of cuts for 2 abstract dimensions"),
        (((8.0,), (8.0,)), 3, "4 initial regions exceed abstraction.max_regions 3"),
    ],
)
def test_create_refuses_bad_cuts_in_one_line(cuts, max_regions, says):
    with pytest.raises(ValueError) as caught:
        grid(cuts=cuts, max_regions=max_regions)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("point", "region"),
    [
        ((0.0, 0.0), 0),
        ((0.0, 8.0), 1),  # a boundary belongs to the upper box
        ((8.0, 0.0), 2),
        ((8.0, 8.0), 3),
        ((np.nextafter(np.float32(8), np.float32(0)), 8.0), 1),
        ((-4.0, -4.0), 0),
        ((20.0, 20.0), 3),  # the upper faces belong to the space
        ((20.0, 0.0), 2),
        ((-4.0, 20.0), 1),
        ((100.0, -50.0), 2),  # outside: the nearest region
        ((-50.0, 100.0), 1),
        ((-1e9, -1e9), 0),
        ((np.inf, np.inf), 3),
    ],
)
def test_locate_by_hand(locate, point, region):
    assert int(locate(grid(), jnp.array([point], jnp.float32))[0]) == region


@pytest.mark.parametrize("top", [0.0, -1.0, 1.0])
def test_the_top_of_the_space_belongs_to_it_even_where_floats_are_dense(locate, top):
    made = regions.create(((top - 8,), (top,)), ((top - 4,),), max_regions=2)
    points = jnp.array([[top], [top + 1], [top - 4], [top - 8]], jnp.float32)
    assert locate(made, points).tolist() == [1, 1, 1, 0]


def test_inactive_boxes_hold_nothing(locate):
    made = grid(space=((-1.0, -1.0), (1.0, 1.0)), cuts=((0.0,), (0.0,)))
    stale = made.replace(lower=made.lower.at[4:].set(-9.0), upper=made.upper.at[4:].set(9.0))
    points = jax.random.uniform(jax.random.key(0), (64, 2), minval=-1, maxval=1)
    np.testing.assert_array_equal(locate(stale, points), locate(made, points))


def test_the_distance_to_a_box_is_that_to_its_nearest_point_in_units_of_the_scale():
    rng = np.random.default_rng(0)
    lower, point, scale = rng.uniform(-9, 9, (50, 3)), rng.uniform(-12, 12, (50, 3)), np.float32([1, 2, 5])
    upper = lower + rng.uniform(0, 9, (50, 3))
    found = regions.Box(jnp.float32(lower), jnp.float32(upper)).distance(jnp.float32(point), scale)
    nearest = np.clip(point, lower, upper)
    np.testing.assert_allclose(found, np.sqrt((((point - nearest) / scale) ** 2).sum(axis=1)), rtol=1e-4, atol=1e-5)
    assert (np.asarray(found) == 0).any()


def test_split_gives_the_part_above_the_cut_to_the_new_region(split):
    before = grid()
    after, done = split(before, cut(2, 1, 3.0), 1.0)
    assert bool(done) and int(after.count) == 5
    np.testing.assert_array_equal(after.lower[2], [8, -4])
    np.testing.assert_array_equal(after.upper[2], [20, 3])
    np.testing.assert_array_equal(after.lower[4], [8, 3])
    np.testing.assert_array_equal(after.upper[4], [20, 8])
    for i in (0, 1, 3):
        np.testing.assert_array_equal(after.lower[i], before.lower[i])
        np.testing.assert_array_equal(after.upper[i], before.upper[i])


@pytest.mark.parametrize(
    ("where", "width"),
    [
        (cut(0, 0, -3.5), 1.0),  # the lower part is too narrow
        (cut(0, 0, 7.5), 1.0),  # the upper one is
        (cut(0, 0, 8.0), 0.0),  # on the face
        (cut(0, 0, -4.0), 0.0),
        (cut(0, 0, 12.0), 0.0),  # in another region
        (cut(0, 0, -9.0), 0.0),
        (cut(0, 0, np.nan), 0.0),
        (cut(4, 0, 0.0), 0.0),  # not an active region
        (cut(5, 1, 0.0), 0.0),
    ],
)
def test_split_refuses_and_leaves_everything_as_it_was(split, where, width):
    before = grid()
    after, done = split(before, where, width)
    assert not bool(done)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_split_accepts_parts_of_exactly_the_least_width(split):
    assert bool(split(grid(), cut(0, 0, -3.0), 1.0)[1])
    assert bool(split(grid(), cut(0, 0, 7.0), 1.0)[1])


def test_a_full_table_refuses_every_cut(split):
    full = grid()
    for dimension in (0, 1):
        full, done = split(full, cut(0, dimension, 0.0), 1.0)
        assert bool(done)
    assert int(full.count) == full.capacity
    after, done = split(full, cut(3, 0, 12.0), 1.0)
    assert not bool(done)
    jax.tree.map(np.testing.assert_array_equal, full, after)


def test_each_region_has_its_origin_in_that_of_which_it_was_cut(split):
    before = after = grid(max_regions=9)
    origin, splits = list(range(9)), []
    refused = cut(1, 0, 99.0)
    for where in [cut(2, 1, 3.0), cut(4, 0, 12.0), refused, cut(2, 0, 9.0), cut(0, 0, 0.0)]:
        child = after.count
        after, done = split(after, where, 1.0)
        splits.append(regions.Split(done, where, child))
        assert bool(done) == (where is not refused)
        if done:
            origin[int(child)] = origin[int(where.region)]
    change = regions.Change.of(before, after, jax.tree.map(lambda *parts: jnp.stack(parts), *splits))
    assert change.origin.tolist() == origin == [0, 1, 2, 3, 2, 2, 2, 0, 8]
    assert change.before is before and change.after is after


def test_inherit_copies_along_each_axis():
    table = np.arange(9.0).reshape(3, 3)
    expected = table.copy()
    expected[2] = expected[1]
    expected[:, 2] = expected[:, 1]
    np.testing.assert_array_equal(regions.inherit(jnp.asarray(table), jnp.array([0, 1, 1])), expected)
    expected = table[:, [0, 1, 1]]
    np.testing.assert_array_equal(regions.inherit(jnp.asarray(table), jnp.array([0, 1, 1]), axes=(1,)), expected)
