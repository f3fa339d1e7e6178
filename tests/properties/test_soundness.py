"""The hull of a box contains the image of every point of the box, rounding included."""

from functools import cache

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from star.abstraction import reachability
from star.abstraction.reachability import Network, Zonotope

POINTS = 100_000
ARCHITECTURES = [  # widths of input, hidden layers and output; residual
    ((2, 2), False),
    ((3, 3), True),
    ((2, 8, 2), True),
    ((3, 16, 5), False),
    ((2, 32, 32, 2), True),
    ((4, 20, 12, 7, 3), False),
]


@cache
def compiled(residual):
    """Hull, smear and the float32 images of many points, of one network."""

    def everything(layers, lower, upper, points):
        network = Network(layers=layers, residual=residual)
        x = points
        for weight, bias in layers[:-1]:
            x = jax.nn.relu(x @ weight.T + bias)
        x = x @ layers[-1][0].T + layers[-1][1] + (points if residual else 0.0)
        return reachability.hull(network, lower, upper), reachability.smear(network, lower, upper), x

    return jax.jit(everything)


def random_case(widths, seed, *, at, size, gain):
    rng = np.random.default_rng(seed)
    layers = []
    for n, m in zip(widths[:-1], widths[1:], strict=True):
        layers.append((gain * rng.normal(size=(m, n)) / np.sqrt(n), gain * rng.normal(size=m)))
    layers = tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)
    lower = (at * rng.normal(size=widths[0])).astype(np.float32)
    upper = np.maximum(lower, lower + (size * rng.random(widths[0])).astype(np.float32))
    share = rng.random((POINTS, widths[0]))
    share[: POINTS // 4] = rng.integers(0, 2, (POINTS // 4, widths[0]))  # corners
    points = np.clip((lower + share * (upper - lower)).astype(np.float32), lower, upper)
    return layers, lower, upper, points


def image_and_slopes(layers, residual, points):
    """In float64: the images, and the largest |d out / d in| over the points."""
    x = points.astype(np.float64)
    slopes = np.eye(points.shape[1])[None].repeat(200, 0)
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight.T.astype(np.float64) + bias
        slopes = weight.astype(np.float64) @ slopes
        if i < len(layers) - 1:
            slopes = slopes * (x[-200:] > 0)[..., None]
            x = np.maximum(x, 0)
    if residual:
        x, slopes = x + points, slopes + np.eye(points.shape[1])
    return x, np.abs(slopes).max(0)


@settings(max_examples=20)
@given(
    architecture=st.sampled_from(ARCHITECTURES),
    seed=st.integers(0, 2**32 - 1),
    at=st.sampled_from([0.0, 1.0, 30.0, 1e4]),
    size=st.sampled_from([0.0, 1e-6, 1e-2, 1.0, 50.0, 1e4]),
    gain=st.sampled_from([0.1, 1.0, 5.0]),
)
def test_the_hull_contains_the_image_and_the_smear_bounds_the_slopes(architecture, seed, at, size, gain):
    widths, residual = architecture
    layers, lower, upper, points = random_case(widths, seed, at=at, size=size, gain=gain)
    (low, high), smear, image32 = jax.tree.map(np.asarray, compiled(residual)(layers, lower, upper, points))
    image64, slopes = image_and_slopes(layers, residual, points)
    for image in (image32, image64):
        assert (low <= image.min(0)).all()
        assert (image.max(0) <= high).all()
    expected = slopes.sum(0) * (upper.astype(np.float64) - lower) / 2
    assert (smear >= expected * (1 - 1e-5)).all()


relu, affine = jax.jit(reachability.relu), jax.jit(reachability.affine)
from_box, radius = jax.jit(reachability.from_box), jax.jit(lambda z: z.radius)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([1e-3, 1.0, 1e3]))
def test_the_relaxation_of_relu_keeps_every_point_with_the_noise_symbols_it_had(seed, spread):
    rng = np.random.default_rng(seed)
    m, n = 5, 6
    z = Zonotope(
        centre=np.float32(spread * rng.normal(size=n)),
        generators=np.float32(spread * rng.normal(size=(m, n)) / m),
        slack=np.float32(0.01 * spread * rng.random(n)),
    )
    after = jax.device_get(relu(z))
    noise = rng.uniform(-1, 1, (2000, m))
    noise[:32] = np.sign(noise[:32])
    wiggle = rng.uniform(-1, 1, (2000, n))
    x = np.float64(z.centre) + noise @ np.float64(z.generators) + wiggle * np.float64(z.slack)
    shared = np.float64(after.centre) + noise @ np.float64(after.generators[:m])
    rest = np.abs(np.float64(after.generators[m:])).sum(0) + np.float64(after.slack)
    assert (np.abs(np.maximum(x, 0) - shared) <= rest).all()


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_affine_maps_are_exact(seed):
    rng = np.random.default_rng(seed)
    weight, bias = rng.normal(size=(3, 2)), rng.normal(size=3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    lower, upper = np.sort(rng.normal(size=(2, 2)), axis=0)
    z = from_box(np.float32(lower), np.float32(upper))
    # There and back by a rotation: boxes would grow, zonotopes do not.
    for w, b in ((weight, bias), (turn, np.zeros(3)), (turn.T, np.zeros(3))):
        z = affine(z, np.float32(w), np.float32(b))
    corners = np.array([[x, y] for x in (lower[0], upper[0]) for y in (lower[1], upper[1])]) @ weight.T + bias
    centre, half = np.asarray(z.centre), np.asarray(radius(z))
    np.testing.assert_allclose(centre - half, corners.min(0), atol=1e-4)
    np.testing.assert_allclose(centre + half, corners.max(0), atol=1e-4)
