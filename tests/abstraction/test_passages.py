"""Regions are cut where a wall makes two places of them, beside a slow count, and nowhere else."""

import jax
import numpy as np
import pytest

from star.abstraction import passages, regions
from star.abstraction.forward_model import Outcome
from star.abstraction.passages import ABLE, KEPT, LEAST, OVERLAP, PASSED, PLANES, TRIES

SPACE = ((0.0, 0.0), (16.0, 8.0))
CUTS = jax.jit(passages.cuts)
ROOM = 256  # for periods, most of them of weight 0, so that all tests share one program


def padded(array):
    """As many rows as there is room for, with rows of zeros after those of `array`."""
    return np.pad(array, [(0, ROOM - len(array)), *[(0, 0)] * (array.ndim - 1)])


def periods(start, end, weight=None):
    start, end = (np.asarray(points, np.float32).reshape(-1, 2) for points in (start, end))
    weight = np.ones(len(start), np.float32) if weight is None else np.asarray(weight, np.float32)
    start, end, weight = map(padded, (start, end, weight))
    return Outcome(start=start, lower=start, upper=start, end=end, weight=weight)


def halves(*, max_regions=4):
    """Two regions, [0, 8) and [8, 16] along x."""
    return regions.create(SPACE, ((8.0,), ()), max_regions=max_regions)


NOWHERE = periods([], [])
UNTRIED = passages.untried(capacity=4, dimensions=2)


def towards(start, goal, end):
    """Periods in which agents were given the box +-1 around a goal, and whether they ended in it."""
    start, goal, end = (np.asarray(points, np.float32).reshape(-1, 2) for points in (start, goal, end))
    sent = Outcome(start=start, lower=goal - 1, upper=goal + 1, end=end, weight=np.ones(len(start), np.float32))
    return jax.tree.map(padded, (sent, np.abs(end - goal).max(axis=1) <= 1))


def found(periods, goals=None, *, min_width=1.0):
    """(cut, evidence) of the region [0, 8)."""
    return later(UNTRIED, periods, goals, min_width=min_width)[:2]


def later(tries, periods, goals=None, *, min_width=1.0):
    """(cut, evidence) of the region [0, 8) after an epoch more, and the tries by then."""
    told = CUTS(halves(), periods, *(goals or towards([], [], [])), tries, min_width=min_width)
    cuts, evidence, tries = jax.device_get(told)
    return jax.tree.map(lambda x: x[0], cuts), float(evidence[0]), tries


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
    told = CUTS(abstraction, periods(start, end), *towards([], [], []), UNTRIED, min_width=1.0)
    cuts, evidence, _ = jax.device_get(told)
    start, end = start[moved], end[moved]
    ways = (*(np.clip(points[:, 0], 0, 15) // 8 for points in (start, end)), start, end)
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
    walked = periods(*two_rooms(np.random.default_rng(5)))
    cuts, evidence, _ = CUTS(halves(), walked, *towards([], [], []), UNTRIED, min_width=1.0)
    np.testing.assert_array_equal(evidence[2:], 0.0)
    assert np.isfinite(cuts.position).all()


def before_a_wall(rng, *, own=60, across=30, passing=0, able=1.0):
    """Goals in the same room below y = 3, of which a share is reached, and goals above y = 5, before which all stop."""
    start, goal = walking(rng, own + across, (0, 0), (8, 3))
    goal[own:, 1] += 5
    end = np.where(rng.uniform(size=len(start)) < able, goal.T, start.T).T
    stop = slice(own, own + across - passing)
    end[stop, 1] = 2.9
    return start, goal, end


def test_a_region_is_cut_between_agents_and_goals_that_they_never_reach():
    """Nobody has been beyond the wall."""
    start, goal, end = before_a_wall(np.random.default_rng(6))
    cut, evidence = found(periods(start, end), towards(start, goal, end))
    assert (int(cut.region), int(cut.dimension)) == (0, 1) and evidence == 30
    assert float(cut.position) == pytest.approx((2.9 + goal[60:, 1].min()) / 2, abs=8 / PLANES)


PASSABLE = {
    "enough pass": dict(passing=15),
    "agents reach few goals in their own room too": dict(able=0.4),
    "too few tries": dict(across=TRIES - 1),
    "too few goals in their own room": dict(own=4),
}


@pytest.mark.parametrize("case", PASSABLE)
def test_goals_that_are_not_reached_for_another_reason_cut_nothing(case):
    start, goal, end = before_a_wall(np.random.default_rng(7), **PASSABLE[case])
    assert found(NOWHERE, towards(start, goal, end))[1] == 0


def test_goals_in_another_region_and_ends_there_count_for_nothing():
    start, goal, end = before_a_wall(np.random.default_rng(8))
    across = slice(60, None)
    goal[across, 0] += 8
    assert found(NOWHERE, towards(start, goal, end))[1] == 0
    goal[across, 0] -= 8
    end[across] = (12, 7)  # beyond the plane, but in the other region
    assert found(NOWHERE, towards(start, goal, end))[1] == 30


@pytest.mark.parametrize(("own", "passing"), [(60, 2), (4, 1)])
@pytest.mark.parametrize("seed", range(3))
def test_planes_that_are_not_passed_are_those_of_a_slow_count(seed, own, passing):
    """With 4 goals in their own room it counts what agents reach in all regions."""
    rng = np.random.default_rng(seed)
    start, goal, end = before_a_wall(rng, passing=passing, own=own)
    more = [rng.uniform((0, 0), (16, 8), (20, 2)) for _ in range(3)]
    there = [rng.uniform((8, 0), (16, 8), (80, 2))] * 3  # all of these are reached
    tried = zip((start, goal, end), more, there, strict=True)
    start, goal, end = (np.concatenate(parts).astype(np.float32) for parts in tried)
    cut, evidence = found(NOWHERE, (sent := towards(start, goal, end)))
    within = (start[:, 0] < 8) & (goal[:, 0] < 8)
    reached = sent[1][: len(start)]
    everywhere = reached[(start[:, 0] < 8) == (goal[:, 0] < 8)].mean() >= ABLE
    counts = {}
    for dimension in range(2):
        for k in range(4, PLANES - 3):
            below = lambda points: points[:, dimension] < k / 4  # noqa: E731, B023
            across = within & (below(start) != below(goal))
            passed = across & (below(end) == below(goal)) & (end[:, 0] < 8)
            own = within & ~across
            able = (own & reached).sum() >= ABLE * own.sum() if own.sum() >= TRIES else everywhere
            if able and across.sum() >= TRIES and passed.sum() <= PASSED * across.sum():
                counts[dimension, k / 4] = across.sum()
    assert counts and evidence == max(counts.values())
    assert counts[int(cut.dimension), float(cut.position)] == evidence


def no_goals_on_their_side(rng, *, tries, elsewhere):
    """Agents just above a wall from y = 3 to 5 have goals below it; of the other region's a share is reached."""
    start = rng.uniform((0, 5), (8, 5.8), (tries, 2))
    goal = rng.uniform((0, 0), (8, 3), (tries, 2))
    there = rng.uniform((8, 0), (16, 8), (100, 2))
    moved = there + np.where(np.arange(100) < 100 * elsewhere, 0, 4)[:, None] * np.where(there > 4, -1, 1)
    both = lambda one, other: np.concatenate([one, other])  # noqa: E731
    return towards(both(start, there), both(goal, there), both(start, moved))


def test_where_no_goal_is_on_their_side_it_counts_what_agents_reach_elsewhere():
    """An agent may stand in a sliver of the goal's region, on the wrong side of a wall, in which goals never lie."""
    rng = np.random.default_rng(9)
    cut, evidence = found(NOWHERE, no_goals_on_their_side(rng, tries=TRIES, elsewhere=0.9))
    assert evidence == TRIES and int(cut.dimension) == 1 and 3 <= float(cut.position) <= 5
    assert found(NOWHERE, no_goals_on_their_side(rng, tries=TRIES, elsewhere=0.3))[1] == 0


def test_few_tries_an_epoch_add_up_and_fade():
    rng, tries, seen = np.random.default_rng(10), UNTRIED, []
    for _ in range(5):
        _, evidence, tries = later(tries, NOWHERE, no_goals_on_their_side(rng, tries=4, elsewhere=0.9))
        seen.append(evidence)
    counted = [4 * sum(KEPT**k for k in range(n)) for n in range(1, 6)]
    assert seen == [int(n) if n >= TRIES else 0 for n in counted]
    assert seen[0] == 0 < seen[-1]
    for _ in range(5):
        _, evidence, tries = later(tries, NOWHERE, no_goals_on_their_side(rng, tries=0, elsewhere=0.9))
    np.testing.assert_allclose(tries.beyond[0, 1].max(), counted[-1] * KEPT**5, rtol=1e-5)
    assert evidence == 0
