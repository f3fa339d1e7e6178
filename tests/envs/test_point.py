import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs.point import Point, PointState
from envs.tasks import TASKS

WALLS = TASKS["point_maze"].arena.walls()
POINT = Point(TASKS["point_maze"])
RADIUS, MAX_SPEED = TASKS["point_maze"].motion.radius, TASKS["point_maze"].motion.speed
STEPS = 50


@jax.jit
def positions(start, velocity, actions):
    """Positions [T, n, 2] of n points under the actions [T, n, 2]."""

    def step(data, action):
        data = jax.vmap(POINT.step)(data, action)
        return data, data.position

    return jax.lax.scan(step, PointState(position=start, velocity=velocity, open=jnp.zeros(len(start))), actions)[1]


def touches(position):
    """Whether a square of half-width RADIUS at each position [..., 2] overlaps a wall."""
    x, y = position[..., :1], position[..., 1:]
    lo_x, lo_y, hi_x, hi_y = WALLS.T
    inside_x = (x + RADIUS > lo_x + 1e-5) & (x - RADIUS < hi_x - 1e-5)
    return (inside_x & (y + RADIUS > lo_y + 1e-5) & (y - RADIUS < hi_y - 1e-5)).any(axis=-1)


def free_starts(rng, n):
    candidates = rng.uniform(-4, 20, (20 * n, 2)).astype(np.float32)
    return candidates[~touches(candidates)][:n]


@settings(deadline=None)  # the first example compiles
@given(seed=st.integers(0, 2**32 - 1), speed=st.sampled_from([0.0, 4.0, 40.0, 400.0]))
def test_point_never_enters_a_wall_nor_crosses_one(seed, speed):
    rng = np.random.default_rng(seed)
    start = free_starts(rng, 16)
    held = rng.uniform(-1, 1, (STEPS // 10, 16, 2)) * 2  # bursts of constant actions, many of them at full speed
    actions = np.clip(np.repeat(held, 10, axis=0), -1, 1).astype(np.float32)
    path = np.asarray(positions(start, (speed * rng.normal(size=(16, 2))).astype(np.float32), actions))
    assert not touches(path).any()
    corners = np.stack([path[1:, :, 0], path[:-1, :, 1]], axis=-1)  # a step moves along x, then along y
    between = np.linspace(0, 1, 50)[:, None, None, None]
    assert not touches(path[:-1] + between * (corners - path[:-1])).any()
    assert not touches(corners + between * (path[1:] - corners)).any()


def test_point_slides_along_a_wall_it_pushes_against():
    data = PointState(position=jnp.array([0.0, 3.5]), velocity=jnp.array([0.0, 0.0]), open=jnp.zeros(()))
    after = POINT.step(data, jnp.array([1.0, 1.0]))
    np.testing.assert_allclose(after.position, [0.12, 3.5], atol=1e-6)
    np.testing.assert_allclose(after.velocity, [1.2, 0.0], atol=1e-6)


@pytest.mark.skipif("fusion_emitters" not in os.environ["XLA_FLAGS"], reason="this XLA has no older emitter of fusions")
def test_only_walls_stop_a_point_however_a_compiler_rounds_the_end_of_a_move():
    """With the emitter of fusions that rounds it unlike where it was computed first."""
    batch = envs.VectorEnv(envs.make("point_maze"), 256, auto_reset=False)

    def step(state, key):
        action = 0.3 * jax.random.uniform(key, (256, 2), minval=-1)
        return (state := batch.step(state, action)), state.obs

    def run(key):
        return jax.lax.scan(step, batch.reset(key), jax.random.split(key, 50))[1]

    obs = np.asarray(jax.jit(run)(jax.random.key(0)))
    free = (np.abs(obs[..., :2]) < 3.4).all(axis=-1)  # the nearest walls stop a point at 3.5
    assert free.sum() > 10_000
    assert (obs[free][:, 2:4] != 0).all()


def test_point_reaches_and_keeps_its_commanded_velocity():
    data = PointState(position=jnp.array([0.0, 0.0]), velocity=jnp.array([0.0, 0.0]), open=jnp.zeros(()))
    for _ in range(30):
        data = POINT.step(data, jnp.array([0.5, 0.0]))
    np.testing.assert_allclose(data.velocity, [0.5 * MAX_SPEED, 0.0], atol=1e-3)


def test_starts_are_scattered_around_the_origin():
    data = jax.vmap(POINT.init, in_axes=(0, None))(jax.random.split(jax.random.key(0), 2000), jnp.zeros(2))
    assert np.abs(data.position).max() <= 0.1
    np.testing.assert_allclose(np.std(data.position, axis=0), 0.2 / np.sqrt(12), rtol=0.1)
    np.testing.assert_allclose(np.std(data.velocity, axis=0), 0.1, rtol=0.1)
