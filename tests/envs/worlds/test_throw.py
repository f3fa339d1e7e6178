import jax
import numpy as np
import pytest

from envs import worlds
from envs.worlds import throw
from tests.envs.worlds import slow

WORLD = worlds.make("throw")
SHARES = (0.367, 0.0092)  # of 400,000 random movements, by task


def random_movements(n, seed=0):
    return np.asarray(jax.random.uniform(jax.random.key(seed), (n, 1, 9), minval=-1, maxval=1))


def test_it_agrees_with_a_slow_simulation_of_the_fall():
    shown = [np.asarray(WORLD.demonstrate(task, WORLD.benchmark(task))[0])[::8] for task in range(2)]
    slight = [np.clip(one + np.random.default_rng(0).normal(0, 0.02, one.shape), -1, 1) for one in shown]
    sequences = np.concatenate([*shown, *slight, random_movements(200)]).astype(np.float32)
    found = WORLD.execute(sequences, 1)
    expected = [slow.throw(sequence[0]) for sequence in sequences]
    np.testing.assert_array_equal(found.reached, [reached for _, reached in expected])
    np.testing.assert_allclose(found.value, [value for value, _ in expected], atol=1e-4)
    assert (np.asarray(found.reached).sum(axis=0) > 30).all()


@pytest.mark.parametrize("task", range(2))
def test_the_teacher_reaches_every_goal_of_the_evaluation(task):
    goals = WORLD.benchmark(task)
    sequences, lengths = WORLD.demonstrate(task, goals)
    found = WORLD.execute(sequences, lengths)
    assert 200 <= len(goals) <= 400 and np.abs(sequences).max() <= 1
    assert found.reached[:, task].all() and not found.reached[:, 1 - task].any()
    assert np.abs(found.value[:, task] - goals).max() < 1e-5


def test_random_movements_reach_each_task_as_often_as_the_page_says():
    n = 100_000
    found = WORLD.execute(random_movements(n, seed=7), 1)
    for count, share in zip(np.asarray(found.reached).sum(axis=0), SHARES, strict=True):
        assert abs(count - n * share) <= 4 * np.sqrt(n * share * (1 - share))
    assert (np.abs(found.value) <= 1).all() and not np.asarray(found.value)[~np.asarray(found.reached)].any()


def test_a_path_ends_where_the_ball_lands():
    sequences, lengths = WORLD.demonstrate("thrown", WORLD.benchmark("thrown")[:20])
    found = WORLD.trace(sequences, lengths)
    landed = np.concatenate([throw.FIELD * found.outcomes.value[:, 0, :2], np.zeros((20, 1))], axis=1)
    np.testing.assert_allclose(found.path.ball[:, -1], landed, atol=1e-4)
    assert found.path.free[:, -1].all() and not found.path.free[:, 0].any()


def test_a_placed_ball_stays_where_it_is():
    sequences, lengths = WORLD.demonstrate("placed", WORLD.benchmark("placed")[:20])
    path = WORLD.trace(sequences, lengths).path
    balls = np.asarray(path.ball)
    np.testing.assert_allclose(balls[:, -1, 2], throw.TABLE, atol=1e-4)
    np.testing.assert_allclose(balls[:, -30:], balls[:, -1:].repeat(30, axis=1), atol=1e-6)


def test_nothing_can_be_decomposed():
    assert not WORLD.decompose("placed", np.zeros(4)).exists
