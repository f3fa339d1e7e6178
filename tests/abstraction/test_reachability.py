"""Verdicts on boxes under networks that are known exactly."""

from functools import partial

import jax
import numpy as np
import pytest

from star.abstraction import reachability
from star.abstraction.reachability import MISSES, MIXED, REACHES, UNKNOWN, Leaves, Network

DEPTH = 5


def displaced(by):
    """X -> x + by, exactly."""
    return Network(layers=((np.zeros((by.size, by.size), np.float32), by),), residual=True)


def f32(*arrays):
    return tuple(np.asarray(a, np.float32) for a in arrays)


# Compiled once, not each time that a test calls them.
shares, smear, summary = (jax.jit(one) for one in (reachability.shares, reachability.smear, reachability.summary))
judge, reaches_where_visited = jax.jit(reachability.judge), jax.jit(reachability.reaches_where_visited)


@pytest.fixture(scope="module")
def examine():
    """`examine` of a displacement, everything but shapes traced."""

    @jax.jit
    def run(by, box, target, starts, seen, reach_share, miss_share, min_visits):
        return reachability.examine(
            displaced(by),
            box,
            target,
            starts,
            seen,
            depth=DEPTH,
            parts=2**DEPTH,
            reach_share=reach_share,
            miss_share=miss_share,
            min_visits=min_visits,
        )

    def call(box, target, *, by=(0, 0), starts=None, seen=None, reach_share=0.999, miss_share=0.0, min_visits=0):
        starts = np.zeros((64, 2)) if starts is None else starts
        seen = np.ones(64) if seen is None else seen
        args = (*f32(by), f32(*box), f32(*target), *f32(starts, seen))
        return jax.device_get(run(*args, reach_share, miss_share, min_visits))

    return call


@pytest.mark.parametrize(
    ("lower", "upper", "target", "c1", "c2"),
    [
        ((0, 0), (2, 2), ((0, 0), (4, 4)), 1, 0.25),
        ((0, 0), (4, 4), ((0, 0), (2, 2)), 0.25, 1),
        ((0, 0), (2, 2), ((1, 0), (3, 2)), 0.5, 0.5),
        ((0, 0), (2, 2), ((1, 1), (5, 3)), 0.25, 0.125),
        ((0, 0), (2, 2), ((5, 0), (6, 2)), 0, 0),
        ((0, 0), (2, 2), ((2, 0), (4, 2)), 0, 0),  # touching faces share no volume
        ((0, 1), (2, 1), ((1, 0), (3, 2)), 0.5, 0.5),  # flat in y, inside: only x counts
        ((0, 3), (2, 3), ((1, 0), (3, 2)), 0, 0),  # flat in y, outside
        ((1, 1), (1, 1), ((0, 0), (2, 2)), 1, 1),  # a point inside
        ((3, 1), (3, 1), ((0, 0), (2, 2)), 0, 0),  # a point outside
        ((1, 2), (1, 2), ((0, 0), (2, 2)), 1, 1),  # a point on the face
    ],
)
def test_shares_by_hand(lower, upper, target, c1, c2):
    got = np.asarray(shares(*f32(lower, upper), f32(*target)))
    np.testing.assert_allclose(got, (c1, c2), rtol=1e-6)


@pytest.mark.parametrize(
    ("upper", "verdict"),
    [
        (8.0, REACHES),  # c1 = 1
        (10.0, REACHES),  # c1 = .8
        (16.0, UNKNOWN),  # c1 = .5, c2 = 1
        (0.5, REACHES),  # within a small part of the target: it reaches, though c2 is small
    ],
)
def test_judge_by_hand(upper, verdict):
    target = f32((0.0,), (8.0,))
    assert int(judge(*f32((0.0,), (upper,)), target, reach_share=0.75, miss_share=0.1)) == verdict


def test_a_hull_that_covers_little_of_the_target_misses():
    target = f32((0.0,), (10.0,))
    judged = partial(judge, target=target, reach_share=0.7, miss_share=0.125)
    assert int(judged(*f32((-5.0,), (1.25,)))) == MISSES  # c2 is exactly the share that misses
    assert int(judged(*f32((-5.0,), (1.5,)))) == UNKNOWN


def test_smear_of_a_linear_map_is_exact():
    weight = np.array([[1.0, -2.0], [3.0, 0.5]])
    lower, upper = f32((0.0, 1.0), (2.0, 4.0))
    network = Network(layers=(f32(weight, np.zeros(2)),))
    np.testing.assert_allclose(smear(network, lower, upper), [4.0 * 1.0, 2.5 * 1.5], rtol=1e-6)
    residual = network.replace(residual=True)
    np.testing.assert_allclose(smear(residual, lower, upper), [5.0 * 1.0, 3.5 * 1.5], rtol=1e-6)


def test_an_unknown_part_is_halved_along_its_largest_smear():
    steep = Network(layers=(f32(np.diag([1.0, 10.0]), np.zeros(2)),))
    run = jax.jit(partial(reachability.examine, depth=1, parts=2, reach_share=0.7, miss_share=0.1, min_visits=0))
    nobody = f32(np.zeros((1, 2)), np.ones(1))
    leaves = run(steep, f32((0, 0), (4, 2)), f32((0, 0), (4, 10)), *nobody)
    np.testing.assert_allclose(leaves.lower, [[0, 0], [0, 1]])
    np.testing.assert_allclose(leaves.upper, [[4, 1], [4, 2]])
    assert leaves.reaches.tolist() == [True, False]


def used(leaves):
    """Lower and upper corners and whether they reach, of the parts in use."""
    return tuple(
        np.asarray(x, np.float64)[np.asarray(leaves.used)] for x in (leaves.lower, leaves.upper, leaves.reaches)
    )


@pytest.mark.parametrize("seed", range(6))
def test_leaves_tile_the_box_exactly(examine, seed):
    rng = np.random.default_rng(seed)
    box = (np.array([-1.0, 2.0]), np.array([-1.0, 2.0]) + 2.0 ** rng.integers(-2, 3, 2))
    lower, upper, _ = used(examine(box, (rng.normal(size=2), 5 + rng.random(2))))
    assert 1 <= len(lower) <= 2**DEPTH
    assert (lower >= box[0]).all() and (upper <= box[1]).all()
    overlap = (np.maximum(lower[:, None], lower) < np.minimum(upper[:, None], upper)).all(-1)
    np.testing.assert_array_equal(overlap, np.eye(len(lower), dtype=bool))
    assert np.prod(upper - lower, axis=-1).sum() == np.prod(box[1] - box[0])  # powers of two: exact


@pytest.mark.parametrize("seed", range(8))
def test_leaves_are_those_of_a_plain_recursion(examine, seed):
    rng = np.random.default_rng(seed)
    by = rng.integers(-12, 13, 2) / 4
    lower = rng.integers(-16, 20, 2) / 4
    target = (lower, lower + rng.integers(8, 28, 2) / 4)
    starts = rng.uniform(0, (4, 8), (64, 2))
    found = used(
        examine((np.zeros(2), np.array([4.0, 8.0])), target, by=by, starts=starts, min_visits=3, miss_share=1e-4)
    )

    def recurse(low, high, depth):
        visits = ((low <= np.float32(starts)) & (np.float32(starts) < high)).all(-1).sum()
        overlap = np.prod(np.maximum(np.minimum(high + by, target[1]) - np.maximum(low + by, target[0]), 0))
        if overlap >= 0.999 * np.prod(high - low):
            return [(*low, *high, visits >= 3)]
        if overlap == 0 or depth == 0 or visits < 3:
            return [(*low, *high, False)]
        axis = np.argmax(high - low)
        middle = np.where(np.arange(2) == axis, (low + high) / 2, high)
        return recurse(low, middle, depth - 1) + recurse(np.where(middle < high, middle, low), high, depth - 1)

    assert sorted(recurse(np.zeros(2), np.array([4.0, 8.0]), DEPTH)) == sorted(
        (*low, *high, bool(r)) for low, high, r in zip(*found, strict=True)
    )


def test_where_room_is_scarce_the_parts_with_most_visits_are_halved():
    # Every point is carried by +4 along x, so that of [0, 8] only [0.25, 7.75] reaches [4.25, 11.75]: both halves are
    # mixed, and there is room to halve only one of them. Nobody was in what is left of the other.
    move = displaced(*f32(np.full(1, 4.0)))
    corners = f32([0.0], [8.0]), f32([4.25], [11.75])
    how = {"depth": 2, "parts": 3, "reach_share": 0.999, "miss_share": 0.0, "min_visits": 1}
    examined = jax.jit(partial(reachability.examine, move, **how))
    for few, many in (([1.0], [6.0]), ([6.0], [1.0])):
        starts, seen = f32(np.array([few] * 5 + [many] * 9), np.ones(14))
        leaves = jax.device_get(examined(*corners, starts, seen))
        lower, upper, _ = used(leaves)
        halved = 0.0 if many == [1.0] else 4.0
        assert sorted(zip(lower[:, 0], upper[:, 0], strict=True)) == sorted(
            [(4.0 - halved, 8.0 - halved), (halved, halved + 2), (halved + 2, halved + 4)]
        )


def test_early_rounds_of_halving_leave_room_for_later_ones():
    # All of [0, 16] is mixed at every depth; the part visited most is still halved in the last round.
    starts, seen = f32(np.concatenate([np.full((99, 1), 0.1), np.linspace(0.2, 15.8, 64)[:, None]]), np.ones(163))
    how = {"depth": 6, "parts": 12, "reach_share": 2.0, "miss_share": 0.0, "min_visits": 1}
    examined = jax.jit(partial(reachability.examine, displaced(*f32(np.zeros(1))), **how))
    leaves = examined(f32([0.0], [16.0]), f32([-99.0], [99.0]), starts, seen)
    lower, upper, _ = used(leaves)
    assert len(lower) == 12
    assert (upper - lower).min() == 16 / 2**6


def test_parts_that_stay_undecided_do_not_reach(examine):
    # Half of every part lands in the target: x is cut again and again, since it smears more.
    box, target = ((0, 0), (400, 1)), ((-1000, 0), (1000, 0.5))
    leaves = examine(box, target, reach_share=0.7, miss_share=1e-6)
    assert not leaves.reaches.any()
    assert int(summary(leaves)) == MISSES
    assert used(examine(box, target, reach_share=0.4, miss_share=1e-6))[2].all()


@pytest.mark.parametrize(("visits", "reaches"), [(9, False), (10, True)])
def test_a_part_reaches_only_with_enough_visited_starts(examine, visits, reaches):
    starts, seen = np.full((64, 2), 50.0), np.ones(64)
    starts[:visits] = 1.0
    starts[40:], seen[40:] = 1.0, 0.0  # slots of the buffer that hold nothing
    leaves = examine(((0, 0), (4, 4)), ((-9, -9), (9, 9)), starts=starts, seen=seen, min_visits=10)
    assert used(leaves)[2].tolist() == [reaches]


def test_starts_count_for_the_part_they_lie_in(examine):
    # Only x >= 2 lands in the target, and that half has too few visits, whatever there is in the other.
    starts = np.full((64, 2), 1.0)
    box, target = ((0, 0), (4, 4)), ((2, -9), (9, 9))
    assert not examine(box, target, starts=starts, min_visits=5).reaches.any()
    starts[:5, 0] = 2.0  # a start on the cut belongs to the upper half
    leaves = examine(box, target, starts=starts, min_visits=5)
    right = np.asarray(leaves.used & (leaves.lower[:, 0] >= 2))
    assert right.any()
    np.testing.assert_array_equal(leaves.reaches, right)
    assert leaves.visited[right].all()


@pytest.mark.parametrize(
    ("reaches", "verdict"),
    [((True, True), REACHES), ((False, False), MISSES), ((True, False), MIXED), ((False, True), MIXED)],
)
def test_summary_of_leaves(reaches, verdict):
    assert int(summary(leaves_of(reaches, (True, False)))) == verdict


@pytest.mark.parametrize(
    ("reaches", "visited", "whole"),
    [
        ((True, False), (True, False), True),
        ((True, False), (True, True), False),
        ((False, False), (True, False), False),
        ((False, False), (False, False), False),
    ],
)
def test_whether_all_leaves_reach_where_agents_have_been(reaches, visited, whole):
    assert bool(reaches_where_visited(leaves_of(reaches, visited))) == whole


def leaves_of(reaches, visited):
    corners = np.zeros((len(reaches) + 1, 1), np.float32)
    masks = (np.array([*mask, False]) for mask in (reaches, visited, [True] * len(reaches)))  # one place not in use
    return Leaves(corners, corners, *masks)
