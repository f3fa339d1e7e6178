"""A Commander whose targets are the nearest regions, against one whose targets are all regions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from envs.common.errors import UserError
from star.abstraction import regions
from star.abstraction.forward_model import Outcome
from star.abstraction.regions import Change, Near, Places
from star.agent import commander, planning, q_learning, values
from star.agent.decisions import Decision, Finished, Roadmap, Successors
from star.agent.values import CommanderState, Model
from star.config import loading

R, S, N = 7, 3, 60

plan, settle = jax.jit(planning.plan), jax.jit(planning.settle, static_argnames="periods")
observe, learn, recounted = jax.jit(planning.observe), jax.jit(q_learning.observe), jax.jit(planning.recounted)


def settings(**values):
    return loading.parse({"commander": {"prior": 2.0, "sweeps": 3, "discount": 0.9} | values}).commander


def lists(rng):
    """Near regions at random, the own one among them; in NumPy."""
    others = [rng.permutation([j for j in range(R) if j != i])[: S - 1] for i in range(R)]
    return jax.device_get(Near.of(np.sort([[i, *others[i]] for i in range(R)], axis=1).astype(np.int32)))


def spread(table, near, *, axes, rows):
    """The table of all regions that says the same about those that are near, and 0 of others."""
    for axis in axes:
        moved = np.moveaxis(table, (rows, axis), (0, 1))
        wide = np.zeros((R, R, *moved.shape[2:]), table.dtype)
        for i in range(R):
            wide[i, near.region[i]] = moved[i]
        table = np.moveaxis(wide, (0, 1), (rows, axis))
    return table


def gathered(table, near, *, axes, rows):
    """What a table of all regions says of those that are near."""
    for axis in axes:
        moved = np.moveaxis(table, (rows, axis), (0, 1))
        table = np.moveaxis(np.stack([moved[i, near.region[i]] for i in range(R)]), (0, 1), (rows, axis))
    return table


CELLS = {
    "led": {"rows": 1, "axes": (2, 3)},
    "lost": {"rows": 1, "axes": (2,)},
    "rewards": {"rows": 0, "axes": (1, 2)},
    "visits": {"rows": 0, "axes": (1, 2)},
}


def decisions(rng, near):
    """Random ones among regions that are near; where the goal is not, nothing is earned."""
    region, goal = rng.integers(0, R, (2, N)).astype(np.int32)
    beside = lambda: near.region[region, rng.integers(0, S, N)]  # noqa: E731
    goal = np.where(rng.random(N) < 0.5, goal, beside())
    return Decision(
        region=region,
        goal_region=goal,
        target=np.where((rng.random(N) < 0.3) & (near.place[region, goal] < S), goal, beside()),
        reward=np.where(near.place[region, goal] < S, rng.random(N), 0.0).astype(np.float32),
        next_region=beside(),
        weight=(rng.random(N) < 0.7).astype(np.float32),
        lost=(rng.random(N) < 0.2).astype(np.float32),
        aside=(rng.random(N) < 0.2).astype(np.float32),
        goal=np.zeros((N, 2), np.float32),
    )


def roadmaps(rng, near):
    """One of near targets and one of all, which allow and believe the same."""
    allowed, believed = rng.random((2, R, S)) < 0.6
    allowed |= near.region == np.arange(R)[:, None]
    wide = lambda mask: spread(mask, near, axes=(1,), rows=0)  # noqa: E731
    some = Roadmap(abstraction=None, allowed=Successors(near, allowed, allowed), believed=believed)
    every = Successors(Near.every(R), wide(allowed), wide(allowed))
    return some, Roadmap(abstraction=None, allowed=every, believed=wide(believed))


@pytest.mark.parametrize("seed", range(3))
def test_plans_are_those_of_a_commander_that_may_choose_the_same_targets(seed):
    rng = np.random.default_rng(seed)
    near = lists(rng)
    few, all_ = settings(nearest=S), settings()
    batch, (some, every) = decisions(rng, near), roadmaps(rng, near)
    states = [
        observe(section, commander.init(section, regions=R), roadmap, batch)
        for section, roadmap in ((few, some), (all_, every))
    ]
    for name, where in CELLS.items():
        found, expected = (np.asarray(getattr(state.model, name)) for state in states)
        np.testing.assert_array_equal(found, gathered(expected, near, **where), err_msg=name)
    one, other = plan(few, states[0], some), plan(all_, states[1], every)
    assert np.ptp(one.q) > 0.5
    settled = settle(few, states[0], some, periods=4), settle(all_, states[1], every, periods=4)
    for found, expected in ((one.q, other.q), [state.q for state in settled]):
        table = gathered(np.asarray(expected), near, axes=(2,), rows=0)
        np.testing.assert_allclose(found, table, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("goals", [[3], [6, 0, 3], [5, 5, 1, 2, 4, 0]], ids=str)
def test_plans_for_some_goals_are_those_for_all_and_other_goals_keep_theirs(monkeypatch, goals):
    monkeypatch.setattr(planning, "_TOGETHER", 2)  # so that parts are full and not full, and none is the whole
    rng = np.random.default_rng(0)
    near, section = lists(rng), settings(nearest=S)
    roadmap, _ = roadmaps(rng, near)
    state = observe(section, commander.init(section, regions=R), roadmap, decisions(rng, near))
    state = state.replace(q=rng.random((R, R, S)).astype(np.float32))
    every = plan(section, state, roadmap).q
    found = jax.jit(planning.plan)(section, state, roadmap, goals=jnp.asarray(goals)).q
    np.testing.assert_allclose(found[:, goals], every[:, goals], rtol=1e-6)
    changed = np.flatnonzero((np.asarray(found) != state.q).any(axis=(0, 2)))
    assert set(goals) <= set(changed) and len(changed) <= len(set(goals)) + 1  # the last part is filled up


def test_a_command_that_leads_further_is_not_counted():
    rng = np.random.default_rng(0)
    near = lists(rng)
    some, _ = roadmaps(rng, near)
    batch = decisions(rng, near).replace(weight=np.ones(N, np.float32), lost=np.zeros(N, np.float32))
    far = batch.replace(next_region=np.argmax(near.place[batch.region] == S, axis=1).astype(np.int32))
    section = settings(nearest=S)
    model = observe(section, commander.init(section, regions=R), some, far).model
    assert not np.asarray(model.led).any() and np.asarray(model.visits).any()


@pytest.mark.parametrize("seed", range(3))
def test_after_cuts_tables_say_the_same_of_what_was_near_and_is(seed):
    rng = np.random.default_rng(seed)
    then, now, origin = lists(rng), lists(rng), np.array([0, 1, 2, 1, 4, 4, 6])
    sizes = {"led": (2, R, S, S), "lost": (2, R, S), "rewards": (R, S, S), "visits": (R, S, S)}
    earlier = Model(**{name: 3 * rng.random(size, np.float32) for name, size in sizes.items()})
    wide = Model(**{name: spread(getattr(earlier, name), then, **where) for name, where in CELLS.items()})
    cells, traffic = decisions(rng, now), rng.integers(0, 3, (R, R)).astype(np.float32)
    places, every = Places(origin, then, now), Places(origin, Near.every(R), Near.every(R))
    sure = settings(nearest=S, prior=1e6), settings(prior=1e6)  # else more is forgotten of what led far
    found = recounted(sure[0], earlier, cells, cells, places, traffic)
    expected = recounted(sure[1], wide, cells, cells, every, traffic)
    for name in ("led", "lost", "rewards", "visits"):
        table = gathered(np.asarray(getattr(expected, name)), now, **CELLS[name])
        np.testing.assert_allclose(getattr(found, name), table, rtol=1e-5, atol=1e-6, err_msg=name)
    q = rng.random((R, R, S), np.float32)
    inherited = values.inherited(q, places)
    table = values.inherited(spread(q, then, axes=(2,), rows=0), every)
    np.testing.assert_array_equal(inherited, gathered(np.asarray(table), now, axes=(2,), rows=0))


def test_q_learning_and_choices_are_those_among_the_same_targets():
    rng = np.random.default_rng(0)
    near = lists(rng)
    (some, every), batch = roadmaps(rng, near), decisions(rng, near)
    q, shown = rng.normal(size=(R, R, S)).astype(np.float32), (rng.random(N) < 0.3).astype(np.float32)
    narrow = CommanderState(q=q, chosen=np.zeros(R, np.float32))
    wide = narrow.replace(q=spread(q, near, axes=(2,), rows=0) - 100 * spread(q == 0, near, axes=(2,), rows=0))
    section, batch = settings(learner="q", nearest=S), batch.replace(shown=shown)
    found, expected = learn(section, narrow, some, batch), learn(section, wide, every, batch)
    table = gathered(np.asarray(expected.q), near, axes=(2,), rows=0)
    taught = np.zeros((R, R), bool)  # all a row's values are compared with there, also of what is far
    taught[batch.region[shown > 0], batch.goal_region[shown > 0]] = True
    np.testing.assert_allclose(np.asarray(found.q)[~taught], table[~taught], rtol=1e-5)
    for goal in range(R):
        for one, other in zip(
            values.towards(narrow, some.allowed, goal), values.towards(wide, every.allowed, goal), strict=True
        ):
            np.testing.assert_array_equal(one, other)
    where, goal = rng.integers(0, R, (2, 300))
    chosen = values.choose(narrow, some.allowed, where, goal, epsilon=0.5, key=jax.random.key(0))
    assert (near.place[where, chosen] < S).all()
    rows, _ = np.unique(np.stack([where, chosen]), axis=1)
    assert len(np.unique(rows)) == R


def test_the_nearest_regions_are_those_with_the_smallest_gap_the_own_one_always():
    table = regions.create(((0.0, 0.0), (10.0, 20.0)), ((1.1, 2.7, 6.2), (4.3, 10.9)), max_regions=15)
    near = jax.device_get(jax.jit(partial(regions.near, number=5))(table))
    size = np.array([10.0, 20.0])
    lower, upper = np.asarray(table.lower)[:12] / size, np.asarray(table.upper)[:12] / size
    for i in range(12):
        away = []
        for j in range(12):
            gap = np.maximum(np.maximum(lower[i] - upper[j], lower[j] - upper[i]), 0)
            centres = (lower[i] + upper[i] - lower[j] - upper[j]) / 2
            away.append((np.hypot(*gap) + 1e-3 * np.hypot(*centres), j))
        away[i] = (-1, i)
        assert near.region[i].tolist() == sorted(j for _, j in sorted(away)[:5])
        for j in range(15):
            place = near.place[i, j]
            assert (place == 5) if j not in near.region[i] else near.region[i, place] == j
    assert (near.region[12:] == np.arange(12, 15)[:, None]).any(axis=1).all()
    everything = jax.device_get(regions.near(table, None))
    np.testing.assert_array_equal(everything.region, np.tile(np.arange(15), (15, 1)))
    np.testing.assert_array_equal(everything.place, everything.region)


def test_distances_pay_far_from_the_goal_so_they_need_all_targets():
    with pytest.raises(
        UserError, match=r"commander: nearest: 4, but reward mean pays far from the goal; allowed: null"
    ):
        settings(nearest=4, reward="mean")
    with pytest.raises(UserError, match=r"commander\.nearest: 1 is not allowed"):
        settings(nearest=1)


def test_the_commander_follows_cuts_by_what_was_near_before_and_is_after_them():
    before = regions.create(((0.0, 0.0), (6.0, 2.0)), ((1.0, 2.0, 3.0, 4.0), ()), max_regions=R)
    after, splits = before, []
    for region, place in ((1, 1.5), (4, 5.0)):
        one = regions.Cut(jnp.int32(region), jnp.int32(0), jnp.float32(place))
        child = after.count
        after, done = regions.split(after, one, min_width=0.1)
        splits.append(regions.Split(done=done, cut=one, child=child))
    change = Change.of(before, after, jax.tree.map(lambda *x: jnp.stack(x), *splits))
    then, now = (jax.device_get(regions.near(table, S)) for table in (before, after))
    assert (then.region != now.region).any()
    rng = np.random.default_rng(0)
    centre = (np.asarray(after.lower) + np.asarray(after.upper)) / 2
    cells = decisions(rng, now)
    finished = Finished(
        cells.replace(goal=centre[cells.goal_region].astype(np.float32)),
        Outcome(*(centre[cells.region].astype(np.float32),) * 3, centre[cells.next_region], cells.weight),
    )
    q = rng.random((R, R, S)).astype(np.float32)
    states = []
    for section, table in ((settings(nearest=S), q), (settings(), spread(q, then, axes=(2,), rows=0))):
        state = commander.init(section, regions=R)
        state = state.replace(q=jnp.asarray(table))
        traffic = np.zeros((R, R), np.float32)
        states.append(jax.jit(commander.follow)(section, state, change, state, finished, traffic))
    found, expected = states
    assert np.asarray(found.model.led).any()
    for name, where in CELLS.items():
        table = gathered(np.asarray(getattr(expected.model, name)), now, **where)
        np.testing.assert_allclose(getattr(found.model, name), table, rtol=1e-5, err_msg=name)
    np.testing.assert_array_equal(found.q, gathered(np.asarray(expected.q), now, axes=(2,), rows=0))
