"""What learners of places are tested on: random rollouts, a buffer of them, and a point that walks about."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.config import loading
from star.config.section import ConfigError
from star.learners import replay
from star.learners.replay import Track, Transition

ENVS, LENGTH = 4, 6  # of a rollout
CAPACITY = 4 * LENGTH * ENVS
SMALL = {"buffer_size": CAPACITY, "batch_size": 16, "min_transitions": 24}


def parsed(learner, settings):
    """A small run whose Controller learns by `learner` with `settings`."""
    level = {"learner": learner, "frame": "map", learner: settings}
    small = {"trainer": {"num_envs": ENVS}, "tutor": {"enabled": False, "period": LENGTH}, "commander": {"period": 6}}
    return loading.parse({"controller": level, **small})


def refused(config, changes):
    """The line that tells what is wrong with `config` after `changes` of its sections."""
    values = config.model_dump(mode="json")
    for section, changed in changes.items():
        for key, value in changed.items():
            values[section][key] = values[section][key] | value if isinstance(value, dict) else value
    with pytest.raises(ConfigError) as caught:
        loading.parse(values)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def rollout(rng, epoch):
    """[LENGTH, ENVS] steps; some episodes end, half of them badly, and what follows in the rollout has no weight."""
    shape = (LENGTH, ENVS)
    ended = (rng.random(shape) < 0.1).astype(np.float32)
    alive = np.concatenate([np.ones((1, ENVS)), np.cumprod(1 - ended, axis=0)[:-1]]).astype(np.float32)
    numbers = lambda *more: rng.normal(size=(*shape, *more)).astype(np.float32)  # noqa: E731
    track = Track(numbers(2), ended, np.full(shape, epoch, np.float32))
    zero, lost = np.zeros(shape, np.float32), (ended * (rng.random(shape) < 0.5)).astype(np.float32)
    return Transition(numbers(5), numbers(2), zero, numbers(5), lost, zero, alive, extras=track)


EXAMPLE = jax.tree.map(lambda x: x[0, 0], rollout(np.random.default_rng(0), 0))


def filled(rng, kept, rollouts):
    """A buffer of what is `kept` of each transition, and its steps [ENVS] in order of time; two rollouts an epoch."""
    ring, steps, add = replay.create(kept(EXAMPLE), size=CAPACITY), [], jax.jit(replay.add)
    for number in range(rollouts):
        one = kept(rollout(rng, epoch=number // 2))
        ring = add(ring, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), one))
        steps += [jax.tree.map(lambda x, t=t: x[t], one) for t in range(LENGTH)]
    return ring, steps


def slow_left(steps):
    """Steps that follow each of `steps`, a list of rows of environments in order of time."""
    left = np.zeros((len(steps), ENVS), int)
    for b in range(ENVS):
        for t in range(len(steps)):
            for now, after in zip(steps[t:], steps[t + 1 :], strict=False):
                goes_on = now.weight[b] and not now.track.over[b] and after.weight[b]
                if not goes_on or now.track.epoch[b] != after.track.epoch[b]:
                    break
                left[t, b] += 1
    return left


def cosines(learner, chosen, *, rollouts):
    """What is learnt of a point that moves by a fifth of its action, as it walks at random.

    Cosines between the way to a goal and each action of a chunk, [200 goals, chunk]. It sees its place twice.
    """

    def walk(place, key):
        move = 0.2 * jax.random.uniform(key, place.shape, minval=-1, maxval=1)
        return place + move, (place, 5 * move)

    @jax.jit
    def learn(state, key):
        begin, walk_key, key = jax.random.split(key, 3)
        start = jax.random.uniform(begin, (64, 2), minval=-1, maxval=1)
        _, (place, action) = jax.lax.scan(walk, start, jax.random.split(walk_key, 24))
        seen = jnp.concatenate([place, place[..., :1], 0 * place], axis=-1)
        zero = jnp.zeros(place.shape[:2])
        track = Track(place, zero, zero + jax.random.uniform(key))
        one = Transition(seen, action, zero, seen, zero, zero, zero + 1, extras=track)
        return learner.update(chosen, state, one, key=key)[0]

    state = jax.jit(partial(learner.init, example=EXAMPLE))(jax.random.key(0), chosen)
    for number in range(rollouts):
        state = learn(state, jax.random.key(number))
    place, goal = np.random.default_rng(0).uniform(-1, 1, (2, 200, 2)).astype(np.float32)
    seen, way = np.concatenate([place, place[:, :1], goal], axis=1), (goal - place)[:, None]
    action = jax.jit(partial(learner.act, deterministic=True))(chosen, state, seen, key=jax.random.key(0))
    action = np.asarray(action).reshape(200, -1, 2)
    return (action * way).sum(-1) / (np.linalg.norm(action, axis=-1) * np.linalg.norm(way, axis=-1))
