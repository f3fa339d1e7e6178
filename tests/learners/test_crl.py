"""Contrastive RL: which goals it draws, what its critic is told, and learning on the smallest of tasks."""

from functools import partial

import jax
import numpy as np
import pytest
from scipy import stats

from star.learners import crl, futures, replay
from star.learners.futures import Future, Step
from tests.learners import places
from tests.learners.places import CAPACITY, ENVS, EXAMPLE, LENGTH, SMALL, filled, rollout, slow_left


def parsed(**values):
    return places.parsed("crl", SMALL | values)


def settings(**values):
    return parsed(**values).controller.crl


init = jax.jit(partial(crl.init, example=EXAMPLE))
steps_left = jax.jit(partial(futures.steps_left, num_envs=ENVS))


@jax.jit
def drawn(chosen, ring, key):
    """A batch and its goals."""
    return crl._drawn(chosen, ring, Future.of(ring, num_envs=ENVS), key)


@pytest.mark.parametrize("rollouts", [1, 3, 4, 7])
def test_goals_lie_ahead_in_the_same_episode_also_where_the_buffer_has_begun_anew(rollouts):
    ring, steps = filled(np.random.default_rng(rollouts), Step.of, rollouts)
    kept = steps[-4 * LENGTH :]
    found = np.asarray(steps_left(ring)).reshape(-1, ENVS)
    first = len(steps) % (4 * LENGTH) if len(steps) > len(kept) else 0
    np.testing.assert_array_equal(np.roll(found, -first, axis=0)[: len(kept)], slow_left(kept))
    assert not found[len(kept) :].any() and found.max() > 2


def test_it_draws_every_step_that_another_follows_and_its_goal_from_the_steps_that_follow():
    chosen = settings(batch_size=96)
    ring, steps = filled(np.random.default_rng(5), Step.of, 3)  # a quarter of the buffer stays empty
    left = slow_left(steps)
    goals = {  # of each step, which its first number tells, the places that it may be sent to
        float(steps[t].obs[b, 0]): {tuple(steps[t + n].track.place[b]) for n in range(1, left[t, b] + 1)}
        for t, b in np.argwhere(left)
    }
    seen = set()
    for number in range(10):
        batch, goal = jax.device_get(drawn(chosen, ring, jax.random.key(number)))
        assert batch.weight.all()
        for first, place in zip(batch.obs[:, 0].tolist(), goal, strict=True):
            assert tuple(place) in goals[first]
            seen.add(first)
    assert seen == goals.keys()


def test_a_buffer_in_which_nothing_follows_gives_a_batch_without_weight():
    ring = replay.create(Step.of(EXAMPLE), size=CAPACITY)
    assert not np.asarray(drawn(settings(batch_size=96), ring, jax.random.key(0))[0].weight).any()


def test_networks_begin_with_weights_as_small_as_those_of_jaxgcrl():
    """Its uniform weights have the variance 1 / 3n where a layer has n inputs."""
    chosen = settings(hidden=[200, 200], representation=100)
    params = jax.device_get(init(jax.random.key(0), chosen).params)
    for layers in (params["actor"], params["critic"]["action"], params["critic"]["goal"]):
        kernels = [layer["kernel"] for layer in layers["params"].values()]
        assert len(kernels) == 3
        for kernel in kernels[1:]:
            assert float(kernel.var() * 3 * len(kernel)) == pytest.approx(1.0, rel=0.2)


def test_how_far_goals_lie_ahead_is_geometric_and_cut_off_at_the_end():
    uniform = np.random.default_rng(0).random(20_000, np.float32)
    ahead = jax.jit(partial(futures.ahead, discount=0.8))
    drawn = np.asarray(ahead(np.full(uniform.shape, 5), uniform))
    wanted = 0.8 ** np.arange(5)
    assert stats.chisquare(np.bincount(drawn, minlength=6)[1:], len(drawn) * wanted / wanted.sum()).pvalue > 1e-4
    assert not np.asarray(ahead(np.zeros(uniform.shape, int), uniform)).any()


def slow_mlp(params, x):
    layers = params["params"]
    for i in range(len(layers)):
        x = x @ np.float64(layers[f"Dense_{i}"]["kernel"]) + np.float64(layers[f"Dense_{i}"]["bias"])
        x = x / (1 + np.exp(-x)) if i < len(layers) - 1 else x
    return x


def test_the_critic_tells_its_own_goal_from_those_of_others():
    chosen = settings(hidden=[8], representation=3, logsumexp_penalty=0.2)
    critic, rng = jax.device_get(init(jax.random.key(1), chosen).params["critic"]), np.random.default_rng(2)
    batch = jax.tree.map(lambda x: x[:, 0], Step.of(rollout(rng, 0)))
    batch = batch.replace(weight=np.float32([1, 1, 0, 1, 1, 1]))
    goal = rng.normal(size=(LENGTH, 2)).astype(np.float32)
    obs, lost = np.float64(batch.obs), []
    for i in range(LENGTH):
        phi = slow_mlp(critic["action"], np.concatenate([obs[i, :3], batch.action[i]]))
        energy = [-np.sqrt(((phi - slow_mlp(critic["goal"], g)) ** 2).sum() + 1e-6) for g in goal]
        total = np.log(np.exp(energy).sum())
        lost.append(total - energy[i] + 0.2 * total**2)
    loss, _ = jax.jit(crl._critic_loss)(chosen, critic, batch, goal)
    assert float(loss) == pytest.approx(np.mean(np.delete(lost, 2)), rel=1e-4)


def test_it_learns_to_go_to_goals_that_no_reward_tells_of():
    chosen = settings(
        hidden=[32], batch_size=64, buffer_size=1536, updates_per_rollout=30, learning_rate=5e-3, discount=0.8
    )
    assert np.median(places.cosines(crl.LEARNER, chosen, rollouts=5)) > 0.9


@pytest.mark.parametrize(
    ("level", "message"),
    [
        ({"controller": {"frame": "world"}}, "controller: frame: world, but learner crl needs the places of goals"),
        (
            {"tutor": {"enabled": True, "learner": "crl"}},
            "tutor.learner: 'crl' is not allowed: should be 'ppo', 'td3' or 'module:name' of your own",
        ),
        ({"controller": {"crl": {"buffer_size": 100}}}, "controller.crl.buffer_size: 100 is not a multiple of one"),
        ({"controller": {"crl": {"min_transitions": 97}}}, "controller.crl.min_transitions: 97 exceeds buffer_size 96"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(level, message):
    assert message in places.refused(parsed(), level)
