"""Multilayer perceptrons and running statistics, against NumPy."""

import jax
import numpy as np

from star.learners.networks import MLP, Normalizer, apply


def test_an_mlp_is_affine_maps_with_an_activation_between():
    mlp = MLP((5, 4), 2)
    params = jax.device_get(jax.jit(mlp.init)(jax.random.key(0), np.zeros(3, np.float32)))
    params = jax.tree.map(lambda p: p + np.float32(0.1), params)
    x = np.random.default_rng(0).normal(size=(2, 7, 3)).astype(np.float32)
    expected = x.astype(np.float64)
    for i in range(3):
        layer = params["params"][f"Dense_{i}"]
        expected = expected @ np.float64(layer["kernel"]) + np.float64(layer["bias"])
        if i < 2:
            expected = np.maximum(expected, 0)
    got = jax.jit(apply, static_argnums=0)(mlp, params, x)
    assert got.shape == (2, 7, 2)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_final_scale_shrinks_the_initial_output_and_nothing_else():
    x = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)

    def begun(scale):
        mlp = MLP((16,), 2, final_scale=scale)
        return np.asarray(jax.jit(lambda key: mlp.apply(mlp.init(key, x[0]), x))(jax.random.key(0)))

    np.testing.assert_allclose(begun(0.01), 0.01 * begun(1.0), rtol=1e-4)


update = jax.jit(Normalizer.update)


def test_running_statistics_are_those_of_all_rows_with_weight_1():
    rng = np.random.default_rng(0)
    normalizer = Normalizer.create(3)
    seen = []
    for mean in (0.0, 50.0, -5.0, 2.0):
        rows = rng.normal(mean, 3.0, (20, 3)).astype(np.float32)
        weight = (rng.random(20) < 0.5).astype(np.float32)
        seen.append(rows[weight > 0])
        normalizer = update(normalizer, np.where(weight[:, None] > 0, rows, np.float32(1e4)), weight)
        everything = np.concatenate(seen)
        np.testing.assert_allclose(normalizer.mean, everything.mean(0), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(normalizer.variance, everything.var(0), rtol=1e-3)
        assert float(normalizer.count) == len(everything)


def test_a_batch_without_weight_changes_nothing():
    fresh, nothing, rows = Normalizer.create(3), np.zeros(20, np.float32), np.full((20, 3), 9.0, np.float32)
    before = update(fresh, np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32), nothing + 1)
    jax.tree.map(np.testing.assert_allclose, before, update(before, rows, nothing))
    jax.tree.map(np.testing.assert_array_equal, fresh, update(fresh, rows, nothing))


def test_normalised_values_have_mean_0_and_variance_1_and_are_clipped():
    rows = np.random.default_rng(0).normal([10.0, -4.0], [3.0, 0.5], (500, 2)).astype(np.float32)
    normalizer = update(Normalizer.create(2), rows, np.ones(500, np.float32))
    normalise = jax.jit(lambda normalizer, rows: normalizer(rows))
    out = np.asarray(normalise(normalizer, rows))
    np.testing.assert_allclose(out.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(out.std(0), 1, atol=1e-3)
    far = np.asarray(normalise(normalizer, np.tile(np.float32([1e6, -1e6]), (500, 1))))
    np.testing.assert_array_equal(far[0], [10, -10])
