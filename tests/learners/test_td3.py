"""TD3: when it updates, what its critics aim at, and learning on the smallest of tasks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.config import loading
from star.learners import replay, td3
from star.learners.networks import Normalizer
from star.learners.replay import Transition


def settings(**values):
    values = {
        "hidden": [8],
        "batch_size": 16,
        "buffer_size": 64,
        "min_transitions": 16,
        "updates_per_rollout": 1,
        "tau": 0.1,
    } | values
    small = {"trainer": {"num_envs": 6}, "tutor": {"enabled": False}}  # whose rollouts fit into such a buffer
    return loading.parse({"controller": {"learner": "td3", "td3": values}, **small}).controller.td3


def random_rollout(seed=0, n=16):
    """[1, n] transitions; as many in all tests, so that an update is compiled once."""
    rng = np.random.default_rng(seed)
    f32 = lambda *shape: rng.uniform(-1, 1, shape).astype(np.float32)  # noqa: E731
    zero, one = np.zeros((1, n), np.float32), np.ones((1, n), np.float32)
    return Transition(f32(1, n, 3), f32(1, n, 2), f32(1, n), f32(1, n, 3), zero, zero, one)


EXAMPLE = jax.tree.map(lambda x: 0 * x[0, 0], random_rollout())


@pytest.fixture(scope="module")
def start():
    state = jax.jit(lambda key: td3.init(key, settings(), example=EXAMPLE))(jax.random.key(0))
    begun = jax.device_get((state.params, state.target))
    params = jax.tree.map(lambda p: 4 * p, begun[0])  # critics that begin flat tell little
    # Targets unlike the networks show that they are used, and how they move.
    return state.replace(params=params, target=jax.tree.map(lambda p: 0.5 * p + np.float32(0.1), begun[1]))


@pytest.fixture(scope="module")
def update():
    """An update from batches with so much `more` reward."""

    @jax.jit
    def run(chosen, state, rollout, key, more):
        relabel = lambda batch, key: batch.replace(reward=batch.reward + more)  # noqa: E731
        return td3.update(chosen, state, rollout, relabel=relabel, key=key)

    def call(chosen, state, rollout, seed=1, more=0.0):
        return jax.device_get(run(chosen, state, rollout, jax.random.key(seed), more))

    return call


@partial(jax.jit, static_argnames="deterministic")
def act(chosen, state, obs, seed, *, deterministic=False):
    return td3.act(chosen, state, obs, deterministic=deterministic, key=jax.random.key(seed))


def slow_mlp(params, x):
    layers = params["params"]
    for i in range(len(layers)):
        x = x @ np.float64(layers[f"Dense_{i}"]["kernel"]) + np.float64(layers[f"Dense_{i}"]["bias"])
        x = np.maximum(x, 0) if i < len(layers) - 1 else x
    return x


def slow_qs(critics, obs, action):
    x = np.concatenate([obs, action])
    return [slow_mlp(jax.tree.map(lambda p, i=i: p[i], critics), x)[0] for i in range(2)]


@pytest.mark.parametrize(("terminated", "scale"), [(0.0, 1.0), (1.0, 1.0), (1.0, 50.0)])
def test_the_critics_aim_at_the_smaller_target_and_do_not_bootstrap_past_a_termination(
    start, update, terminated, scale
):
    chosen = settings(target_noise=0.0, discount=0.9)
    known = Normalizer(mean=np.float32([0.1, -0.2, 0.3]), variance=np.float32([0.5, 1.0, 2.0]), count=np.float32(1e9))
    one = random_rollout(n=1)
    paid = Normalizer(mean=np.float32([0.3]), variance=np.float32([0.1]), count=np.float32(1e9))
    one = one.replace(reward=np.float32(scale) * one.reward, terminated=np.full((1, 1), terminated, np.float32))
    rollout = jax.tree.map(lambda x: np.repeat(x, 16, axis=1), one)  # any batch is made of this one
    unit = np.sqrt((0.3**2 + 0.1) / (1 - 0.9**2))  # deviation of a sum of discounted independent rewards
    action, reward = np.float64(one.action[0, 0]), np.float64(one.reward[0, 0]) / unit
    obs, next_obs = (
        (np.float64(x[0, 0]) - np.float64(known.mean)) / np.sqrt(np.float64(known.variance) + 1e-4)
        for x in (one.obs, one.next_obs)
    )
    next_action = np.tanh(slow_mlp(start.target["actor"], next_obs))
    goal = reward + 0.9 * (1 - terminated) * min(slow_qs(start.target["critic"], next_obs, next_action))
    errors = [abs(q - goal) for q in slow_qs(start.params["critic"], obs, action)]
    expected = sum(error**2 / 2 if error < 1 else error - 0.5 for error in errors)
    assert (min(errors) > 1) == (scale > 1), "both parts of the loss are seen"
    _, metrics = update(chosen, start.replace(normalizer=known, rewards=paid), rollout)
    np.testing.assert_allclose(metrics["critic_loss"], expected, rtol=1e-4)


def test_there_is_no_update_before_enough_transitions(start, update):
    state, _ = update(settings(min_transitions=17), start, random_rollout())
    assert int(state.updates) == 0 and int(replay.filled(state.ring)) == 16
    same = {"ring": None, "normalizer": None, "rewards": None}
    jax.tree.map(np.testing.assert_array_equal, state.replace(**same), start.replace(**same))
    np.testing.assert_allclose(state.normalizer.mean, random_rollout().obs[0].mean(axis=0), atol=1e-6)
    assert int(update(settings(), start, random_rollout())[0].updates) == 1


def test_actor_and_targets_move_every_second_update_and_targets_by_tau(start, update):
    changed = lambda a, b: any((x != y).any() for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))  # noqa: E731
    before = start
    for step in range(4):
        after, _ = update(settings(), before, random_rollout(seed=step), step)
        assert int(after.updates) == step + 1
        assert changed(after.params["critic"], before.params["critic"])
        moves = step % 2 == 0
        assert changed(after.params["actor"], before.params["actor"]) == moves
        rate = 0.1 if moves else 0.0
        jax.tree.map(
            lambda t, old, p, rate=rate: np.testing.assert_allclose(t, old + rate * (p - old), rtol=1e-4, atol=1e-6),
            after.target,
            before.target,
            after.params,
        )
        before = after


def test_transitions_of_weight_0_have_no_influence(start, update):
    rollout = random_rollout()
    off = np.arange(16) % 2 == 1
    rollout = rollout.replace(weight=np.float32(~off)[None])
    spoilt = rollout.replace(reward=np.where(off, 1e3, rollout.reward).astype(np.float32))
    (first, _), (second, _) = (update(settings(), start, r) for r in (rollout, spoilt))
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)


def test_relabelling_applies_to_the_batches_but_not_to_the_buffer(start, update):
    state, metrics = update(settings(), start, random_rollout(), more=100.0)
    assert float(metrics["critic_loss"]) > 50
    assert np.abs(replay.contents(state.ring)[0].reward).max() <= 1


def test_actions_stay_in_range_and_noise_is_for_exploration_only(start):
    chosen, later = settings(exploration_noise=0.5), start.replace(updates=np.int32(1))
    obs = np.tile(np.float32([1.0, -2.0, 0.5]), (5000, 1))
    still = [np.asarray(act(chosen, start, obs, seed, deterministic=True)) for seed in range(2)]
    np.testing.assert_array_equal(*still)
    noisy = np.asarray(act(chosen, later, obs, 0))
    assert np.abs(noisy).max() <= 1
    np.testing.assert_allclose(np.clip(noisy, -0.9, 0.9).mean(0), still[0][0], atol=0.05)
    assert (noisy.std(0) > 0.3).all()


def test_of_many_environments_the_first_hardly_explore_and_the_last_do_twice_as_much_as_the_mean(start):
    chosen, obs = settings(exploration_noise=0.1), np.zeros((4, 3), np.float32)
    later = start.replace(updates=np.int32(1))

    @jax.jit
    def noise(state, seeds):
        still = td3.act(chosen, state, obs[0], deterministic=True, key=jax.random.key(0))
        draw = lambda seed, obs: td3.act(chosen, state, obs, key=jax.random.key(seed)) - still  # noqa: E731
        return [jax.vmap(draw, (0, None))(seeds, seen) for seen in (obs, obs[0])]

    many, alone = jax.device_get(noise(later, np.arange(2000)))
    np.testing.assert_allclose(many.std(axis=(0, 2)), [0.025, 0.075, 0.125, 0.175], rtol=0.05)
    np.testing.assert_allclose(alone.std(), 0.1, rtol=0.05)


def test_before_the_first_update_actions_are_drawn_evenly_but_for_greedy_ones(start):
    obs = np.ones((5000, 3), np.float32)
    drawn = act(settings(), start, obs, 0)
    np.testing.assert_allclose(np.quantile(drawn, [0, 0.25, 0.5, 0.75, 1]), [-1, -0.5, 0, 0.5, 1], atol=0.03)
    assert not np.ptp(act(settings(), start, obs, 0, deterministic=True), axis=0).any()


def test_the_scale_of_rewards_does_not_matter(start, update):
    rollout = random_rollout()
    learnt = [
        update(settings(), start, rollout.replace(reward=np.float32(scale) * rollout.reward))[0].params
        for scale in (2.0**-7, 1.0, 2.0**7)
    ]
    for other in (learnt[0], learnt[2]):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), learnt[1], other)


def test_it_learns_the_best_action_of_a_one_step_task():
    chosen = settings(
        hidden=[32],
        batch_size=64,
        buffer_size=512,
        updates_per_rollout=20,
        actor_learning_rate=3e-3,
        critic_learning_rate=3e-3,
    )
    one = np.zeros(1, np.float32)
    example = EXAMPLE.replace(obs=one, next_obs=one, action=one)

    def once(state, key):
        action_key, obs_key, update_key = jax.random.split(key, 3)
        obs = jnp.where(jax.random.bernoulli(obs_key, shape=(1, 32, 1)), 1.0, -1.0)
        action = jax.random.uniform(action_key, (1, 32, 1), minval=-1, maxval=1)
        one = jnp.ones((1, 32))
        reward = -jnp.square(action - 0.5 * obs)[..., 0]
        return td3.update(chosen, state, Transition(obs, action, reward, obs, one, one, one), key=update_key)

    @jax.jit
    def learn(key):
        state, _ = jax.lax.scan(once, td3.init(key, chosen, example=example), jax.random.split(key, 40))
        return td3.act(chosen, state, jnp.array([[1.0], [-1.0]]), deterministic=True, key=key)

    np.testing.assert_allclose(np.asarray(learn(jax.random.key(0)))[:, 0], [0.5, -0.5], atol=0.15)
