"""HRAC's adjacency: what counts as adjacent, what the network learns of it, and what it makes of the Tutor."""

import jax
import numpy as np
import pytest

from star.agent import adjacency
from star.config import loading

SPACE = ((-2.0, 0.0), (4.0, 3.5))  # 6 x 4 cells of side 1


def settings(**values):
    values = {"enabled": True, "hidden": [32], "features": 4, "batch_size": 64} | values
    return loading.parse({}, {f"tutor.adjacency.{key}": value for key, value in values.items()}).tutor.adjacency


LEARNING = settings(updates_per_epoch=300, learning_rate=1e-2)  # after which nothing changes any more


@pytest.fixture(scope="module")
def fresh():
    return jax.jit(lambda key: adjacency.init(key, settings(), SPACE))(jax.random.key(0))


def locate(points, **values):
    return np.asarray(jax.jit(lambda points: adjacency.locate(settings(**values), SPACE, points))(np.float32(points)))


@jax.jit
def train(chosen, state, key):
    return adjacency.train(chosen, state, SPACE, key=key)


def test_a_point_lies_in_the_cell_of_its_whole_coordinates_or_the_nearest():
    assert adjacency.shape(settings(), SPACE) == (6, 4)
    assert adjacency.shape(settings(cell=2), SPACE) == (3, 2)
    points = [[-2.0, 0.0], [-1.01, 0.99], [-1.0, 0.0], [0.5, 2.5], [99.0, -99.0]]
    assert locate(points).tolist() == [0, 0, 4, 10, 20]


def test_cells_of_one_decision_are_adjacent_and_those_after_its_end_are_not(fresh):
    rng = np.random.default_rng(0)
    path = rng.uniform(-2, 4, (4, 5, 2)).astype(np.float32)
    alive = np.ones((3, 5), np.float32)
    alive[1:, 2] = 0
    alive[2:, 3] = 0
    seen = jax.jit(lambda *walked: adjacency.observe(settings(), fresh, SPACE, *walked).adjacent)(path, alive)
    cell = locate(path)
    expected = np.zeros((24, 24), bool)
    for b in range(5):
        last = int(alive[:, b].sum())
        for s in range(last + 1):
            for t in range(s + 1, last + 1):
                expected[cell[s, b], cell[t, b]] = expected[cell[t, b], cell[s, b]] = True
    # Steps after the end count as a stay in the first cell.
    stays = np.eye(24, dtype=bool)
    np.testing.assert_array_equal(np.asarray(seen) & ~stays, expected & ~stays)


def test_the_network_learns_who_is_adjacent_and_prices_other_subgoals(fresh):
    # Agents move along x by one cell and never along y: rows are worlds of their own.
    cells = np.arange(24).reshape(6, 4)
    known = np.eye(24, dtype=bool)
    for x in range(5):
        known[cells[x], cells[x + 1]] = known[cells[x + 1], cells[x]] = True
    state, metrics = train(LEARNING, fresh.replace(adjacent=known), jax.random.key(1))
    assert float(metrics["share"]) == pytest.approx(known.sum() / 24**2)
    start, subgoal = np.float32([[-1.5, 0.5]] * 3), np.float32([[0.0, 0.0], [1.0, 0.0], [0.0, 3.0]])
    price = np.asarray(jax.jit(adjacency.penalty)(LEARNING, state, start, subgoal))
    assert float(price[0]) == 0 and float(price[1]) < 1 < float(price[2])


def test_nothing_known_teaches_nothing(fresh):
    state, metrics = train(LEARNING, fresh, jax.random.key(0))
    assert float(metrics["loss"]) == 0
    jax.tree.map(np.testing.assert_array_equal, state.params, fresh.params)
