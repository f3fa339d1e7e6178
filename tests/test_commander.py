"""Tabular Q-learning over regions, against a loop over decisions and cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star import commander, config
from star.commander import CommanderState, Decision, Successors

R, N = 5, 40


def settings(**values):
    return config.parse({"commander": values}).commander


def random_batch(seed):
    rng = np.random.default_rng(seed)
    few = lambda: rng.integers(0, 3, N).astype(np.int32)  # noqa: E731  # so that cells are met repeatedly
    return Decision(
        region=few(),
        goal_region=few(),
        target=few(),
        reward=-rng.random(N).astype(np.float32),
        next_region=rng.integers(0, R, N).astype(np.int32),
        weight=(rng.random(N) < 0.7).astype(np.float32),
    )


def random_state(seed):
    rng = np.random.default_rng(seed)
    q = jnp.asarray(-rng.random((R, R, R)), jnp.float32)
    allowed = rng.random((R, R)) < 0.6
    np.fill_diagonal(allowed, True)
    return CommanderState(q=q, chosen=jnp.zeros(R)), Successors(jnp.asarray(allowed), jnp.asarray(allowed))


def slow_update(q, allowed, batch, *, alpha, discount):
    new = q.copy()
    for i, g, j in {*zip(batch.region.tolist(), batch.goal_region.tolist(), batch.target.tolist(), strict=True)}:
        errors = []
        for n in range(N):
            if batch.weight[n] and (batch.region[n], batch.goal_region[n], batch.target[n]) == (i, g, j):
                after = batch.next_region[n]
                best = max(q[after, g, k] for k in range(R) if allowed[after, k])
                errors.append(batch.reward[n] + discount * best - q[i, g, j])
        if errors:
            new[i, g, j] += (1 - (1 - alpha) ** len(errors)) * np.mean(errors)
    return new


@pytest.fixture(scope="module")
def update():
    return jax.jit(commander.update)


@pytest.mark.parametrize("seed", range(3))
def test_an_update_averages_the_errors_of_each_cell(update, seed):
    state, allowed = random_state(seed)
    batch = random_batch(seed)
    after, metrics = update(settings(learning_rate=0.1, discount=0.9), state, allowed, batch)
    q = np.float64(state.q)
    expected = slow_update(q, np.asarray(allowed.greedy), batch, alpha=0.1, discount=0.9)
    assert (expected != q).sum() > 10
    np.testing.assert_allclose(after.q, expected, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(metrics["reward"], batch.reward[batch.weight > 0].mean(), rtol=1e-5)


def test_periods_with_weight_0_teach_nothing(update):
    state, allowed = random_state(0)
    batch = random_batch(0).replace(weight=np.zeros(N, np.float32))
    np.testing.assert_array_equal(update(settings(), state, allowed, batch)[0].q, state.q)


def test_a_sweep_is_so_many_updates_on_the_same_batch(update):
    state, allowed = random_state(1)
    batch = random_batch(1)
    chosen = settings(learning_rate=0.1, discount=0.9, sweeps=4)
    swept, _ = jax.jit(commander.sweep)(chosen, state, allowed, batch)
    for _ in range(4):
        state, _ = update(chosen, state, allowed, batch)
    np.testing.assert_allclose(swept.q, state.q, rtol=1e-5)


def test_epsilon_falls_linearly_and_stays():
    chosen = settings(epsilon_start=0.9, epsilon_end=0.1, epsilon_steps=1000.0)
    for steps, expected in ((0, 0.9), (250, 0.7), (500, 0.5), (1000, 0.1), (5000, 0.1)):
        np.testing.assert_allclose(commander.epsilon(chosen, jnp.float32(steps)), expected, rtol=1e-6)


# Regions 0-3 are active, 4 is not. 0 is known to reach 1; 2 is shown unreachable from 0 and 1, as 3 is from itself.
REACHES = np.zeros((R, R), bool)
REACHES[0, 1] = REACHES[0, 4] = True
MISSES = np.zeros((R, R), bool)
MISSES[0, 2] = MISSES[1, 2] = MISSES[3, 3] = True
ACTIVE = np.arange(R) < 4


def slow_successors(mode, reaches, misses, active):
    greedy, explore = np.zeros((2, R, R), bool)
    for i in range(R):
        for j in range(R):
            if active[i] and active[j]:
                explore[i, j] = i == j or not misses[i, j]
                known = [k for k in range(R) if active[k] and reaches[i, k] and k != i]
                if mode == "any":
                    greedy[i, j] = True
                elif mode == "known" and known:
                    greedy[i, j] = j in known or i == j
                else:
                    greedy[i, j] = explore[i, j]
    return greedy, explore


@pytest.mark.parametrize("mode", ["any", "possible", "known"])
def test_successors_by_mode(mode):
    got = commander.successors(mode, reaches=jnp.array(REACHES), misses=jnp.array(MISSES), active=jnp.array(ACTIVE))
    greedy, explore = slow_successors(mode, REACHES, MISSES, ACTIVE)
    np.testing.assert_array_equal(got.greedy, greedy)
    np.testing.assert_array_equal(got.explore, explore)


def test_known_falls_back_to_what_is_possible_where_nothing_is_known():
    got = commander.successors("known", reaches=jnp.array(REACHES), misses=jnp.array(MISSES), active=jnp.array(ACTIVE))
    assert got.greedy[0].tolist() == [True, True, False, False, False]
    assert got.greedy[1].tolist() == [True, True, False, True, False]
    assert got.greedy[3].tolist() == [True, True, True, True, False]


def test_the_greedy_choice_is_the_best_allowed_target_and_ties_break_at_random():
    q = jnp.zeros((R, R, R)).at[0, 1].set(jnp.array([0.0, 3.0, 9.0, 3.0, 1.0]))
    allowed = jnp.ones((R, R), bool).at[:, 2].set(False)
    many = jnp.zeros(500, jnp.int32)
    targets = commander.act(
        CommanderState(q=q, chosen=jnp.zeros(R)),
        Successors(greedy=allowed, explore=allowed),
        many,
        many + 1,
        epsilon=0.0,
        key=jax.random.key(0),
    )
    values, counts = np.unique(targets, return_counts=True)
    assert values.tolist() == [1, 3]
    assert counts.min() > 150


def test_epsilon_is_the_share_of_random_choices():
    q = jnp.zeros((R, R, R)).at[..., 0].set(1.0)
    allowed = jnp.ones((R, R), bool)
    many = jnp.zeros(4000, jnp.int32)
    targets = commander.act(
        CommanderState(q=q, chosen=jnp.zeros(R)),
        Successors(greedy=allowed, explore=allowed),
        many,
        many,
        epsilon=0.5,
        key=jax.random.key(0),
    )
    shares = np.bincount(targets, minlength=R) / 4000
    np.testing.assert_allclose(shares, [0.6, 0.1, 0.1, 0.1, 0.1], atol=0.03)


@pytest.mark.parametrize("reward", ["max", "mean"])
def test_the_reward_of_a_period_is_the_max_or_mean_over_all_its_steps(reward):
    chosen = settings(reward=reward, period=30)
    external = -np.random.default_rng(0).random((3, 10, 4)).astype(np.float32)
    alive = np.ones((3, 10, 4), np.float32)
    alive[2, 6:, 1] = 0
    total = jnp.full(4, commander.start_reward(chosen))
    for part in range(3):
        total = commander.accumulate(chosen, total, external[part], alive[part])
    for b in range(4):
        lived = [external[p, t, b] for p in range(3) for t in range(10) if alive[p, t, b]]
        expected = max(lived) if reward == "max" else sum(lived) / 30
        np.testing.assert_allclose(total[b], expected, rtol=1e-5)


def test_a_new_region_inherits_rows_columns_and_half_the_visits_of_its_parent():
    q = jax.random.normal(jax.random.key(0), (R, R, R))
    state = CommanderState(q=q, chosen=jnp.arange(1.0, R + 1))
    after = commander.on_split(state, parent=jnp.int32(1), child=jnp.int32(3))
    who = [0, 1, 2, 1, 4]
    np.testing.assert_array_equal(after.q, np.asarray(q)[np.ix_(who, who, who)])
    np.testing.assert_array_equal(after.chosen, [1, 1, 3, 1, 5])
