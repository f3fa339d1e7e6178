from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.common.errors import UserError
from envs.maze import MazeEnv
from tests.made import jitted, made

B = 4


@cache
def batch(name="point_maze", auto_reset=True):
    return envs.VectorEnv(made(name, episode_length=3), B, auto_reset=auto_reset)


@pytest.fixture(scope="module")
def env():
    return batch().env


def act(env, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (B, env.action_size)).astype(np.float32)


def begin(vector):
    return jitted(vector.reset)(jax.random.key(0))


def leaves(tree):
    """All leaves as numpy arrays, typed keys by their data."""
    arrays = (
        jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        for leaf in jax.tree.leaves(tree)
    )
    return [np.asarray(array) for array in arrays]


def rollout(vector, state, actions):
    """The last state, and the observations and flags of every step, under `actions` [T, B, A]."""

    def step(state, action):
        state = vector.step(state, action)
        return state, (state.obs, state.info["final_obs"], state.done)

    return jax.lax.scan(step, state, actions)


def test_finished_environments_begin_new_episodes_with_new_goals(env):
    vector = batch()
    state, step = begin(vector), jitted(vector.step)
    goals = [np.asarray(state.obs)[:, env.state_dim :]]
    for _ in range(4):
        for _ in range(env.episode_length):
            state = step(state, act(env))
        np.testing.assert_array_equal(state.info["steps"], 0)
        obs = np.asarray(state.obs)
        goals.append(obs[:, env.state_dim :])
        assert (np.abs(obs[:, :2]) <= 0.1).all()
    assert len(np.unique(np.concatenate(goals), axis=0)) == 5 * B


def test_final_obs_flags_and_reward_are_those_of_the_finished_step(env):
    vector, plain = batch(), batch(auto_reset=False)
    state, expected = begin(vector), begin(plain)
    step, plain_step = jitted(vector.step), jitted(plain.step)
    for seed in range(env.episode_length):
        state, expected = step(state, act(env, seed)), plain_step(expected, act(env, seed))
    np.testing.assert_array_equal(state.info["final_obs"], expected.obs)
    np.testing.assert_array_equal(state.done, np.ones(B))
    np.testing.assert_array_equal(state.info["truncation"], np.ones(B))
    np.testing.assert_array_equal(state.reward, expected.reward)
    np.testing.assert_array_equal(state.metrics["distance"], expected.metrics["distance"])
    assert (np.asarray(state.obs) != expected.obs).any(axis=1).all()
    np.testing.assert_array_equal(step(state, act(env)).done, np.zeros(B))


def test_without_auto_reset_a_step_never_resets(env):
    vector = batch(auto_reset=False)
    state, step = begin(vector), jitted(vector.step)
    for _ in range(env.episode_length + 2):
        state = step(state, act(env))
        np.testing.assert_array_equal(state.info["final_obs"], state.obs)
    np.testing.assert_array_equal(state.info["steps"], env.episode_length + 2)
    np.testing.assert_array_equal(state.done, np.ones(B))


def test_only_the_environments_that_finish_are_reset(env):
    vector = batch()
    step = jitted(vector.step)
    state = step(begin(vector), act(env))
    state = jax.jit(vector.reset_where)(state, np.array([True, False, False, False]), jax.random.key(1))
    for _ in range(2):
        state = step(state, act(env))
    np.testing.assert_array_equal(state.done, [0.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(state.info["steps"], [2, 0, 0, 0])


@pytest.mark.parametrize("name", ["point_maze", "ant_maze"])
def test_reset_where_resets_everything_of_the_masked_and_nothing_else(name):
    vector = batch(name, auto_reset=False)
    mask = np.array([True, False, True, False])
    reset, step = jitted(vector.reset), jitted(vector.step)
    before = reset(jax.random.key(0))
    for _ in range(2):
        before = step(before, np.ones((B, vector.env.action_size), np.float32))
    after = jax.jit(vector.reset_where)(before, mask, jax.random.key(7))
    fresh = reset(jax.random.key(7))
    for old, new, start in zip(leaves(before), leaves(after), leaves(fresh), strict=True):
        np.testing.assert_array_equal(new[~mask], old[~mask])
        np.testing.assert_array_equal(new[mask], start[mask])


def test_environments_of_a_batch_differ():
    state = begin(batch())
    assert len(np.unique(state.obs, axis=0)) == B


@pytest.mark.parametrize(("name", "auto_reset"), [("point_maze", True), ("ant_maze", False)])
def test_a_vmap_over_seeds_equals_a_loop_over_them(name, auto_reset):
    vector = batch(name, auto_reset)
    states = jax.jit(jax.vmap(vector.reset))(jax.random.split(jax.random.key(0), 3))
    actions = np.random.default_rng(1).uniform(-1, 1, (3, 5, B, vector.env.action_size)).astype(np.float32)
    together = leaves(jax.jit(jax.vmap(lambda *seed: rollout(vector, *seed)))(states, actions))
    single = jax.jit(lambda states, actions, i: rollout(vector, *jax.tree.map(lambda leaf: leaf[i], (states, actions))))
    for i in range(3):
        for a, b in zip(together, leaves(single(states, actions, i)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-5)


def test_any_number_of_vmaps_is_one_batch_for_the_environment(monkeypatch):
    env, seen = envs.make("point_maze"), []

    def spied_step(state, action):
        def spy(obs):
            seen.append(obs.shape)
            return obs

        obs = jax.pure_callback(spy, jax.typeof(state.obs), state.obs, vmap_method="expand_dims")
        return MazeEnv.step(env, state.replace(obs=obs), action)

    monkeypatch.setattr(env, "step", spied_step)
    vector = envs.VectorEnv(env, B, auto_reset=False)
    state = jax.jit(jax.vmap(jax.vmap(vector.reset)))(jax.random.split(jax.random.key(0), (2, 3)))
    state = jax.jit(jax.vmap(jax.vmap(vector.step)))(state, np.zeros((2, 3, B, 2), np.float32))
    assert state.reward.shape == (2, 3, B)
    assert seen == [(2 * 3 * B, env.observation_size)]


def test_an_action_shared_by_all_seeds_is_broadcast(env):
    vector = batch(auto_reset=False)
    state = jax.jit(jax.vmap(vector.reset))(jax.random.split(jax.random.key(0), 3))
    action = act(env)
    shared = jax.jit(jax.vmap(vector.step, in_axes=(0, None)))(state, action)
    repeated = jax.jit(jax.vmap(vector.step))(state, np.broadcast_to(action, (3, *action.shape)))
    for a, b in zip(leaves(shared), leaves(repeated), strict=True):
        np.testing.assert_array_equal(a, b)


def test_typed_keys_are_carried_like_raw_ones(env):
    vector = batch()
    ended = np.full((B, env.action_size), np.nan, np.float32)  # ends every episode, so that the carried keys are used
    typed, raw = (
        jitted(vector.step)(jitted(vector.reset)(key), ended) for key in (jax.random.key(3), jax.random.PRNGKey(3))
    )
    np.testing.assert_array_equal(typed.done, np.ones(B))
    np.testing.assert_array_equal(typed.obs, raw.obs)


def test_a_key_for_each_environment_begins_the_episode_of_that_environment_alone(env):
    vector, single = batch(), envs.VectorEnv(env, 1)
    keys = jax.random.split(jax.random.key(0), B)
    reset, reset_one = jitted(vector.reset), jax.jit(single.reset)
    begun = reset(keys)
    np.testing.assert_array_equal(begun.obs, begin(vector).obs)
    np.testing.assert_array_equal(reset(jax.random.key_data(keys)).obs, begun.obs)
    for i in range(B):
        np.testing.assert_array_equal(begun.obs[i], reset_one(keys[i : i + 1]).obs[0])
    state = reset(jax.random.key(7))
    mask = np.arange(B) == 2
    np.testing.assert_array_equal(jax.jit(vector.reset_where)(state, mask, keys).obs[2], begun.obs[2])
    with pytest.raises(UserError, match=rf"the shape of the keys is \(2,\); allowed: one key, or \({B},\)"):
        vector.reset(keys[:2])


@pytest.mark.parametrize("auto_reset", [True, False])
def test_the_derivative_of_a_batch_is_that_of_each_environment(env, auto_reset):
    vector = batch(auto_reset=auto_reset)
    state, action = begin(vector), 0.5 * act(env)

    @jax.jit
    def derivatives(state, action, pair):
        def rewards(action):
            return vector.step(state, action).reward

        return (
            jax.vmap(jax.grad(lambda one, action: env.step(one, action).reward, argnums=1))(state, action),
            jax.jacfwd(rewards)(action),
            jax.grad(lambda a: rewards(a).sum())(action),
            jax.vmap(jax.grad(lambda a: rewards(a).sum()))(pair),
            jax.grad(lambda a: jax.vmap(rewards)(a).sum())(pair),
        )

    each, forward, summed, *pairs = map(np.asarray, derivatives(state, action, np.stack([action, action])))
    assert (np.abs(each) > 0).any()
    np.testing.assert_allclose(np.einsum("iij->ij", forward), each, rtol=1e-5)
    np.testing.assert_allclose(summed, each, rtol=1e-5)
    for found in pairs:
        np.testing.assert_allclose(found, np.stack([each, each]), rtol=1e-5)


def test_an_engine_without_derivatives_says_so_in_one_line():
    vector = batch("ant_maze", auto_reset=False)
    state = begin(vector)
    for function in (
        jax.grad(lambda a: vector.step(state, a).reward.sum()),
        jax.jacfwd(lambda a: vector.step(state, a).obs),
    ):
        with pytest.raises(UserError, match='engine: "native" has no derivatives; allowed: jax'):
            jax.eval_shape(function, jnp.zeros((B, 8)))
