"""Regions are cut where a wall makes two places of them, beside a slow count, and nowhere else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import passages, regions
from star.abstraction.forward_model import Outcome
from star.abstraction.passages import LEAST, OVERLAP, PLANES

SPACE = ((0.0, 0.0), (16.0, 8.0))
CUTS = jax.jit(passages.cuts)


def periods(start, end, weight=None):
    start, end = (np.asarray(points, np.float32).reshape(-1, 2) for points in (start, end))
    weight = np.ones(len(start), np.float32) if weight is None else np.asarray(weight, np.float32)
    return Outcome(start=start, lower=start, upper=start, end=end, weight=weight)


def halves(*, max_regions=4):
    """Two regions, [0, 8) and [8, 16] along x."""
    return regions.create(SPACE, ((8.0,), ()), max_regions=max_regions)


def found(periods, *, min_width=1.0):
    """(cut, evidence) of the region [0, 8)."""
    cuts, evidence = CUTS(halves(), periods, min_width=min_width)
    return jax.tree.map(lambda x: x[0], cuts), float(evidence[0])


def walking(rng, n, low, high):
    """Starts and ends anywhere between two corners."""
    return rng.uniform(low, high, (n, 2)), rng.uniform(low, high, (n, 2))


def two_rooms(rng, n=60):
    """Agents walk above a wall from y = 3 to 5, and below it; nobody goes through."""
    lower, upper = walking(rng, n, (0, 0), (8, 3)), walking(rng, n, (0, 5), (8, 8))
    return np.concatenate([lower[0], upper[0]]), np.concatenate([lower[1], upper[1]])


def test_a_region_is_cut_in_the_middle_of_a_wall_through_it():
    cut, evidence = found(periods(*two_rooms(np.random.default_rng(0))))
    assert (int(cut.region), int(cut.dimension)) == (0, 1)
    assert float(cut.position) == pytest.approx(4.0, abs=8 / PLANES)
    assert 45 <= evidence <= 60  # those that moved


def test_an_open_room_is_not_cut():
    rng = np.random.default_rng(1)
    assert found(periods(*walking(rng, 200, (0, 0), (8, 8))))[1] == 0


def test_a_few_that_find_a_way_around_do_not_hide_a_wall_and_many_do():
    start, end = two_rooms(np.random.default_rng(2))
    around = lambda n: periods(  # noqa: E731
        np.concatenate([start, np.tile([4, 2], (n, 1))]), np.concatenate([end, np.tile([4, 6], (n, 1))])
    )
    assert found(around(2))[1] > 0
    assert found(around(40))[1] == 0


def test_places_from_which_agents_go_the_same_way_are_one():
    """Nobody crosses the middle of a corridor that all hurry through; from both halves they get to the other region."""
    rng = np.random.default_rng(3)
    start = rng.uniform((0, 0), (8, 8), (100, 2))
    assert found(periods(start, np.tile([12, 4], (100, 1))))[1] == 0
    apart = np.where(start[:, :1] < 4, [[0, 0]], [[12, 4]])  # the left half stays, the right half leaves
    cut, evidence = found(periods(start, apart))
    assert evidence > 0 and int(cut.dimension) == 0


NOTHING = {
    "too few on one side": ({}, dict(weight=np.arange(120) % 60 < LEAST - 1)),
    "who stands tells nothing": ({}, dict(stand=True)),
    "weight 0": ({}, dict(weight=0.0)),
    "too narrow": (dict(min_width=4.5), {}),
}


@pytest.mark.parametrize("case", NOTHING)
def test_without_evidence_or_room_nothing_is_cut(case):
    options, change = NOTHING[case]
    start, end = two_rooms(np.random.default_rng(4))
    if change.get("stand"):
        end = start + 0.1
    assert found(periods(start, end, np.ones(len(start)) * change.get("weight", 1.0)), **options)[1] == 0


def slow_overlap(began, there, start, end, region, dimension, position):
    """The overlap of the two sides of a plane, and the starts on either; periods began and ended in these regions."""
    places = {True: [], False: []}
    for i in np.flatnonzero(began == region):
        below = there[i] == region and end[i][dimension] < position
        places[start[i][dimension] < position].append((there[i], below))
    low, high = places[True], places[False]
    share = lambda place, side: side.count(place) / max(len(side), 1)  # noqa: E731
    return sum(min(share(place, low), share(place, high)) for place in {*low, *high}), len(low), len(high)


@pytest.mark.parametrize("seed", range(3))
def test_cuts_are_those_of_a_slow_count(seed):
    rng = np.random.default_rng(seed)
    abstraction = halves()
    start, end = two_rooms(rng, 40)
    more = walking(rng, 30, (0, 0), (16, 8))
    start, end = (np.concatenate([a, b]).astype(np.float32) for a, b in ((start, more[0]), (end, more[1])))
    moved = np.abs(end - start).max(axis=1) >= 1.0
    cuts, evidence = CUTS(abstraction, periods(start, end), min_width=1.0)
    start, end = start[moved], end[moved]
    ways = (*(np.asarray(regions.locate(abstraction, points)) for points in (start, end)), start, end)
    lower, upper = np.asarray(abstraction.lower), np.asarray(abstraction.upper)
    for region in range(2):
        best = 0
        for dimension in range(2):
            side = upper[region, dimension] - lower[region, dimension]
            for k in range(1, PLANES):
                position = lower[region, dimension] + k / PLANES * side
                wide = min(k / PLANES * side, (1 - k / PLANES) * side) >= 1.0
                overlap, *numbers = slow_overlap(*ways, region, dimension, position)
                if wide and min(numbers) >= LEAST and overlap <= OVERLAP:
                    best = max(best, min(numbers))
        assert float(evidence[region]) == best
        if best:
            chosen = (region, int(cuts.dimension[region]), float(cuts.position[region]))
            overlap, *numbers = slow_overlap(*ways, *chosen)
            assert overlap <= OVERLAP + 1e-6 and min(numbers) == best


def test_regions_not_in_use_are_not_cut():
    cuts, evidence = CUTS(halves(), periods(*two_rooms(np.random.default_rng(5))), min_width=1.0)
    np.testing.assert_array_equal(evidence[2:], 0.0)
    assert jnp.isfinite(cuts.position).all()
