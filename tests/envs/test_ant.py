from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from tests.made import jitted, made


@pytest.fixture(scope="module")
def env():
    return made("ant_maze")


def test_state_is_qpos_qvel_and_the_clock(env):
    state, step = jitted(env.reset)(jax.random.key(0)), jitted(env.step)
    for _ in range(2):
        state = step(state, jnp.zeros(8))
    data = state.pipeline_state.data
    np.testing.assert_array_equal(state.obs[:15], data.qpos)
    np.testing.assert_array_equal(state.obs[15:29], data.qvel)
    assert float(state.obs[29]) == pytest.approx(0.002)
    assert (env.state_dim, env.action_size, env.dt) == (30, 8, pytest.approx(0.1))


def test_starts_are_noisy_around_the_published_pose(env):
    data = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2000)).pipeline_state.data
    qpos, qvel = np.asarray(data.qpos), np.asarray(data.qvel)
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1.0, atol=1e-6)
    pose = np.array([0, 0, 0.75, 1, 0, 0, 0] + [0] * 8)
    away = np.abs(qpos - pose)[:, [0, 1, 2, *range(7, 15)]]
    assert 0.095 < away.max() <= 0.1 + 1e-6
    np.testing.assert_allclose(qvel.std(axis=0), 0.1, rtol=0.1)


def test_each_action_pushes_its_own_joint_with_thirty_newton_metres(env):
    state = jitted(env.reset)(jax.random.key(0))
    data = state.pipeline_state.data
    qpos = data.qpos.at[2].set(2.0).at[7:].set(jnp.array([0, 0.9, 0, -0.9, 0, -0.9, 0, 0.9]))  # in the air, at ease
    data = data.replace(qpos=qpos, qvel=jnp.zeros_like(data.qvel))
    state = state.replace(pipeline_state=state.pipeline_state.replace(data=data))
    step = jax.jit(jax.vmap(lambda action: env.step(state, action).pipeline_state.data.qvel[6:]))
    velocity = np.asarray(step(0.1 * jnp.eye(8)) - step(jnp.zeros((8, 8))))
    np.testing.assert_array_equal(np.abs(velocity).argmax(axis=1), np.arange(8))
    # 3 N m for .1 s on an inertia of about 1 kg m^2 with a damping of 1 N m s
    np.testing.assert_allclose(np.diag(velocity), 3 * (1 - np.exp(-0.1)), rtol=0.1)


def solver_options(**options):
    body: Any = envs.make("ant_maze", engine="native", **options).body
    return body.physics.model.opt


def test_presets_and_options_reach_the_model():
    fast, published = solver_options(), solver_options(preset="published", iterations=7)
    assert (fast.iterations, fast.ls_iterations, fast.timestep) == (10, 10, 0.02)
    assert (published.iterations, published.ls_iterations) == (7, 50)
    assert fast.integrator != published.integrator


def test_frames_and_time_step_make_the_env_step():
    assert envs.make("ant_maze", engine="native", frames=2, timestep=0.01).dt == pytest.approx(0.02)
