"""The Controller's view, its moving subgoal and its reward."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from star.agent import checks, controller
from star.agent.subgoals import Boxes, Points
from star.agent.task import Task
from star.config import loading
from star.spec import Spec


def settings(**values):
    return loading.parse({"controller": values}).controller


def knowledge(*, abstract=(0, 1), heading=None, state_dim=12):
    """A body whose state is x, y, z, a quaternion, the velocity along x, y and z, and the rest."""
    d = len(abstract)
    return Spec(
        state_dim=state_dim,
        action_size=1,
        episode_length=1,
        abstract_indices=abstract,
        goal_indices=abstract,
        subgoal_scale=(1.0,) * d,
        space=((0.0,) * d, (1.0,) * d),
        region_cuts=((),) * d,
        success_radius=1.0,
        orientation=(3, 4, 5, 6),
        velocity=(7, 8),
        heading=heading,
    )


def task_of(spec, *, tutored=True):
    return Task.of(loading.parse({"tutor": {"enabled": tutored}}), spec)


def test_it_sees_the_state_without_position_then_the_subgoal():
    state, subgoal = jnp.arange(12.0).reshape(2, 6), jnp.array([[90.0, 91.0], [92.0, 93.0]])
    seen = controller.observe(settings(frame="world"), task_of(knowledge(abstract=(0, 2))), state, subgoal)
    np.testing.assert_array_equal(seen, [[1, 3, 4, 5, 90, 91], [7, 9, 10, 11, 92, 93]])


def turned(angle, vector):
    """[..., 2] turned by `angle` in rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(vector) @ np.array([[cos, sin], [-sin, cos]])


@cache
def seeing(abstract, heading):
    """What a Controller with the body's axes sees, compiled."""
    task = task_of(knowledge(abstract=abstract, heading=heading))
    return jax.jit(partial(controller.observe, settings(frame="body"), task))


@given(
    angle=st.floats(-9, 9),
    seed=st.integers(0, 99),
    sign=st.sampled_from([-1.0, 1.0]),
    layout=st.sampled_from([((0, 1), None), ((0, 1, 2), None), ((0, 1), 2.0), ((0, 1, 2), 3.0)]),
)
def test_in_the_bodys_axes_the_world_may_be_turned_about_it(angle, seed, sign, layout):
    rng = np.random.default_rng(seed)
    spec = knowledge(abstract=layout[0], heading=layout[1])
    state, subgoal = rng.normal(size=12), rng.normal(size=len(spec.scale))
    tilted = np.array([1.0, *rng.uniform(-0.3, 0.3, 2), 0.0])
    state[3:7] = tilted / np.linalg.norm(tilted)
    other, way, about = state.copy(), subgoal.copy(), np.zeros(4)
    mujoco.mju_axisAngle2Quat(about, np.array([0.0, 0, 1]), angle)
    mujoco.mju_mulQuat(other[3:7], about, state[3:7])
    other[3:7] *= sign  # the same orientation
    other[7:9], way[:2] = turned(angle, state[7:9]), turned(angle, subgoal[:2])
    if spec.heading:
        way[-2:] = turned(angle, subgoal[-2:])
    see = seeing(*layout)
    seen = see(jnp.asarray(state), jnp.asarray(subgoal))
    np.testing.assert_allclose(seen, see(jnp.asarray(other), jnp.asarray(way)), atol=1e-4)


def test_in_the_bodys_axes_what_is_ahead_comes_first_and_boxes_are_their_nearest_point_and_centre():
    half = np.sqrt(0.5)
    state = jnp.array([0.0, 0, 0.5, half, 0, 0, half, 0.0, 2.0, 0.3, 7.0, 8.0])  # faces +y, moves along it at 2 m/s
    box = jnp.array([-3.0, 1.0, 1.0, 5.0])
    seen = controller.observe(settings(frame="body"), task_of(knowledge(), tutored=False), state, box)
    np.testing.assert_allclose(seen, [0.5, 1, 0, 0, 0, 2, 0, 0.3, 7, 8, 1, 0, 3, 1], atol=1e-6)


def test_the_subgoal_stays_where_it_is_in_the_world():
    rng = np.random.default_rng(0)
    path = rng.normal(size=(20, 2)).astype(np.float32)
    first = subgoal = jnp.array([3.0, -2.0])
    for here, there in zip(path[:-1], path[1:], strict=True):
        subgoal = Points(2).moved(subgoal, here, there)
        np.testing.assert_allclose(there + subgoal, path[0] + first, atol=1e-5)


@pytest.mark.parametrize("reward", ["distance", "progress"])
def test_the_reward_follows_its_equation(reward):
    rng = np.random.default_rng(1)
    before, after = rng.normal(size=(2, 30, 2)).astype(np.float32)
    got = controller.reward(settings(reward=reward, reward_scale=0.5), task_of(knowledge()), before, after)
    for n in range(30):
        left = np.sqrt((after[n] ** 2).sum())
        expected = -left if reward == "distance" else np.sqrt((before[n] ** 2).sum()) - left
        np.testing.assert_allclose(got[n], 0.5 * expected, rtol=1e-4, atol=1e-6)


def test_a_box_in_place_of_a_subgoal_moves_whole_and_is_as_far_as_its_nearest_point():
    box = jnp.array([[1.0, -1.0, 3.0, 2.0], [-1.0, -1.0, 1.0, 1.0], [-9.0, 4.0, -3.0, 5.0]])  # lower, then upper
    boxes = Boxes(4, margin=1.0)
    np.testing.assert_allclose(boxes.distance(box), [1.0, 0.0, 5.0])
    moved = boxes.moved(box, jnp.zeros((3, 2)), jnp.array([[1.0, 2.0]] * 3))
    np.testing.assert_allclose(moved, box - np.array([1, 2, 1, 2]))
    paid = settings(reward="progress", reward_scale=1.0)
    got = controller.reward(paid, task_of(knowledge(), tutored=False), box, moved)
    np.testing.assert_allclose(got, [1.0, -1.0, 5.0 - np.hypot(4, 2)], rtol=1e-6)


@pytest.mark.parametrize("settings", [{"controller": {"frame": "body"}}, {"tutor": {"heading": 2.0}}])
@pytest.mark.parametrize("abstract", [(0, 2), (2, 3), (2,)])
def test_a_place_that_is_no_x_and_y_cannot_be_turned(settings, abstract):
    spec = knowledge(abstract=abstract, heading=settings.get("tutor", {}).get("heading"))
    what = "tutor.heading" if "tutor" in settings else "controller.frame: body"
    with pytest.raises(ValueError, match=f"{what}: turns x and y, which must be the first two numbers"):
        checks.check(loading.parse(settings), replace(spec, episode_length=500))


def test_a_body_that_faces_nowhere_has_no_axes_of_its_own():
    point = Spec.of(envs.make("point_maze"))
    with pytest.raises(ValueError, match="controller.frame: body, but the body has no orientation; allowed: world"):
        checks.check(loading.parse({"controller": {"frame": "body"}}), point)
    with pytest.raises(ValueError, match="controller.tilt_penalty: 2, but the body has no orientation; allowed: 0"):
        checks.check(loading.parse({"controller": {"tilt_penalty": 2.0}}), point)


def test_tilt_costs_by_the_cosine_between_the_bodys_up_axis_and_the_worlds():
    orientations = np.random.default_rng(2).normal(size=(50, 4))
    orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
    obs, expected = np.zeros((50, 14)), np.zeros(50)
    obs[:, 3:7] = orientations
    for n in range(50):
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, orientations[n])
        expected[n] = 3 * (1 - rotation[8])
    flat = settings(tilt_penalty=3.0, termination_penalty=0.0)
    cost = controller.price(flat, knowledge(), obs, np.ones(50), env_steps=0.0)
    np.testing.assert_allclose(cost, expected, atol=1e-5)


@pytest.mark.parametrize(("env_steps", "share"), [(0, 1 / 16), (1e6, 1 / 8), (2e6, 1 / 4), (4e6, 1), (9e6, 1)])
def test_the_price_of_tilts_rises_with_env_steps_and_that_of_terminations_does_not(env_steps, share):
    on_its_side = np.zeros((1, 14))
    on_its_side[:, 3:5] = np.sqrt(0.5)
    rising = settings(tilt_penalty=8.0, tilt_start=1 / 16, tilt_steps=4e6, termination_penalty=5.0)
    cost = controller.price(rising, knowledge(), on_its_side, np.ones(1), env_steps=env_steps)
    np.testing.assert_allclose(cost, 5 + 8 * share, rtol=1e-5)
