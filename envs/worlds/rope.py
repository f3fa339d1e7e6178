"""A line with a float, hung from a tip that moves: it pulls, and never pushes.

The line is two stretches of equal length with a mass between them, and the float at its end. A stretch may be slack,
but is never longer than it is. Between control steps masses fall freely, and then tensions t >= 0 bring them back:

    x' = x + dt (v + dt g) (1 - drag dt),    x'_1 -= t_1 n_1 - t_2 n_2,    x'_2 -= share t_2 n_2,    v' = (x' - x) / dt

so that no stretch is too long. n_i is the direction of stretch i before the step where it was taut, which keeps the
energy to the second order of dt (SHAKE; Ryckaert, Ciccotti and Berendsen 1977), and after it where it was slack: so a
jerk is inelastic. The two tensions are found by Newton's rule.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

GRAVITY, DRAG = 9.81, 1.0  # m/s^2, 1/s
LENGTH = 1.0  # m
SHARE = 1 / 6  # mass of the middle over that of the float
DT = 0.0025  # s: with steps of .5 ms nearly all floats of the world fishing come down within 2 cm of where they do
ROUNDS = 3  # of Newton's rule
TAUT = 1e-3  # of a stretch: what lacks less is taut

Vector = tuple[Array, Array, Array]


def swing(tip: Float[Array, "3 steps"]) -> Float[Array, "2 3 steps"]:
    """The mass in the middle, and the float, at the same times as the tip: every `DT`. It begins at rest."""
    stretch = LENGTH / 2
    start = _vector(tip[:, 0])
    middle, end = _plus(start, (0.0, 0.0, -stretch)), _plus(start, (0.0, 0.0, -LENGTH))
    still = _times(0.0, start)

    def step(state: tuple[tuple[Vector, Vector], tuple[Vector, Vector]], ends: tuple[Array, Array]) -> tuple[Any, Any]:
        (middle, end), speeds = state
        before, anchor = (_vector(one) for one in ends)
        falling = [_times(1 - DRAG * DT, _plus(speed, (0.0, 0.0, -GRAVITY * DT))) for speed in speeds]
        free = [_plus(x, _times(DT, v)) for x, v in zip((middle, end), falling, strict=True)]
        upper = _direction(_minus(middle, before), _minus(free[0], anchor))
        lower = _direction(_minus(end, middle), _minus(free[1], free[0]))
        now = _pulled(anchor, free[0], free[1], upper, lower)
        moved = [_times(1 / DT, _minus(x, old)) for x, old in zip(now, (middle, end), strict=True)]
        return (now, (moved[0], moved[1])), now

    _, masses = jax.lax.scan(step, ((middle, end), (still, still)), (tip[:, :-1].T, tip[:, 1:].T))
    rest = [jnp.stack(one)[:, None] for one in (middle, end)]
    later = [jnp.stack(one) for one in masses]
    return jnp.stack([jnp.concatenate(pair, axis=1) for pair in zip(rest, later, strict=True)])


def _direction(before: Vector, after: Vector) -> Vector:
    """The direction in which a stretch pulls."""
    taut = _length(before) > LENGTH / 2 * (1 - TAUT)
    old, new = _unit(before), _unit(after)
    return (jnp.where(taut, old[0], new[0]), jnp.where(taut, old[1], new[1]), jnp.where(taut, old[2], new[2]))


def _pulled(anchor: Vector, middle: Vector, end: Vector, upper: Vector, lower: Vector) -> tuple[Vector, Vector]:
    """Middle and float where tensions along both directions leave no stretch too long."""
    nothing = jnp.zeros_like(anchor[0])

    def places(first: Array, second: Array) -> tuple[Vector, Vector]:
        pulled = _plus(middle, _minus(_times(second, lower), _times(first, upper)))
        return pulled, _minus(end, _times(SHARE * second, lower))

    def closer(_: Array, tensions: tuple[Array, Array]) -> tuple[Array, Array]:
        first, second = tensions
        here, there = places(first, second)
        d1, d2 = _minus(here, anchor), _minus(there, here)
        e1, e2 = _length(d1) - LENGTH / 2, _length(d2) - LENGTH / 2
        on1, on2 = (e1 > 0) | (first > 0), (e2 > 0) | (second > 0)
        m1, m2 = _unit(d1), _unit(d2)
        a11, a22 = jnp.where(on1, _dot(m1, upper), 1.0), jnp.where(on2, (1 + SHARE) * _dot(m2, lower), 1.0)
        both = on1 & on2
        a12, a21 = jnp.where(both, -_dot(m1, lower), 0.0), jnp.where(both, -_dot(m2, upper), 0.0)
        e1, e2 = jnp.where(on1, e1, 0.0), jnp.where(on2, e2, 0.0)
        volume = a11 * a22 - a12 * a21
        return (
            jnp.maximum(first + (a22 * e1 - a12 * e2) / volume, 0.0),
            jnp.maximum(second + (a11 * e2 - a21 * e1) / volume, 0.0),
        )

    pulled, last = places(*jax.lax.fori_loop(0, ROUNDS, closer, (nothing, nothing)))
    near = _near(anchor, pulled)
    return near, _near(near, last)


def _near(start: Vector, end: Vector) -> Vector:
    """`end`, or where a stretch from `start` towards it ends: a jerk for which the rounds are too few does no harm."""
    way = _minus(end, start)
    return _plus(start, _times(jnp.minimum(1.0, LENGTH / 2 / _length(way)), way))


def _vector(point: Float[Array, "3"]) -> Vector:
    """Its numbers one by one: over a batch each is a whole row, which is several times faster on a CPU."""
    return point[0], point[1], point[2]


def _plus(one: Vector, other: tuple[Any, Any, Any]) -> Vector:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _minus(one: Vector, other: Vector) -> Vector:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _times(factor: Array | float, one: Vector) -> Vector:
    return factor * one[0], factor * one[1], factor * one[2]


def _dot(one: Vector, other: Vector) -> Array:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _length(one: Vector) -> Array:
    return jnp.sqrt(jnp.maximum(_dot(one, one), 1e-12))


def _unit(one: Vector) -> Vector:
    return _times(1 / _length(one), one)
