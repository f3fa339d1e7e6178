"""The Controller's view, its moving subgoal and its reward."""

import jax.numpy as jnp
import numpy as np
import pytest

from star import controller, loading


def settings(**values):
    return loading.parse({"controller": values}).controller


def test_it_sees_the_state_without_position_then_the_subgoal():
    state, subgoal = jnp.arange(12.0).reshape(2, 6), jnp.array([[90.0, 91.0], [92.0, 93.0]])
    seen = controller.observe(state, subgoal, position=(0, 2))
    np.testing.assert_array_equal(seen, [[1, 3, 4, 5, 90, 91], [7, 9, 10, 11, 92, 93]])


def test_the_subgoal_stays_where_it_is_in_the_world():
    rng = np.random.default_rng(0)
    path = rng.normal(size=(20, 2)).astype(np.float32)
    first = subgoal = jnp.array([3.0, -2.0])
    for here, there in zip(path[:-1], path[1:], strict=True):
        subgoal = controller.next_subgoal(subgoal, here, there)
        np.testing.assert_allclose(there + subgoal, path[0] + first, atol=1e-5)


@pytest.mark.parametrize("reward", ["distance", "progress"])
def test_the_reward_follows_its_equation(reward):
    rng = np.random.default_rng(1)
    before, after = rng.normal(size=(2, 30, 2)).astype(np.float32)
    got = controller.reward(settings(reward=reward, reward_scale=0.5), before, after, size=2)
    for n in range(30):
        left = np.sqrt((after[n] ** 2).sum())
        expected = -left if reward == "distance" else np.sqrt((before[n] ** 2).sum()) - left
        np.testing.assert_allclose(got[n], 0.5 * expected, rtol=1e-4, atol=1e-6)


def test_a_box_in_place_of_a_subgoal_moves_whole_and_is_as_far_as_its_nearest_point():
    box = jnp.array([[1.0, -1.0, 3.0, 2.0], [-1.0, -1.0, 1.0, 1.0], [-9.0, 4.0, -3.0, 5.0]])  # lower, then upper
    np.testing.assert_allclose(controller.distance(box, size=2), [1.0, 0.0, 5.0])
    moved = controller.next_subgoal(box, jnp.zeros((3, 2)), jnp.array([[1.0, 2.0]] * 3))
    np.testing.assert_allclose(moved, box - np.array([1, 2, 1, 2]))
    got = controller.reward(settings(reward="progress", reward_scale=1.0), box, moved, size=2)
    np.testing.assert_allclose(got, [1.0, -1.0, 5.0 - np.hypot(4, 2)], rtol=1e-6)
