"""Verdicts on boxes under networks that are known exactly."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star import reachability
from star.reachability import MISSES, MIXED, REACHES, UNKNOWN, Leaves, Network

DEPTH = 5


def displaced(by):
    """X -> x + by, exactly."""
    by = jnp.asarray(by, jnp.float32)
    return Network(layers=((jnp.zeros((by.size, by.size)), by),), residual=True)


def f32(*arrays):
    return tuple(jnp.asarray(a, jnp.float32) for a in arrays)


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
            reach_share=reach_share,
            miss_share=miss_share,
            min_visits=min_visits,
        )

    def call(box, target, *, by=(0, 0), starts=None, seen=None, reach_share=0.999, miss_share=0.0, min_visits=0):
        starts = np.zeros((64, 2)) if starts is None else starts
        seen = np.ones(64) if seen is None else seen
        args = (*f32(by), f32(*box), f32(*target), *f32(starts, seen))
        return run(*args, reach_share, miss_share, min_visits)

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
    got = reachability.shares(*f32(lower, upper), f32(*target))
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
    assert int(reachability.judge(*f32((0.0,), (upper,)), target, reach_share=0.75, miss_share=0.1)) == verdict


def test_a_hull_that_covers_little_of_the_target_misses():
    target = f32((0.0,), (10.0,))
    judge = partial(reachability.judge, target=target, reach_share=0.7, miss_share=0.125)
    assert int(judge(*f32((-5.0,), (1.25,)))) == MISSES  # c2 is exactly the share that misses
    assert int(judge(*f32((-5.0,), (1.5,)))) == UNKNOWN


def test_smear_of_a_linear_map_is_exact():
    weight = np.array([[1.0, -2.0], [3.0, 0.5]])
    lower, upper = f32((0.0, 1.0), (2.0, 4.0))
    network = Network(layers=(f32(weight, np.zeros(2)),))
    np.testing.assert_allclose(reachability.smear(network, lower, upper), [4.0 * 1.0, 2.5 * 1.5], rtol=1e-6)
    residual = network.replace(residual=True)
    np.testing.assert_allclose(reachability.smear(residual, lower, upper), [5.0 * 1.0, 3.5 * 1.5], rtol=1e-6)


def test_an_unknown_part_is_halved_along_its_largest_smear():
    steep = Network(layers=(f32(np.diag([1.0, 10.0]), np.zeros(2)),))
    run = jax.jit(partial(reachability.examine, depth=1, reach_share=0.7, miss_share=0.1, min_visits=0))
    nobody = f32(np.zeros((1, 2)), np.ones(1))
    leaves = run(steep, f32((0, 0), (4, 2)), f32((0, 0), (4, 10)), *nobody)
    np.testing.assert_allclose(leaves.lower, [[0, 0], [0, 1]])
    np.testing.assert_allclose(leaves.upper, [[4, 1], [4, 2]])
    assert leaves.reaches.tolist() == [True, False]


@pytest.mark.parametrize("seed", range(6))
def test_leaves_tile_the_box_exactly(examine, seed):
    rng = np.random.default_rng(seed)
    box = (np.array([-1.0, 2.0]), np.array([-1.0, 2.0]) + 2.0 ** rng.integers(-2, 3, 2))
    leaves = examine(box, (rng.normal(size=2), 5 + rng.random(2)))
    lower, upper = np.float64(leaves.lower), np.float64(leaves.upper)
    assert len(lower) == 2**DEPTH
    assert (lower >= box[0]).all() and (upper <= box[1]).all()
    overlap = (np.maximum(lower[:, None], lower) < np.minimum(upper[:, None], upper)).all(-1)
    np.testing.assert_array_equal(overlap, np.eye(len(lower), dtype=bool))
    assert np.prod(upper - lower, axis=-1).sum() == np.prod(box[1] - box[0])  # powers of two: exact


@pytest.mark.parametrize("seed", range(8))
def test_a_leaf_reaches_where_all_of_it_is_carried_into_the_target(examine, seed):
    rng = np.random.default_rng(seed)
    by = rng.integers(-12, 13, 2) / 4
    box = (np.zeros(2), np.array([4.0, 8.0]))
    lower = rng.integers(-16, 20, 2) / 4
    target = (lower, lower + rng.integers(8, 28, 2) / 4)
    leaves = examine(box, target, by=by)
    for low, high, reaches in zip(*map(np.asarray, (leaves.lower, leaves.upper, leaves.reaches)), strict=True):
        image = by + rng.uniform(low, high, (4000, 2))
        inside = ((target[0] <= image) & (image <= target[1])).all(-1)
        assert reaches == inside.all()


def test_parts_that_stay_undecided_do_not_reach(examine):
    # Half of every part lands in the target: x is cut again and again, since it smears more.
    box, target = ((0, 0), (400, 1)), ((-1000, 0), (1000, 0.5))
    leaves = examine(box, target, reach_share=0.7, miss_share=1e-6)
    assert not leaves.reaches.any()
    assert int(reachability.summary(leaves)) == MISSES
    assert bool(examine(box, target, reach_share=0.4, miss_share=1e-6).reaches.all())


@pytest.mark.parametrize(("visits", "reaches"), [(9, False), (10, True)])
def test_a_part_reaches_only_with_enough_visited_starts(examine, visits, reaches):
    starts, seen = np.full((64, 2), 50.0), np.ones(64)
    starts[:visits] = 1.0
    starts[40:], seen[40:] = 1.0, 0.0  # slots of the buffer that hold nothing
    leaves = examine(((0, 0), (4, 4)), ((-9, -9), (9, 9)), starts=starts, seen=seen, min_visits=10)
    assert leaves.reaches.tolist() == [reaches] * 2**DEPTH


def test_starts_count_for_the_part_they_lie_in(examine):
    # Only x >= 2 lands in the target, and that half has too few visits, whatever there is in the other.
    starts = np.full((64, 2), 1.0)
    box, target = ((0, 0), (4, 4)), ((2, -9), (9, 9))
    assert not examine(box, target, starts=starts, min_visits=5).reaches.any()
    starts[:5, 0] = 2.0  # a start on the cut belongs to the upper half
    leaves = examine(box, target, starts=starts, min_visits=5)
    np.testing.assert_array_equal(leaves.reaches, np.asarray(leaves.lower)[:, 0] >= 2)
    assert leaves.visited[np.asarray(leaves.lower)[:, 0] >= 2].all() and not leaves.visited.all()


@pytest.mark.parametrize(
    ("reaches", "verdict"),
    [((True, True), REACHES), ((False, False), MISSES), ((True, False), MIXED), ((False, True), MIXED)],
)
def test_summary_of_leaves(reaches, verdict):
    assert int(reachability.summary(leaves_of(reaches, (True, False)))) == verdict


@pytest.mark.parametrize(
    ("reaches", "visited", "verdict"),
    [
        ((True, False), (True, False), REACHES),
        ((True, False), (False, True), MISSES),
        ((True, False), (True, True), MIXED),
        ((True, True), (False, False), UNKNOWN),
    ],
)
def test_summary_of_the_leaves_where_agents_have_been(reaches, visited, verdict):
    assert int(reachability.summary_of_visited(leaves_of(reaches, visited))) == verdict


def leaves_of(reaches, visited):
    corners = jnp.zeros((len(reaches), 1))
    return Leaves(lower=corners, upper=corners, reaches=jnp.array(reaches), visited=jnp.array(visited))
