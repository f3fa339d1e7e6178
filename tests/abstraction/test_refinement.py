"""When a pair is examined, where a region is cut, and what is remembered of it."""

import itertools
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import cutting, forward_model, refinement, regions
from star.abstraction.forward_model import Outcome
from star.abstraction.passages import KEPT, PLANES, Tries
from star.abstraction.reachability import MISSES, REACHES, UNKNOWN, Leaves
from star.abstraction.refinement import Graph
from star.abstraction.regions import Cut, Split
from star.config import loading
from star.learners import replay

R = 6
SPACE = ((-4.0, -4.0), (20.0, 20.0))


def settings(**values):
    refine = {"min_transitions": 10, "min_visits": 5, "depth": 5, "pairs_per_epoch": 1, "miss_lifetime": 2}
    refine |= {"separate": False}
    # `min_width` and the like are traced, so overrides of floats compile nothing.
    model = {"hidden": [4], "buffer_size": 2000}
    values = {f"refinement.{key}": value for key, value in refine.items()} | values
    return loading.parse({"forward_model": model, "abstraction": {"max_regions": R}}, values).hyper()


CONFIG = settings()
EAGER = settings(
    **{
        "refinement.miss_lifetime": 0,
        "refinement.cuts_per_pair": 2,
        "refinement.separate": True,
    }
)  # compiled once for what each of them changes


def put(array, index, value):
    """A copy of `array` with another `value` at `index`."""
    array = np.array(array)
    array[index] = value
    return array


@cache
def grid(cuts=((8.0,), (8.0,))):
    return jax.device_get(regions.create(SPACE, cuts, max_regions=R))


def begun():
    """A graph that knows nothing."""
    return jax.device_get(refinement.init(capacity=R, dimensions=2))


# Compiled once, not each time that a test calls them.
due = jax.jit(refinement.due)
tell = jax.jit(refinement.tell)
locate = jax.jit(jax.vmap(regions.locate, in_axes=(None, 0)))
add = jax.jit(replay.add)


@jax.jit
def observe(chosen, graph, region, target, error, weight):
    return refinement.observe(chosen, graph, region=region, target=target, error=error, weight=weight)


def random_graph(seed):
    rng = np.random.default_rng(seed)
    return Graph(
        verdict=rng.integers(0, 3, (R, R)).astype(np.int32),
        age=rng.integers(0, 4, (R, R)).astype(np.int32),
        transitions=rng.integers(0, 21, (R, R)).astype(np.float32),
        error=rng.random((R, R)).astype(np.float32),
        stable=rng.random((R, R)) < 0.5,
        told=rng.integers(-1, 2, (R, R)).astype(np.int32),
        tries=Tries(*rng.integers(0, 9, (4, R, 2, PLANES - 1)).astype(np.float32)),
    )


def knowing(*pairs, transitions=100.0):
    """A graph in which `pairs` have passed the gate."""
    graph = begun()
    for pair in pairs:
        graph = graph.replace(
            transitions=put(graph.transitions, pair, transitions), stable=put(graph.stable, pair, True)
        )
    return graph


@pytest.fixture(scope="module")
def moving():
    """A forward model that is known exactly: whatever is commanded, `by` is added; visits lie everywhere."""
    init = jax.jit(lambda key: forward_model.init(key, CONFIG.forward_model, space=jnp.array(SPACE)))
    state = jax.device_get(init(jax.random.key(0)))
    example, _ = replay.contents(state.ring)
    starts = np.random.default_rng(1).uniform(-4, 20, (2000, 2)).astype(np.float32)
    ring = jax.device_get(add(state.ring, example.replace(start=starts, weight=np.ones(2000, np.float32))))

    def make(by):
        params = jax.tree.map(np.zeros_like, state.params)
        params["params"]["Dense_1"]["bias"] = np.float32(by) / 12
        return state.replace(params=params, ring=ring)

    return make


NO_GOALS = Outcome(*np.zeros((4, 2, 2), np.float32), weight=np.zeros(2, np.float32))
RADIUS = 3.0 / 2**0.5


@pytest.fixture(scope="module")
def refine():
    """Returns the regions after it, the graph, the splits and the metrics."""
    jitted = jax.jit(refinement.refine)

    def call(chosen, abstraction, graph, model, goals=NO_GOALS):
        found = jitted(chosen, abstraction, graph, model, goals, cube=RADIUS, key=jax.random.key(0))
        graph, change, metrics = jax.device_get(found)
        jax.tree.map(np.testing.assert_array_equal, change.before, abstraction)
        return change.after, graph, change.splits, metrics

    return call


def test_observe_counts_and_compares_errors_pair_by_pair():
    graph = random_graph(0)
    rng = np.random.default_rng(1)
    n = 50
    region, target = rng.integers(0, 4, (2, n))
    error, weight = rng.random(n).astype(np.float32), (rng.random(n) < 0.6).astype(np.float32)
    chosen = settings(**{"refinement.error_tolerance": 0.2})
    after = jax.device_get(observe(chosen, graph, region, target, error, weight))
    for i in range(R):
        for j in range(R):
            mine = [error[k] for k in range(n) if weight[k] and (region[k], target[k]) == (i, j)]
            assert float(after.transitions[i, j]) == float(graph.transitions[i, j]) + len(mine)
            if mine:
                np.testing.assert_allclose(after.error[i, j], np.mean(mine), rtol=1e-5)
                assert bool(after.stable[i, j]) == (not np.mean(mine) < 0.8 * float(graph.error[i, j]))
            else:
                assert float(after.error[i, j]) == float(graph.error[i, j])
                assert bool(after.stable[i, j]) == bool(graph.stable[i, j])


def test_an_error_measured_for_the_first_time_is_not_yet_stable():
    pair, number = np.zeros((2, 50), np.int32), np.zeros(50, np.float32)
    pair[1], weight = 1, put(number, 0, 1.0)
    once = lambda graph: jax.device_get(observe(CONFIG, graph, *pair, number + 3, weight))  # noqa: E731
    graph = once(begun())
    assert not bool(graph.stable[0, 1])
    assert bool(once(graph).stable[0, 1])


GATE = {
    "all conditions met": ({}, True),
    "too few transitions": ({"transitions": 9.0}, False),
    "an error that still falls": ({"stable": False}, False),
    "known to reach": ({"verdict": REACHES}, False),
    "known to miss": ({"verdict": MISSES}, False),
}


@pytest.mark.parametrize("name", GATE)
def test_the_gate(name):
    changes, passes = GATE[name]
    graph = knowing((0, 1), transitions=10.0)
    for field, value in changes.items():
        graph = graph.replace(**{field: put(getattr(graph, field), (0, 1), value)})
    waiting = np.asarray(due(CONFIG, graph, np.arange(R) < 4))
    assert bool(waiting[0, 1]) == passes
    assert int(waiting.sum()) == passes


@pytest.mark.parametrize("within", [True, False])
def test_the_gate_keeps_out_inactive_regions_and_if_told_so_a_region_as_its_own_target(within):
    graph = knowing((1, 1), (0, 4), (4, 0), (2, 3))
    waiting = np.asarray(due(settings(**{"refinement.within": within}), graph, np.arange(R) < 4))
    assert np.argwhere(waiting).tolist() == [[1, 1], [2, 3]][not within :]


def test_misses_are_forgotten_after_their_lifetime_and_edges_are_not():
    graph = knowing((0, 1), (0, 2))
    graph = graph.replace(verdict=put(put(graph.verdict, (0, 1), MISSES), (0, 2), REACHES))
    forget = jax.jit(refinement.forget)
    seen = []
    for _ in range(4):
        graph = jax.device_get(forget(CONFIG, graph))
        seen.append((int(graph.verdict[0, 1]), int(graph.verdict[0, 2]), float(graph.transitions[0, 1])))
    assert seen == [(MISSES, REACHES, 100.0)] * 2 + [(UNKNOWN, REACHES, 0.0)] * 2


def slow_gain(lower, upper, leaves, dimension, position):
    """Decrease of Gini impurity by one cut of the box, as a share of the volume of all leaves."""

    def impurity(low, high):
        whole = reaching = 0.0
        for a, b, reaches in zip(*leaves, strict=True):
            volume = np.prod(np.maximum(np.minimum(b, high) - np.maximum(a, low), 0))
            whole, reaching = whole + volume, reaching + volume * reaches
        return reaching * (whole - reaching) / whole if whole else 0.0

    below, above = upper.copy(), lower.copy()
    below[dimension] = above[dimension] = position
    total = sum(np.prod(b - a) for a, b, _ in zip(*leaves, strict=True))
    return (impurity(lower, upper) - impurity(lower, below) - impurity(above, upper)) / total


@pytest.fixture(scope="module")
def best_cut():
    return jax.jit(lambda a, c, leaves, width: cutting.best_cut(a, c, leaves, min_width=width))


@pytest.mark.parametrize("seed", range(5))
def test_the_best_cut_is_that_of_a_brute_force_gini_search(best_cut, seed):
    rng = np.random.default_rng(seed)
    # The leaves tile [-4, 8] x [-4, 20], which is regions 0 and 1; only one of them may be cut in odd cases.
    edges = np.array([[x, y] for x in range(4) for y in range(8)], float)
    lower, upper = -4 + 3 * edges, -1 + 3 * edges
    score = edges @ rng.normal(size=2) + 0.3 * rng.normal(size=32)
    reaches = score > np.median(score)
    leaves = lower, upper, reaches
    abstraction, candidates = grid(), [0] if seed % 2 else [0, 1]
    best = 0.0
    for region in candidates:
        low, high = np.float64(abstraction.lower[region]), np.float64(abstraction.upper[region])
        for dimension in (0, 1):
            for position in np.unique(upper[:, dimension]):
                if low[dimension] + 2 <= position <= high[dimension] - 2:
                    best = max(best, slow_gain(low, high, leaves, dimension, position))
    everywhere = np.ones(len(reaches), bool)
    given = Leaves(np.float32(lower), np.float32(upper), reaches, everywhere, everywhere)
    cut, gain = jax.device_get(best_cut(abstraction, np.isin(np.arange(R), candidates), given, 2.0))
    np.testing.assert_allclose(gain, best, rtol=1e-4, atol=1e-6)
    assert best > 0 and int(cut.region) in candidates
    low, high = np.float64(abstraction.lower[cut.region]), np.float64(abstraction.upper[cut.region])
    got = slow_gain(low, high, leaves, int(cut.dimension), float(cut.position))
    np.testing.assert_allclose(got, best, rtol=1e-4)
    assert low[cut.dimension] + 2 <= cut.position <= high[cut.dimension] - 2


def split_of(done):
    """Region 1 was cut, or not, which made region 4."""
    cut = Cut(region=np.int32(1), dimension=np.int32(0), position=np.float32(0))
    return Split(done=np.array(done), cut=cut, child=np.int32(4))


def test_after_a_split_starts_inherit_verdicts_and_targets_begin_anew():
    graph, on_split = random_graph(2), jax.jit(refinement.on_split)
    after = jax.device_get(on_split(graph, split_of(True)))
    for i in range(R):
        for j in range(R):
            changed = i in (1, 4) or j in (1, 4)
            old = (1 if i == 4 else i, 1 if j == 4 else j)
            assert int(after.verdict[i, j]) == (UNKNOWN if j in (1, 4) else int(graph.verdict[old]))
            assert float(after.transitions[i, j]) == (0 if changed else float(graph.transitions[i, j]))
            assert float(after.error[i, j]) == float(graph.error[old])
            assert bool(after.stable[i, j]) == bool(graph.stable[old])
            assert int(after.told[i, j]) == (min(int(graph.told[old]), 0) if changed else int(graph.told[old]))
        for before, now in zip(jax.tree.leaves(graph.tries), jax.tree.leaves(after.tries), strict=True):
            np.testing.assert_array_equal(now[i], 0 if i in (1, 4) else before[i])
    unchanged = on_split(graph, split_of(False))
    jax.tree.map(np.testing.assert_array_equal, graph, unchanged)


def told_by_loop(before, visited):
    """What `refinement.tell` makes of lists of regions, one for each way."""
    runs = [[a for a, b in zip(way, [None, *way], strict=False) if a != b] for way in visited]
    direct = {pair for run in runs for pair in itertools.pairwise(run)}
    around = {(run[i], run[j]) for run in runs for i in range(len(run)) for j in range(i + 2, len(run))}
    expected = np.array(before)
    for i, j in itertools.product(range(R), range(R)):
        if (i, j) in around and expected[i, j] < 1:
            expected[i, j] = -1
        if (i, j) in direct:
            expected[i, j] = 1
    return expected


@pytest.mark.parametrize("seed", range(3))
def test_teachers_tell_where_they_go_directly_and_where_only_around(seed):
    rng, table = np.random.default_rng(seed), grid()
    before = random_graph(seed).replace(told=(rng.integers(-1, 2, (R, R)) * (seed > 0)).astype(np.int32))
    paths = rng.uniform(-4, 20, (3, 4, 2)).astype(np.float32)
    weight = np.float32([1.0, 0.0, 1.0])
    after = tell(before, table, paths, weight)
    visited = [locate(table, path).tolist() for path in paths[weight > 0]]
    np.testing.assert_array_equal(after.told, told_by_loop(before.told, visited))
    assert seed > 0 or (np.asarray(after.told) != 0).any()


def test_a_way_around_a_wall_says_that_there_is_none_through_it():
    """Regions 0 to 3 are lower left, upper left, lower right, upper right, and the way goes by the right."""
    way = np.float32([[0.0, 0.0], [16.0, 0.0], [16.0, 16.0], [0.0, 16.0]])
    told = np.asarray(tell(begun(), grid(), np.stack([way] * 3), np.ones(3, np.float32)).told)
    first, *_, last = locate(grid(), way).tolist()
    assert int(told[first, last]) == -1 and int(told[last, first]) == 0
    assert int((told == 1).sum()) == 3


def test_a_region_of_which_a_part_reaches_is_cut_where_that_part_begins(refine, moving):
    # +6 along x carries [2, 8] of region 0 = [-4, 8]^2 into region 2 = [8, 20] x [-4, 8], and [-4, 2] does not.
    abstraction, graph, splits, metrics = refine(CONFIG, grid(), knowing((0, 2)), moving((6, 0)))
    assert (int(metrics["examined"]), int(metrics["mixed"]), int(metrics["splits"])) == (1, 1, 1)
    assert int(abstraction.count) == 5
    np.testing.assert_allclose(abstraction.upper[0], [2, 8], atol=1e-5)
    np.testing.assert_allclose(abstraction.lower[4], [2, -4], atol=1e-5)
    np.testing.assert_allclose(abstraction.upper[4], [8, 8], atol=1e-5)
    assert splits.done.tolist() == [True]
    assert (int(splits.parent[0]), int(splits.child[0])) == (0, 4)
    assert not (graph.verdict != UNKNOWN).any()
    assert float(graph.transitions[0, 2]) == 0


def test_the_parts_get_verdicts_and_a_miss_is_examined_again_after_its_lifetime(refine, moving):
    model = moving((6, 0))
    abstraction, *_ = refine(CONFIG, grid(), knowing((0, 2)), model)
    graph = knowing((0, 2), (4, 2))
    found = []
    for _ in range(5):
        abstraction, graph, _, metrics = refine(CONFIG, abstraction, graph, model)
        found.append((int(graph.verdict[4, 2]), int(graph.verdict[0, 2]), int(metrics["examined"])))
    assert int(abstraction.count) == 5
    # One pair an epoch, the first of equals; the miss of epoch 1 lives two more, then needs new transitions.
    assert found == [
        (UNKNOWN, MISSES, 1),
        (REACHES, MISSES, 1),
        (REACHES, MISSES, 0),
        (REACHES, UNKNOWN, 0),
        (REACHES, UNKNOWN, 0),
    ]


def test_misses_without_a_lifetime_are_not_recorded(refine, moving):
    model, graph = moving((-6, 0)), knowing((0, 2))
    assert int(refine(CONFIG, grid(), graph, model)[1].verdict[0, 2]) == MISSES
    _, graph, _, metrics = refine(EAGER, grid(), graph, model)
    assert int(metrics["examined"]) == 1 and int(graph.verdict[0, 2]) == UNKNOWN


@pytest.mark.parametrize(("quantity", "much"), [("transitions", 500.0), ("age", 5)])
def test_first_comes_the_pair_commanded_most_or_that_has_waited_longest(refine, moving, quantity, much):
    graph = knowing((0, 2), (1, 3))
    if quantity == "age":  # although the other one was commanded more often
        graph = graph.replace(transitions=put(graph.transitions, (0, 2), 200.0))
    graph = graph.replace(**{quantity: put(getattr(graph, quantity), (1, 3), much)})
    _, graph, _, metrics = refine(CONFIG, grid(), graph, moving((12, 0)))
    assert int(graph.verdict[1, 3]) == REACHES
    assert int(graph.verdict[0, 2]) == UNKNOWN
    assert int(metrics["edges"]) == 1


def test_a_region_nobody_started_in_does_not_reach(refine, moving):
    model = moving((12, 0))
    items, _ = replay.contents(model.ring)
    elsewhere = items.replace(start=np.full_like(items.start, 15.0))
    _, graph, _, _ = refine(CONFIG, grid(), knowing((0, 2)), model.replace(ring=add(model.ring, elsewhere)))
    assert int(graph.verdict[0, 2]) == MISSES


def test_nothing_is_examined_before_a_pair_is_due(refine, moving):
    before = grid()
    abstraction, graph, splits, metrics = refine(CONFIG, before, knowing(), moving((6, 0)))
    jax.tree.map(np.testing.assert_array_equal, before, abstraction)
    assert int(metrics["examined"]) == 0 and not splits.done.any()
    assert not (graph.verdict != UNKNOWN).any()


def test_a_full_table_is_reported_and_stays_as_it_is(refine, moving):
    full = grid(cuts=((8.0,), (0.0, 8.0)))
    assert int(full.count) == R
    abstraction, _, splits, metrics = refine(CONFIG, full, knowing((0, 3)), moving((6, 0)))
    assert int(metrics["table_full"]) == 1 and int(metrics["mixed"]) == 1 and int(metrics["splits"]) == 0
    assert not splits.done.any()
    jax.tree.map(np.testing.assert_array_equal, full, abstraction)


@pytest.mark.parametrize(("min_width", "count"), [(6.5, 4), (5.5, 5)])
def test_no_region_is_cut_narrower_than_min_width(refine, moving, min_width, count):
    chosen = settings(**{"abstraction.min_width": min_width})
    abstraction, _, _, metrics = refine(chosen, grid(), knowing((0, 2)), moving((6, 0)))
    assert int(metrics["mixed"]) == 1
    assert int(abstraction.count) == count


@pytest.mark.parametrize(("target", "by"), [(2, (6, 0)), (3, (6, 6))])
@pytest.mark.parametrize(("everywhere", "verdict"), [(False, REACHES), (True, UNKNOWN)])
def test_where_no_cut_is_made_there_is_an_edge_if_all_parts_that_agents_visit_reach(
    refine, moving, target, by, everywhere, verdict
):
    # Only from x >= 2, and y >= 2, region 0 is carried into regions 2 and 3. Its parts would be narrower than 6.5.
    chosen = settings(**{"abstraction.min_width": 6.5})
    model = moving(by)
    items, _ = replay.contents(model.ring)
    starts = items.start if everywhere else np.where(items.start < 2, items.start + 6, items.start)
    model = model.replace(ring=add(model.ring, items.replace(start=starts)))
    _, graph, _, metrics = refine(chosen, grid(), knowing((0, target)), model)
    assert int(metrics["mixed"]) == 1 and int(metrics["splits"]) == 0
    assert int(graph.verdict[0, target]) == verdict


@pytest.mark.parametrize(("target", "by"), [(2, (6, 0)), (3, (6, 6))])
def test_targets_cut_a_region_that_touch_it_or_do_not(refine, moving, target, by):
    _, graph, _, metrics = refine(CONFIG, grid(), knowing((0, target)), moving(by))  # regions 0 and 3 share a corner
    assert int(metrics["splits"]) == 1
    assert int(graph.verdict[0, target]) == UNKNOWN  # agents have been all over the region, and only a part reaches


def test_a_region_is_cut_besides_where_nobody_passes_and_the_graph_follows(refine, moving):
    """Agents stay in the corner of [-4, 8)^2 in which they are."""
    model = moving((0, 0))
    start = np.random.default_rng(2).uniform(-4, 8, (2000, 2)).astype(np.float32)
    end = np.where(start[:, :1] < 2, np.float32([-3.0, 2.0]), np.float32([7.0, 2.0]))
    items, _ = replay.contents(model.ring)
    periods = items.replace(start=start, end=end, weight=np.ones(2000, np.float32))
    model = model.replace(ring=add(model.ring, periods))
    graph = random_graph(1).replace(stable=np.zeros((R, R), bool))  # no pair is examined
    after, _, splits, metrics = refine(CONFIG, grid(), graph, model)
    assert int(after.count) == 4 and int(metrics["separated"]) == 0 == int(splits.done.sum())
    after, told, splits, metrics = refine(EAGER, grid(), graph, model)
    assert int(metrics["separated"]) == 1 == int(splits.done.sum()) and int(metrics["splits"]) == 1
    assert int(after.count) == 5
    new = [np.asarray(corner)[4].tolist() for corner in (after.lower, after.upper)]
    assert new == [[pytest.approx(2.0, abs=12 / 32), -4.0], [8.0, 8.0]]
    assert (np.asarray(told.verdict)[:, [0, 4]] == UNKNOWN).all()
    counts = np.asarray(told.tries.beyond)  # of the cut region anew; no goal was tried in this epoch
    assert not counts[[0, 4]].any()
    np.testing.assert_allclose(counts[1:4], KEPT * graph.tries.beyond[1:4])
    assert (np.asarray(told.transitions)[[0, 4]] == 0).all()


def test_an_examined_pair_may_make_several_cuts(refine, moving):
    # +6 along both axes: only the upper right quarter of region 0 reaches region 3, which takes two cuts to part.
    abstraction, _, splits, _ = refine(EAGER, grid(), knowing((0, 3)), moving((6, 6)))
    assert splits.done.tolist() == [True, True, *[False] * R]  # none besides where nobody passes
    corners = np.concatenate([abstraction.lower, abstraction.upper], axis=1)
    assert [2, 2, 8, 8] in corners.tolist()


def goal_boxes(*centres, reached=()):
    """Periods towards goals with boxes of +-1; those whose numbers are in `reached` ended there."""
    centre, start = np.float32(centres), np.full((len(centres), 2), -100.0, np.float32)
    mask = np.isin(np.arange(len(centres)), reached)
    end = np.where(mask[:, None], centre, start)
    return Outcome(start, centre - 1, centre + 1, end, weight=np.ones(len(centres), np.float32))


def test_a_region_that_reaches_a_goal_inside_it_only_from_a_part_is_cut(refine, moving):
    # +6 along x carries (-1.9, ...) to (4.1, ...): the square around (6, 2) inside the circle of 3 is +-2.12.
    goals = goal_boxes((6.0, 2.0), (6.0, 2.0))
    abstraction, graph, _, metrics = refine(CONFIG, grid(), knowing((0, 0)), moving((6, 0)), goals)
    assert (int(metrics["examined"]), int(metrics["mixed"]), int(metrics["splits"])) == (1, 1, 1)
    assert int(abstraction.count) == 5
    assert not (graph.verdict != UNKNOWN).any()


def test_no_goal_inside_no_verdict_and_no_cut(refine, moving):
    goals = goal_boxes((14.0, 2.0), (14.0, 2.0))  # in region 2
    abstraction, graph, _, metrics = refine(CONFIG, grid(), knowing((0, 0)), moving((6, 0)), goals)
    assert int(abstraction.count) == 4 and int(metrics["mixed"]) == 0
    assert not (graph.verdict != UNKNOWN).any()
    assert float(graph.transitions[0, 0]) < 100  # others get their turn


def test_a_goal_that_was_reached_is_preferred(refine, moving):
    # Nothing reaches (-3, 2) when all moves go to the right by 6; the outcome shows which goal was drawn.
    lost, met = (-3.0, 2.0), (6.0, 2.0)
    for reached, count in (((0,), 4), ((1,), 5)):
        goals = goal_boxes(lost, met, reached=reached)
        assert int(refine(CONFIG, grid(), knowing((0, 0)), moving((6, 0)), goals)[0].count) == count


def test_goals_count_as_reached_within_the_circle_of_success():
    box = np.full((3, 2), 5.0, np.float32)
    end = np.float32([[5.0, 7.0], [5.0, 7.2], [6.9, 3.1]])
    goals = Outcome(start=box, lower=box - 1, upper=box + 1, end=end, weight=np.ones(3, np.float32))
    assert jax.jit(refinement.reached)(goals, RADIUS).tolist() == [True, False, True]


def test_random_cuts_come_at_the_same_time_but_anywhere(refine, moving):
    chosen = settings(**{"refinement.cuts": "random"})
    jitted = jax.jit(refinement.refine)
    positions = set()
    for seed in range(8):
        _, change, metrics = jitted(
            chosen, grid(), knowing((0, 2)), moving((6, 0)), NO_GOALS, cube=RADIUS, key=jax.random.key(seed)
        )
        assert int(metrics["mixed"]) == int(metrics["splits"]) == 1 and int(change.splits.parent[0]) == 0
        positions.add(tuple(np.asarray(change.after.lower[4]).tolist()))
    assert len(positions) > 3
