"""F_k against the equations, as a network for reachability, and as a learner."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from star.abstraction import forward_model, reachability, regions
from star.abstraction.forward_model import Outcome
from star.config import loading

SPACE = np.float32([[-4.0, 0.0], [20.0, 10.0]])

# Compiled once, not each time that a test calls them.
predict, errors = jax.jit(forward_model.predict), jax.jit(forward_model.errors)
hulls = jax.jit(jax.vmap(reachability.hull, in_axes=(None, 0, 0)))


@cache
def begun(chosen):
    return jax.jit(lambda: forward_model.init(jax.random.key(0), chosen, space=jnp.asarray(SPACE)))()


def settings(**values):
    values = {"hidden": [8, 6], "batch_size": 16, "buffer_size": 32, "updates_per_epoch": 3} | values
    return loading.parse({"forward_model": values}).forward_model


def random_outcome(n, seed=0):
    rng = np.random.default_rng(seed)
    start = rng.uniform(SPACE[0], SPACE[1], (n, 2)).astype(np.float32)
    lower = rng.uniform(SPACE[0], SPACE[1], (n, 2)).astype(np.float32)
    return Outcome(start=start, lower=lower, upper=lower + 3, end=start + 1, weight=np.ones(n, np.float32))


def slow_predict(params, residual, start, lower, upper):
    middle, half = np.float64(SPACE[0] + SPACE[1]) / 2, np.float64(SPACE[1] - SPACE[0]) / 2
    x = np.concatenate([(start - middle) / half, (lower - middle) / half, (upper - middle) / half])
    layers = params["params"]
    for i in range(3):
        x = x @ np.float64(layers[f"Dense_{i}"]["kernel"]) + np.float64(layers[f"Dense_{i}"]["bias"])
        x = np.maximum(x, 0) if i < 2 else x
    return (start if residual else middle) + half * x


@pytest.fixture(scope="module", params=[True, False], ids=["residual", "absolute"])
def model(request):
    chosen = settings(residual=request.param)
    state = jax.device_get(begun(chosen))
    noisy = jax.tree.map(lambda p: p + np.float32(0.1), state.params)  # biases start at 0, where they could hide
    return chosen, state.replace(params=noisy)


@pytest.fixture(scope="module")
def train():
    return jax.jit(lambda chosen, state, fresh, key: forward_model.train(chosen, state, fresh, key=key))


def test_predictions_follow_the_equation(model):
    chosen, state = model
    batch = random_outcome(20)
    predicted = np.asarray(predict(chosen, state, batch.start, batch.lower, batch.upper))
    for n in range(20):
        expected = slow_predict(state.params, chosen.residual, batch.start[n], batch.lower[n], batch.upper[n])
        np.testing.assert_allclose(predicted[n], expected, rtol=1e-4, atol=1e-4)


def test_errors_are_squared_distances_to_where_the_period_ended(model):
    chosen, state = model
    batch = random_outcome(20)
    found = np.asarray(errors(chosen, state, batch))
    for n in range(20):
        predicted = slow_predict(state.params, chosen.residual, batch.start[n], batch.lower[n], batch.upper[n])
        np.testing.assert_allclose(found[n], ((predicted - batch.end[n]) ** 2).sum(), rtol=1e-3)


def test_the_network_of_a_box_predicts_the_same(model):
    chosen, state = model
    batch = random_outcome(20)
    network = jax.jit(forward_model.network)(chosen, state, batch.lower[0], batch.upper[0])
    low, high = jax.device_get(hulls(network, batch.start, batch.start))
    for n in range(20):
        expected = slow_predict(state.params, chosen.residual, batch.start[n], batch.lower[0], batch.upper[0])
        np.testing.assert_allclose((low[n] + high[n]) / 2, expected, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(low[n], high[n], atol=1e-2)  # a point's hull is a point but for rounding


def test_training_learns_where_each_commanded_box_leads(train):
    chosen = settings(batch_size=64, buffer_size=256, updates_per_epoch=400, learning_rate=0.01)
    state = begun(chosen)
    batch = random_outcome(256)
    batch = batch.replace(end=batch.start + np.where(batch.lower[:, :1] > 8, np.float32(3), np.float32(-1)))
    before = np.asarray(errors(chosen, state, batch)).mean()
    state, metrics = train(chosen, state, batch, jax.random.key(1))
    after = np.asarray(errors(chosen, state, batch))
    assert float(np.median(after)) < 0.25 < float(before)
    assert np.isfinite(metrics["loss"])


def test_outcomes_of_weight_0_teach_nothing_and_are_not_remembered(train):
    chosen = settings()
    state = begun(chosen)
    half = np.arange(16) % 2
    batch = random_outcome(16).replace(weight=np.float32(half))
    garbage = batch.replace(end=np.where(half[:, None] > 0, batch.end, 1e6).astype(np.float32))
    (first, _), (second, _) = (train(chosen, state, b, jax.random.key(1)) for b in (batch, garbage))
    jax.tree.map(np.testing.assert_array_equal, first.params, second.params)
    periods = jax.device_get(forward_model.remembered(first))
    assert periods.start.shape == (32, 2)
    for name in ("start", "end"):
        real = np.asarray(getattr(periods, name))[np.asarray(periods.weight) > 0]
        np.testing.assert_array_equal(real, getattr(batch, name)[half > 0])


def test_nothing_is_remembered_before_the_first_outcome():
    assert not np.asarray(forward_model.remembered(begun(settings())).weight).any()


def test_traffic_counts_the_remembered_periods_between_regions(train):
    chosen = settings()
    table, traffic = regions.create(tuple(SPACE), ((0.0, 8.0), (5.0,)), max_regions=8), jax.jit(forward_model.traffic)
    state = begun(chosen)
    assert not np.asarray(traffic(state, table)).any()
    batch = random_outcome(16).replace(weight=np.float32(np.arange(16) % 3 > 0))
    batch = batch.replace(end=batch.start[::-1] + 0.5)
    state, _ = train(chosen, state, batch, jax.random.key(1))
    expected = np.zeros((8, 8))
    boxes = list(zip(np.asarray(table.lower)[:6], np.asarray(table.upper)[:6], strict=True))

    def inside(point):
        point = np.clip(point, SPACE[0], np.asarray(SPACE[1]) - 1e-3)
        return next(r for r, (lower, upper) in enumerate(boxes) if (lower <= point).all() and (point < upper).all())

    for start, end, weight in zip(batch.start, batch.end, batch.weight, strict=True):
        expected[inside(start), inside(end)] += weight
    np.testing.assert_array_equal(traffic(state, table), expected)
    assert expected.sum() == 10 and (expected > 0).sum() > 5
