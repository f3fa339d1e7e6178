import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

import envs
from tests.made import jitted, made


@pytest.fixture(scope="module", params=["point_maze", "ant_maze"])
def env(request):
    return made(request.param, episode_length=3)


def reset(env, seed=0):
    return jitted(env.reset)(jax.random.key(seed))


def idle(env):
    return jnp.zeros(env.action_size)


def with_nan_velocity(state):
    data = state.pipeline_state.data
    name = "velocity" if hasattr(data, "velocity") else "qvel"
    broken = data.replace(**{name: getattr(data, name).at[0].set(jnp.nan)})
    return state.replace(pipeline_state=state.pipeline_state.replace(data=broken))


def test_observation_is_the_state_followed_by_the_goal(env):
    state = reset(env)
    assert state.obs.shape == (env.observation_size,) == (env.state_dim + len(env.goal_indices),)
    after = jitted(env.step)(state, idle(env))
    np.testing.assert_array_equal(after.obs[env.state_dim :], state.obs[env.state_dim :])
    simulated = env.body.observe(after.pipeline_state.data, after.info["steps"])
    np.testing.assert_array_equal(after.obs[: env.state_dim], simulated)


def test_reward_is_minus_the_distance_over_the_goal_dimensions(env):
    state = jitted(env.step)(reset(env), idle(env))
    position, goal = np.asarray(state.obs)[list(env.goal_indices)], np.asarray(state.obs)[env.state_dim :]
    assert float(state.reward) == pytest.approx(-np.hypot(*(position - goal)), abs=1e-5)
    assert float(state.metrics["distance"]) == -float(state.reward)


@pytest.mark.parametrize(("goal", "success"), [((0.0, 4.5), 1.0), ((0.0, 5.6), 0.0)])
def test_success_is_a_distance_below_the_radius(env, goal, success):
    state = reset(env)
    state = state.replace(info={**state.info, "goal": jnp.array(goal)})
    assert float(jitted(env.step)(state, idle(env)).metrics["success"]) == success


def test_train_goals_fill_the_space_and_differ_between_resets():
    env = envs.make("point_maze")
    obs = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 4000)).obs)
    goals = obs[:, env.state_dim :]
    lower, upper = env.space
    assert (goals >= lower).all() and (goals <= upper).all()
    np.testing.assert_allclose(goals.min(axis=0), lower, atol=0.2)
    np.testing.assert_allclose(goals.max(axis=0), upper, atol=0.2)
    np.testing.assert_allclose(goals.mean(axis=0), (lower + upper) / 2, atol=0.5)
    assert len(np.unique(goals, axis=0)) == len(goals)


def test_test_goal_is_the_published_one():
    env = envs.make("point_maze", goals="test")
    for seed in range(3):
        np.testing.assert_array_equal(reset(env, seed).obs[env.state_dim :], [0.0, 16.0])


def test_actions_are_clipped(env):
    state = reset(env)
    step = jitted(env.step)
    full = jnp.where(jnp.arange(env.action_size) % 2 == 0, 1.0, -1.0)
    np.testing.assert_array_equal(step(state, 100.0 * full).obs, step(state, full).obs)
    assert (step(state, full).obs != step(state, 0.5 * full).obs).any()


def test_the_time_limit_truncates_and_does_not_terminate(env):
    state, step = reset(env), jitted(env.step)
    told = []
    for _ in range(3):
        state = step(state, idle(env))
        told.append((int(state.info["steps"]), float(state.done), float(state.info["truncation"])))
    assert told == [(1, 0.0, 0.0), (2, 0.0, 0.0), (3, 1.0, 1.0)]


def test_a_simulation_that_breaks_is_truncated_with_finite_outputs(env):
    state, step = reset(env), jitted(env.step)
    for _ in range(4):
        after = step(with_nan_velocity(state), idle(env))
        assert (float(after.done), float(after.info["truncation"])) == (1.0, 1.0)
        np.testing.assert_array_equal(after.obs, state.obs)
        assert np.isfinite(after.reward) and all(np.isfinite(value) for value in after.metrics.values())
        state = after


def test_an_action_that_is_not_a_number_ends_the_episode(env):
    after = jitted(env.step)(reset(env), idle(env).at[0].set(jnp.nan))
    assert (float(after.done), float(after.metrics["non_finite"])) == (1.0, 1.0)
    assert np.isfinite(after.obs).all()


def test_structure_and_types_of_a_state_are_the_same_after_a_step(env):
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, idle(env))
    chex.assert_trees_all_equal_shapes_and_dtypes(after, state)


def test_typed_and_raw_keys_are_both_accepted():
    reset = jitted(made("point_maze").reset)
    np.testing.assert_array_equal(reset(jax.random.key(5)).obs, reset(jax.random.PRNGKey(5)).obs)


def test_brax_wrappers_truncate_without_terminating(env):
    wrapped = EpisodeWrapper(VmapWrapper(env), episode_length=3, action_repeat=1)
    state, step = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), 2)), jax.jit(wrapped.step)
    while not state.done.any():
        state = step(state, jnp.zeros((2, env.action_size)))
    np.testing.assert_array_equal(state.info["truncation"], [1.0, 1.0])


def test_first_regions_cover_the_space(env):
    lower, upper = env.space
    assert len(env.abstract_indices) == len(env.region_cuts) == len(env.subgoal_scale) == len(lower) == len(upper)
    for low, cuts, high in zip(lower, env.region_cuts, upper, strict=True):
        assert (np.diff([low, *cuts, high]) > 0).all()
    free = env.arena.free()
    np.testing.assert_array_equal([free[:, :2].min(axis=0), free[:, 2:].max(axis=0)], [lower, upper])
