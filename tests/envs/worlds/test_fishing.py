import jax
import numpy as np
import pytest

from envs import worlds
from envs.worlds import fishing, rope
from tests.envs.worlds import slow
from tests.scripts import load

WORLD = worlds.make("fishing")
SHARE = 0.227  # of 400,000 random movements
N = 600  # one size of batch: it is compiled once


@pytest.fixture(scope="module")
def movements():
    """Random ones, and what came of them."""
    sequences = np.asarray(jax.random.uniform(jax.random.key(7), (N, 1, 25), minval=-1, maxval=1))
    return sequences, jax.device_get(WORLD.trace(sequences, 1))


def test_it_agrees_with_a_slow_simulation_in_steps_half_as_long(movements):
    sequences, found = movements
    reached = found.outcomes.reached[:, 0]
    some = np.concatenate([np.flatnonzero(reached)[:5], np.flatnonzero(~reached)[:1]])
    expected = slow.fishing(sequences[some, 0])
    assert np.isnan(expected[5:]).all()
    apart = np.linalg.norm(found.outcomes.value[some[:5], 0, :2] - expected[:5], axis=1) * fishing.FIELD
    assert np.median(apart) < 0.02 and (apart < 0.05).sum() >= 4  # where a float grazes the water, little decides


def test_the_line_is_never_longer_than_it_is_and_ends_at_the_tip_of_the_rod(movements):
    path = movements[1].path
    chain = np.concatenate([path.arm[:, :, 3:], path.line], axis=2)
    lengths = np.linalg.norm(np.diff(chain, axis=2), axis=-1)
    assert lengths.max() < rope.LENGTH / 2 + 1e-3
    assert (lengths[..., 1].min(axis=1) < 0.95 * rope.LENGTH / 2).mean() > 0.1  # it may be slack


def test_random_movements_reach_the_water_as_often_as_the_page_says_and_where_the_goals_are(movements):
    found = movements[1].outcomes
    assert abs(found.reached.sum() - N * SHARE) <= 4 * np.sqrt(N * SHARE * (1 - SHARE))
    assert (np.abs(found.value) <= 1).all() and not found.value[~found.reached].any()
    goals = np.asarray(WORLD.benchmark("float"))[:, :2]
    near = np.abs(found.value[found.reached][:, None, :2] - goals).max(axis=-1).min(axis=1) <= 1.001 / fishing.CELLS
    assert len(goals) == 160 and near.mean() > 0.99


def test_a_float_in_the_water_stays_where_it_is(movements):
    found = movements[1]
    landed = found.outcomes.reached[:, 0]
    assert (found.path.wet.any(axis=1) == landed).mean() > 0.99  # a few land beyond the field
    last, height = found.path.line[landed, -1, 1], found.path.line[..., 1, 2]
    np.testing.assert_allclose(last[:, :2], fishing.FIELD * found.outcomes.value[landed, 0, :2], atol=0.05)
    assert (height[~found.path.wet] > 0).all()


def test_the_teachers_casts_are_alike_but_for_their_size_and_come_down_near_the_goal():
    goals = WORLD.benchmark("float")
    sequences, lengths = WORLD.demonstrate("float", goals)
    controls = np.asarray(sequences)[:, 0, :24].reshape(-1, 6, 4)
    np.testing.assert_allclose(controls, controls[..., 3:] * np.array([0.25, 0.5, 0.75, 1]), atol=1e-6)
    filled = [np.resize(np.asarray(one), (N, *one.shape[1:])) for one in (sequences, lengths)]
    found = jax.device_get(WORLD.trace(*filled)).outcomes
    error = np.linalg.norm((found.value[: len(goals), 0] - goals)[:, :2], axis=1)
    assert found.reached.all() and np.median(error) < 0.25 and error.min() < 0.02


def test_a_scale_enlarges_the_bounds_of_goals_and_nothing_else():
    large = worlds.make("fishing", scale=10)
    assert large.upper.tolist() == [[10, 10, 0, 0]] and large.simulate is WORLD.simulate
    np.testing.assert_array_equal(large.benchmark("float"), WORLD.benchmark("float"))


def test_the_check_finds_that_mujoco_does_the_same(movements):
    """Two casts that land."""
    check = load("checks/worlds")
    sequences, found = movements
    kept = np.flatnonzero(found.outcomes.reached[:, 0])[:2]
    seen = check.fishing_apart(sequences[kept], jax.tree.map(lambda leaf: leaf[kept], found))
    assert max(seen["tip"]) < 0.02 and min(seen["float"]) < 0.05 and len(seen["float"]) == 2
