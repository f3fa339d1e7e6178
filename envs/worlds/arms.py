"""Arms of revolute joints: where they are, and which posture reaches a point. Planar ones, and one of six joints."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def points(angles: Float[Array, "n *batch"], links: Sequence[float]) -> list[tuple[Array, Array]]:
    """(x, y) of the base, which is the origin, of the joints and last of the tip, in the unit of `links`.

    Each angle, in rad, is relative to the link before it; at 0 the arm points along x.
    """
    along = x = y = jnp.zeros_like(angles[0])
    found = [(x, y)]
    for angle, link in zip(angles, links, strict=True):  # a sum over an axis is several times slower on a CPU
        along = along + angle
        x, y = x + link * jnp.cos(along), y + link * jnp.sin(along)
        found.append((x, y))
    return found


def posture(
    target: Float[Array, "*batch 2"], links: Sequence[float], *, elbow: Array | float = 1, wrist: Array | float = 1
) -> Float[Array, "*batch 3"]:
    """Angles in [-pi, pi] rad at which the tip of an arm of three links is at `target`, or as near as can be.

    The last two links are taken as one that is bent at the wrist: the farther the target, the less. Its length goes
    from that of the first link, where the target is the base, to that of both, where it is at full reach, so all points
    within reach have a posture. `elbow` and `wrist` are 1 or -1. With 1 a joint bends to the side of the target, left
    or right of x, so that the angle of the shoulder never jumps by a full turn.
    """
    first, second, third = links
    side = jnp.where(target[..., 1] < 0, -1.0, 1.0)
    distance = jnp.minimum(jnp.linalg.norm(target, axis=-1), first + second + third)
    outer = first + (second + third - first) * distance / (first + second + third)
    bend = side * wrist * _opposite(second, third, outer)
    lean = jnp.arctan2(third * jnp.sin(bend), second + third * jnp.cos(bend))
    turn = side * elbow * _opposite(first, outer, distance)
    shoulder = jnp.arctan2(target[..., 1], target[..., 0]) - jnp.arctan2(
        outer * jnp.sin(turn), first + outer * jnp.cos(turn)
    )
    return wrapped(jnp.stack([shoulder, turn - lean, bend], axis=-1))


def wrapped(angles: Array) -> Array:
    """The same directions within [-pi, pi] rad."""
    return angles - 2 * jnp.pi * jnp.round(angles / (2 * jnp.pi))


def _opposite(first: float, second: Array | float, distance: Array) -> Array:
    """The angle in [0, pi] by which two links turn at their joint, where their ends are so far apart (cosine rule)."""
    cosine = (distance**2 - first**2 - second**2) / (2 * first * second)
    return jnp.arccos(jnp.clip(cosine, -1.0, 1.0))


def spatial(
    angles: Float[Array, "6 *batch"], links: Sequence[float], hand: Sequence[float]
) -> list[tuple[Array, Array, Array]]:
    """(x, y, z) of the elbow, the wrist and the tip of an arm of six joints, from its shoulder, in the unit of `links`.

    The joints are yaw, lean, bend, roll, nod and twist, in rad: yaw, roll and twist turn about the link before them,
    the others about the axis across. At 0 both links point up; `hand` is the tip from the wrist then. An angle of lean
    above 0 leans towards x.
    """
    yaw, lean, bend, roll, nod, twist = angles
    lower, upper = links
    nothing = jnp.zeros_like(yaw)

    def about_z(angle: Array, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        return jnp.cos(angle) * x - jnp.sin(angle) * y, jnp.sin(angle) * x + jnp.cos(angle) * y, z

    def about_y(angle: Array, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        return jnp.cos(angle) * x + jnp.sin(angle) * z, y, jnp.cos(angle) * z - jnp.sin(angle) * x

    def from_elbow(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        return about_z(yaw, *about_y(lean, x, y, z + lower))

    def from_wrist(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        return from_elbow(*about_y(bend, x, y, z + upper))

    place = about_z(roll, *about_y(nod, *about_z(twist, *(nothing + one for one in hand))))
    return [from_elbow(nothing, nothing, nothing), from_wrist(nothing, nothing, nothing), from_wrist(*place)]
