import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs.tasks import TASKS
from tests.made import made

STARTS = 20


@pytest.fixture(scope="module")
def body():
    return ant_body("native")


def ant_body(engine, task="ant_maze"):
    return made(task, engine=engine).body


def simulations(physics, qpos, qvel):
    return jax.jit(jax.vmap(physics.init))(np.float32(qpos), np.float32(qvel))


def random_starts(model, n=STARTS, seed=0, floor=0.0):
    """Ants low above the floor, so that many of them touch it, and torques; blocks move but stand where they are."""
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (n, 1))
    qpos[:, :15] += rng.uniform(-0.3, 0.3, (n, 15))
    qpos[:, 2] = floor + rng.uniform(0.25, 0.6, n)
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, rng.normal(size=(n, model.nv)), rng.uniform(-30, 30, (n, model.nu))


@pytest.mark.parametrize("task", ["ant_maze", "ant_fall", "ant_push", "ant_maze_cam"])
def test_native_engine_is_mujoco(task):
    body = ant_body("native", task)
    qpos, qvel, ctrl = random_starts(body.physics.model, floor=TASKS[task].arena.floor_height)
    qpos[:5, :2] = (6.6, 0.0)  # some of them near a wall of the Ant Maze and near the block of Ant Fall
    data = simulations(body.physics, qpos, qvel)
    moved = np.where(np.arange(STARTS) % 2, 3.0, 0.0)[:, None]  # a gate lifted by 3 m in half of them
    data = data.replace(mocap_pos=data.mocap_pos.at[:, :, 2].add(moved))
    after = jax.jit(jax.vmap(body.physics.step))(data, ctrl)
    contacts = 0
    for i in range(STARTS):
        plain = mujoco.MjData(body.physics.model)
        plain.qpos, plain.qvel, plain.ctrl = data.qpos[i], data.qvel[i], ctrl[i].astype(np.float32)
        plain.mocap_pos = data.mocap_pos[i]
        for _ in range(5):
            mujoco.mj_step(body.physics.model, plain)
        contacts += plain.ncon
        np.testing.assert_allclose(after.qpos[i], plain.qpos, atol=1e-5)
        np.testing.assert_allclose(after.qvel[i], plain.qvel, atol=1e-5)
    assert contacts > STARTS / 2


def test_mjx_engine_agrees_with_native(body):
    """Legs lie flat, where both engines orient the pyramid of the friction cone in the same way."""
    mjx_body = ant_body("jax")
    qpos, qvel, ctrl = random_starts(body.physics.model, 4)
    qpos[:, 2], qpos[:, 3:] = 0.15, body.physics.model.qpos0[3:] + 0.1 * (qpos[:, 3:] - body.physics.model.qpos0[3:])
    data = simulations(body.physics, qpos, 0.1 * qvel)
    native = jax.jit(jax.vmap(body.physics.step))(data, ctrl)
    plain = mujoco.MjData(body.physics.model)
    plain.qpos = data.qpos[0]
    mujoco.mj_forward(body.physics.model, plain)
    assert plain.ncon > 1
    mjx = jax.jit(jax.vmap(mjx_body.physics.step))(data, ctrl)
    np.testing.assert_allclose(mjx.qpos, native.qpos, atol=1e-3)
    np.testing.assert_allclose(mjx.qvel, native.qvel, atol=1e-3)
    assert (np.asarray(native.qvel) != np.asarray(data.qvel)).all()


def test_native_engine_is_bit_reproducible_and_blind_to_the_rest_of_the_batch(body):
    qpos, qvel, ctrl = random_starts(body.physics.model, 33)
    data = simulations(body.physics, qpos, qvel)
    step = jax.jit(jax.vmap(body.physics.step))
    first, second = step(data, ctrl), step(data, ctrl)
    one = step(jax.tree.map(lambda leaf: leaf[5:6], data), ctrl[5:6])
    np.testing.assert_array_equal(first.qpos, second.qpos)
    np.testing.assert_array_equal(first.qvel, second.qvel)
    np.testing.assert_array_equal(first.qvel[5:6], one.qvel)


def test_a_settled_ant_rests_on_the_floor(body):
    data = simulations(body.physics, body.physics.model.qpos0[None], np.zeros((1, body.physics.model.nv)))
    step = jax.jit(jax.vmap(body.physics.step))
    for _ in range(40):
        data = step(data, jnp.zeros((1, body.physics.model.nu)))
    plain = mujoco.MjData(body.physics.model)
    plain.qpos, plain.qvel = data.qpos[0], data.qvel[0]
    mujoco.mj_forward(body.physics.model, plain)
    assert plain.ncon > 0
    assert 0.2 < plain.qpos[2] < 0.8
    assert np.abs(plain.qvel).max() < 0.1


@pytest.mark.parametrize("speed", [3.0, 6.0, 12.0])
def test_an_ant_thrown_through_the_maze_never_passes_a_wall(body, speed):
    walls = envs.make("point_maze").arena.walls()
    lo_x, lo_y, hi_x, hi_y = walls.T
    rng = np.random.default_rng(0)

    def within(position, margin):
        x, y = position[:, :1], position[:, 1:2]
        in_x = (x > lo_x - margin) & (x < hi_x + margin)
        return (in_x & (y > lo_y - margin) & (y < hi_y + margin)).any(axis=1)

    starts = rng.uniform(-4, 20, (2000, 2))
    starts = starts[~within(starts, 1.2)][:100]
    angle = rng.uniform(0, 2 * np.pi, 100)
    qpos, qvel = np.tile(body.physics.model.qpos0, (100, 1)), np.zeros((100, body.physics.model.nv))
    qpos[:, :2] = starts
    qvel[:, 0], qvel[:, 1] = speed * np.cos(angle), speed * np.sin(angle)
    data, step = simulations(body.physics, qpos, qvel), jax.jit(jax.vmap(body.physics.step))
    reached = np.zeros(100, bool)
    for _ in range(20):
        data = step(data, jnp.zeros((100, body.physics.model.nu)))
        position = np.asarray(data.qpos)
        assert not within(position, 0.0).any()
        assert (position[:, :2] > -4).all() and (position[:, :2] < 20).all()
        reached |= within(position, 0.5)
    assert reached.sum() > 5


def test_a_broken_simulation_stays_broken_and_alone_and_leaves_no_log(body, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    qpos, qvel, ctrl = random_starts(body.physics.model, 3)
    data = simulations(body.physics, qpos, qvel)
    broken = data.replace(qpos=data.qpos.at[1, 0].set(jnp.nan))
    step = jax.jit(jax.vmap(body.physics.step))
    after = step(broken, ctrl)
    assert np.isnan(after.qpos[1]).all()
    np.testing.assert_array_equal(after.qpos[::2], step(data, ctrl).qpos[::2])
    assert os.listdir(tmp_path) == []


def test_a_simulation_that_explodes_turns_non_finite(body, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs the explosion there
    qpos, qvel, ctrl = random_starts(body.physics.model, 2)
    qvel[0, 3] = 1e9
    after = jax.jit(jax.vmap(body.physics.step))(simulations(body.physics, qpos, qvel), ctrl)
    assert np.isnan(after.qpos[0]).any()
    assert np.isfinite(after.qpos[1]).all()


@pytest.mark.parametrize("engine", ["native", "jax"])
@pytest.mark.parametrize("what", ["qpos", "qvel"])
def test_a_simulation_that_leaves_the_world_turns_to_nan_before_its_numbers_overflow(engine, what):
    physics = ant_body(engine).physics
    qpos, qvel, ctrl = random_starts(physics.model, 2, floor=10.0)
    {"qpos": qpos, "qvel": qvel}[what][0, 0] = 2e6
    after = jax.jit(jax.vmap(physics.step))(simulations(physics, qpos, qvel), ctrl)
    assert np.isnan(after.qpos[0]).all() and np.isnan(after.qvel[0]).all()
    assert np.isfinite(after.qpos[1]).all() and np.isfinite(after.qvel[1]).all()


def test_nested_vmaps_equal_one_flat_batch(body):
    qpos, qvel, ctrl = random_starts(body.physics.model, 6)
    data = simulations(body.physics, qpos, qvel)
    data, ctrl = jax.device_get(data), ctrl.astype(np.float32)
    flat = jax.jit(jax.vmap(body.physics.step))(data, ctrl)
    nested = jax.jit(jax.vmap(jax.vmap(body.physics.step)))(
        *jax.tree.map(lambda leaf: leaf.reshape(2, 3, *leaf.shape[1:]), (data, ctrl))
    )
    np.testing.assert_array_equal(np.asarray(nested.qpos).reshape(6, -1), flat.qpos)
