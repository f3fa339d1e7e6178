"""PPO: advantages against a slow loop, and learning on the smallest of tasks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.config import loading
from star.learners import ppo
from star.learners.replay import Transition

T, B = 6, 8


def settings(**values):
    values = {"hidden": [16], "passes": 2, "minibatches": 2} | values
    return loading.parse({"controller": {"ppo": values}, "trainer": {"num_envs": 64}}).controller.ppo


def random_rollout(seed=0):
    rng = np.random.default_rng(seed)
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    terminated = (rng.random((T, B)) < 0.2).astype(np.float32)
    return Transition(
        obs=f32(T, B, 3),
        action=f32(T, B, 2),
        reward=f32(T, B),
        next_obs=f32(T, B, 3),
        terminated=terminated,
        cut=np.maximum(terminated, rng.random((T, B)) < 0.2).astype(np.float32),
        weight=np.ones((T, B), np.float32),
    )


EXAMPLE = jax.tree.map(lambda x: x[0, 0], random_rollout())


begun = jax.jit(partial(ppo.init, example=EXAMPLE))


@pytest.fixture(scope="module")
def start():
    return jax.device_get(begun(jax.random.key(0), settings()))


@jax.jit
def updated(chosen, state, rollout, key, price):
    return ppo.update(
        chosen, state, rollout, penalty=lambda _, action: price * jnp.square(action - 1.0).sum(-1), key=key
    )


@pytest.fixture(scope="module")
def update():
    """An update in which mean actions cost `price` times their squared distance from 1."""

    def call(chosen, state, rollout, key, price=0.0):
        return jax.device_get(updated(chosen, state, rollout, key, price))

    return call


@partial(jax.jit, static_argnames="deterministic")
def act(chosen, state, obs, key, *, deterministic=False):
    return ppo.act(chosen, state, obs, deterministic=deterministic, key=key)


def test_advantages_stop_at_cuts_and_bootstrap_unless_terminated():
    rollout = random_rollout()
    values, next_values = np.random.default_rng(1).normal(size=(2, T, B)).astype(np.float32)
    chosen = settings(discount=0.9, gae_lambda=0.8)
    got = np.asarray(jax.jit(ppo.advantages)(chosen, rollout, values, next_values))
    for b in range(B):
        for t in range(T):
            expected, factor = 0.0, 1.0
            for u in range(t, T):
                future = 0.0 if rollout.terminated[u, b] else 0.9 * next_values[u, b]
                expected += factor * (rollout.reward[u, b] + future - values[u, b])
                factor *= 0.9 * 0.8
                if rollout.cut[u, b] or rollout.terminated[u, b]:
                    break
            np.testing.assert_allclose(got[t, b], expected, rtol=1e-4, atol=1e-5)


def test_the_first_gradient_step_starts_from_the_policy_that_collected(start, update):
    once = settings(passes=1, minibatches=1)
    rollout = random_rollout()
    # Statistics of its own show that collecting and learning normalise alike.
    state, _ = update(once, start, rollout, jax.random.key(1))
    actions = act(once, state, rollout.obs, jax.random.key(2))
    _, metrics = update(once, state, rollout.replace(action=np.asarray(actions)), jax.random.key(3))
    np.testing.assert_allclose(metrics["kl"], 0, atol=1e-5)
    assert float(metrics["clipped"]) == 0
    np.testing.assert_allclose(metrics["actor_loss"], 0, atol=1e-5)  # ratio 1, advantages of mean 0


def test_exploration_is_gaussian_about_the_deterministic_action():
    chosen = settings(initial_std=0.5)
    state = begun(jax.random.key(0), chosen)
    obs = np.tile(np.float32([1.0, -2.0, 0.5]), (4000, 1))
    mean = np.asarray(act(chosen, state, obs, jax.random.key(1), deterministic=True))
    drawn = np.asarray(act(chosen, state, obs, jax.random.key(1)))
    np.testing.assert_allclose(drawn.mean(0), mean[0], atol=0.05)
    np.testing.assert_allclose(drawn.std(0), 0.5, atol=0.03)


def test_samples_of_weight_0_have_no_influence(start, update):
    rollout = random_rollout()
    over = np.arange(T)[:, None] >= np.array([2, 3, 4, 5, 6, 6, 6, 6])  # steps after an environment ended
    terminated = np.zeros((T, B), np.float32)
    terminated[[1, 2, 3, 4], [0, 1, 2, 3]] = 1
    rollout = rollout.replace(weight=np.float32(~over), terminated=terminated, cut=terminated)
    rng = np.random.default_rng(5)

    def spoil(x):
        where = over.reshape(T, B, *(1,) * (x.ndim - 2))
        return np.where(where, 5 * rng.normal(size=x.shape), x).astype(np.float32)

    spoilt = rollout.replace(
        **{name: spoil(getattr(rollout, name)) for name in ("obs", "action", "reward", "next_obs")}
    )
    (first, _), (second, _) = (update(settings(), start, r, jax.random.key(1)) for r in (rollout, spoilt))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6), first, second)
    assert any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (first.params, start.params)), strict=True))


def test_from_a_rollout_without_weight_nothing_is_learnt(start, update):
    learnt, _ = update(settings(), start, random_rollout(), jax.random.key(1))
    empty = random_rollout(1).replace(weight=np.zeros((T, B), np.float32))
    same, metrics = update(settings(), learnt, empty, jax.random.key(2))
    jax.tree.map(np.testing.assert_array_equal, same, learnt)
    assert float(metrics["learning_rate"]) == float(learnt.learning_rate)


def test_what_has_weight_0_may_become_infinitely_unlikely(start, update):
    rollout = random_rollout()
    weight = np.ones((T, B), np.float32)
    weight[0, :2] = 0
    action = rollout.action.copy()
    action[0, :2] = np.float32([[1e6, 1e6], [-1e6, -1e6]])  # what somebody else did; one of them gains by any step
    given = rollout.replace(action=action, weight=weight)
    state, metrics = update(settings(), start, given, jax.random.key(1))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, metrics)))


def test_the_step_size_shrinks_after_large_changes_of_the_policy_and_grows_after_small_ones(start, update):
    rollout = random_rollout()
    for target, factor in ((1e-12, 1 / 1.5), (1e3, 1.5)):
        chosen = settings(target_kl=target, learning_rate=5e-4, max_learning_rate=1.0)  # of two passes
        state, metrics = update(chosen, start, rollout, jax.random.key(1))
        np.testing.assert_allclose(state.learning_rate, 5e-4 * factor**2, rtol=1e-4)
        np.testing.assert_allclose(metrics["learning_rate"], state.learning_rate)


def test_a_deviation_at_its_floor_can_grow_again(start, update):
    chosen = settings(min_std=0.9, entropy=10.0)
    low = start.replace(params=start.params | {"log_std": np.full(2, np.log(0.8), np.float32)})
    state, metrics = update(chosen, low, random_rollout(), jax.random.key(1))
    assert (np.exp(state.params["log_std"]) >= 0.9 - 1e-6).all()
    again, _ = update(chosen, state, random_rollout(), jax.random.key(2))
    assert (again.params["log_std"] > state.params["log_std"]).all()


CONTEXTS = np.where(np.arange(64) % 2, 1.0, -1.0).astype(np.float32)[None, :, None]


@jax.jit
def learn(chosen, base, slope, matters):
    """The state, greedy actions in the contexts 1 and -1, and metrics, after 80 updates of a bandit.

    It pays `base` + `slope` times the context, less `matters` times the square of the error of the action.
    """
    one, key = jnp.ones((1, 64)), jax.random.key(0)

    def once(state, key):
        act_key, update_key = jax.random.split(key)
        action = ppo.act(chosen, state, CONTEXTS, key=act_key)
        reward = base + slope * CONTEXTS - matters * jnp.square(action - 0.5 * CONTEXTS)
        rollout = Transition(
            obs=CONTEXTS,
            action=action,
            reward=reward[..., 0],
            next_obs=CONTEXTS,
            terminated=one,
            cut=one,
            weight=one,
        )
        return ppo.update(chosen, state, rollout, key=update_key)

    number = jnp.zeros(1)
    state = ppo.init(key, chosen, example=EXAMPLE.replace(obs=number, next_obs=number, action=number))
    state, metrics = jax.lax.scan(once, state, jax.random.split(key, 80))
    action = ppo.act(chosen, state, jnp.array([[1.0], [-1.0]]), deterministic=True, key=key)
    return state, action[:, 0], metrics


def test_it_learns_a_bandit_with_two_contexts():
    chosen = settings(learning_rate=3e-3, max_learning_rate=1e-2, passes=4, target_kl=0.05)
    _, action, metrics = learn(chosen, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(action, [0.5, -0.5], atol=0.15)
    assert metrics["std"][-1] < metrics["std"][0]


def test_a_price_on_the_mean_action_pulls_it_away(start, update):
    rollout, state, key = random_rollout(), start, jax.random.key(0)
    for i in range(20):
        state, _ = update(settings(target_kl=1.0), state, rollout, jax.random.key(i), price=100.0)
    means = [np.asarray(act(settings(), s, rollout.obs, key, deterministic=True)).mean() for s in (state, start)]
    assert means[0] > means[1] + 0.1


@pytest.mark.parametrize("power", [-7, 7])
def test_the_scale_of_rewards_does_not_matter(start, update, power):
    """By a power of two, so that rounding is the same."""
    scale, one, other = np.float32(2.0**power), start, start
    for seed in range(10):
        rollout, key = random_rollout(seed), jax.random.key(seed)
        rollout = rollout.replace(
            action=np.asarray(act(settings(), one, rollout.obs, key)), weight=np.float32(rollout.obs[..., 0] < 1)
        )
        one, expected = update(settings(), one, rollout, key)
        other, got = update(settings(), other, rollout.replace(reward=scale * rollout.reward), key)
        for name, value in expected.items():
            np.testing.assert_allclose(got[name], value, rtol=1e-4, atol=1e-4)
        actions = [act(settings(), state, rollout.obs, key) for state in (one, other)]
        np.testing.assert_allclose(*actions, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(other.returns.deviation, scale * one.returns.deviation, rtol=1e-4)
    assert any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (one.params, start.params)), strict=True))


def test_a_critic_whose_gradient_is_huge_does_not_slow_the_actor_down(start, update):
    """Values of a state that do not fit at all, and a policy that learns the same."""
    rollout = random_rollout()
    far = jax.tree.map(lambda x: np.float32(1e3) * x, start.params["critic"])
    lost = start.replace(params=start.params | {"critic": far})
    once = settings(passes=1, minibatches=1, gae_lambda=1.0)
    alone = rollout.replace(terminated=np.ones((T, B), np.float32))  # advantages are rewards minus values
    (with_far, far_told), (usual, told) = (update(once, state, alone, jax.random.key(0)) for state in (lost, start))
    assert far_told["critic_loss"] > 100 * told["critic_loss"]

    def moved(state):
        pairs = zip(*(jax.tree.leaves(one.params["actor"]) for one in (state, start)), strict=True)
        return np.sqrt(sum(np.square(after - before).sum() for after, before in pairs))

    assert moved(with_far) > 0.5 * moved(usual)


def test_the_critic_comes_to_know_returns_that_are_large_and_much_alike():
    """Returns of 1,000 and 1,001 in two kinds of states."""
    chosen = settings(learning_rate=3e-3, max_learning_rate=3e-3, discount=0.0, passes=4)
    state, _, metrics = jax.device_get(learn(chosen, 1000.5, 0.5, 0.0))
    assert metrics["critic_loss"][-1] < 0.01  # half the square of the error, in deviations
    np.testing.assert_allclose([state.returns.mean, state.returns.deviation], [1000.5, 0.5], rtol=1e-3)
