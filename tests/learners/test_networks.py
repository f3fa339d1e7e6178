"""Multilayer perceptrons and running statistics, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np

from star.learners.networks import MLP, Normalizer, apply


def test_an_mlp_is_affine_maps_with_an_activation_between():
    mlp = MLP((5, 4), 2)
    params = mlp.init(jax.random.key(0), jnp.zeros(3))
    params = jax.tree.map(lambda p: p + 0.1, params)
    x = np.random.default_rng(0).normal(size=(2, 7, 3)).astype(np.float32)
    expected = x.astype(np.float64)
    for i in range(3):
        layer = params["params"][f"Dense_{i}"]
        expected = expected @ np.float64(layer["kernel"]) + np.float64(layer["bias"])
        if i < 2:
            expected = np.maximum(expected, 0)
    got = apply(mlp, params, x)
    assert got.shape == (2, 7, 2)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_final_scale_shrinks_the_initial_output_and_nothing_else():
    x = jax.random.normal(jax.random.key(1), (50, 3))
    plain, small = (MLP((16,), 2, final_scale=scale) for scale in (1.0, 0.01))
    key = jax.random.key(0)
    np.testing.assert_allclose(
        small.apply(small.init(key, x[0]), x), 0.01 * plain.apply(plain.init(key, x[0]), x), rtol=1e-4
    )


def test_running_statistics_are_those_of_all_rows_with_weight_1():
    rng = np.random.default_rng(0)
    normalizer, update = Normalizer.create(3), jax.jit(Normalizer.update)
    seen = []
    for mean in (0.0, 50.0, -5.0, 2.0):
        rows = rng.normal(mean, 3.0, (20, 3)).astype(np.float32)
        weight = (rng.random(20) < 0.5).astype(np.float32)
        seen.append(rows[weight > 0])
        normalizer = update(normalizer, jnp.where(weight[:, None] > 0, rows, 1e4), weight)
        everything = np.concatenate(seen)
        np.testing.assert_allclose(normalizer.mean, everything.mean(0), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(normalizer.variance, everything.var(0), rtol=1e-3)
        assert float(normalizer.count) == len(everything)


def test_a_batch_without_weight_changes_nothing():
    before = Normalizer.create(2).update(jnp.array([[1.0, 2.0], [3.0, 8.0]]), jnp.ones(2))
    after = before.update(jnp.full((4, 2), 9.0), jnp.zeros(4))
    jax.tree.map(np.testing.assert_allclose, before, after)
    fresh = Normalizer.create(2)
    jax.tree.map(np.testing.assert_array_equal, fresh, fresh.update(jnp.full((4, 2), 9.0), jnp.zeros(4)))


def test_normalised_values_have_mean_0_and_variance_1_and_are_clipped():
    rows = jax.random.normal(jax.random.key(0), (500, 2)) * jnp.array([3.0, 0.5]) + jnp.array([10.0, -4.0])
    normalizer = Normalizer.create(2).update(rows, jnp.ones(500))
    out = normalizer(rows)
    np.testing.assert_allclose(out.mean(0), 0, atol=1e-4)
    np.testing.assert_allclose(out.std(0), 1, atol=1e-3)
    np.testing.assert_array_equal(normalizer(jnp.array([1e6, -1e6])), [10, -10])
