"""An arm that throws a ball, or puts it on a table.

The arm moves in a vertical plane, of coordinates r and z (m), that turns about its base. A primitive moves it from rest
through a posture to another, half of the time each, with minimum jerk, and lets the ball go on the way. Its 9 numbers
are the yaw of the plane, both postures of three joints, the duration, and the share of it at which the ball is let go.

A fast ball counts as thrown, where it lands; a slow one at the height of the table as placed. World and sizes are ours,
after the setup of SGIM-ACTS (Nguyen and Oudeyer 2012, arXiv 1804.06819).
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import arms, dmp, draw
from envs.worlds.world import Outcomes, Task, World, outcomes

LINKS = (0.45, 0.40, 0.25)  # m; angles from the horizontal
SHOULDER = 0.5  # m above the floor
REST = (-1.2, 0.6, 0.4)  # rad
LIMITS = (1.6, 2.2, 1.6)  # rad, of each joint to both sides
YAW = 0.75 * np.pi  # rad, to both sides
DURATION, DURATION_RANGE = 0.9, 0.6  # s: middle, and half of the range
GRAVITY = 9.81  # m/s^2
THROWN_SPEED, THROWN_HEIGHT = 0.6, 0.05  # m/s, m: what is faster and higher is thrown
TABLE, NEAR_TABLE, INNER = 0.3, 0.06, 0.2  # m: height, how near is on it, and the radius of its hole
FIELD, TABLE_RADIUS = 3.0, 1.1  # m that are 1 in the outcomes of throwing and placing
STEPS, DT = 80, 0.05  # of a path, in s
THROWN, PLACED = range(2)
CELLS = 20  # along each side of an outcome space, whose centres are the goals

# Throws whose range goes from 0 to 4.3 m with their speed: postures and share, in [-1, 1]. Found by random search.
FORWARD = (-0.83, -0.86, -0.88, -0.44, 0.31, -0.27, -0.17)
BACKWARD = (0.11, 0.0, 0.81, 0.2, 0.36, 0.79, 0.51)


class Path(NamedTuple):
    """The arm and the ball every `DT` seconds, from the first control step to some time after the ball has landed."""

    joints: Float[Array, "steps 3"]
    """Angles in rad."""
    yaw: Float[Array, "steps"]
    """Of the plane of the arm, in rad."""
    ball: Float[Array, "steps 3"]
    """x, y and z in m."""
    free: Bool[Array, "steps"]
    """True once the ball has been let go."""


class Movement(NamedTuple):
    """A primitive in rad and s; `share` of the duration is when the ball is let go."""

    yaw: Float[Array, ""]
    via: Float[Array, "3"]
    end: Float[Array, "3"]
    duration: Float[Array, ""]
    share: Float[Array, ""]


@cache  # programs are compiled once for a world, and again for one that is merely alike
def make() -> World:
    """The world `throw`: two tasks, sequences of one primitive of 9 numbers."""
    bounds = (-1.0, -1.0), (1.0, 1.0)
    return World(
        name="throw",
        primitive=9,
        longest=1,
        tasks=(
            Task("thrown", *bounds, goals=_cells, demonstrate=_show_throw),
            Task("placed", *bounds, goals=_cells_on_table, demonstrate=_show_place),
        ),
        simulate=simulate,
        sketch=sketch,
    )


def simulate(sequence: Float[Array, "1 9"], length: Int[Array, ""]) -> tuple[Outcomes, Path]:
    """Execute the primitive, from rest."""
    move = _movement(sequence[0])
    place, way = jax.jvp(lambda share: _tip(_swing(move, share)), (move.share,), (jnp.ones(()),))
    velocity = way / move.duration
    speed = jnp.sqrt((velocity**2).sum())
    landed = _landing(place, velocity) * _heading(move.yaw) / FIELD
    thrown = (speed > THROWN_SPEED) & (place[1] > THROWN_HEIGHT) & (jnp.abs(landed) <= 1).all()
    placed = (speed <= THROWN_SPEED) & (jnp.abs(place[1] - TABLE) < NEAR_TABLE) & (jnp.abs(place[0]) > INNER)
    found = outcomes((landed, thrown), (place[0] * _heading(move.yaw) / TABLE_RADIUS, placed))
    return found, _path(move, place, jnp.where(placed, 0.0, velocity), placed)


def _movement(numbers: Float[Array, "9"]) -> Movement:
    limits = jnp.array(LIMITS)
    return Movement(
        yaw=YAW * numbers[0],
        via=limits * numbers[1:4],
        end=limits * numbers[4:7],
        duration=DURATION + DURATION_RANGE * numbers[7],
        share=0.5 + 0.5 * numbers[8],
    )


def _swing(move: Movement, share: Array) -> Float[Array, "3"]:
    """The angles after a `share` of the duration."""
    rest, late = jnp.array(REST), share >= 0.5
    start, end = jnp.where(late, move.via, rest), jnp.where(late, move.end, move.via)
    return start + (end - start) * dmp.minimum_jerk(jnp.where(late, 2 * share - 1, 2 * share))


def _tip(angles: Float[Array, "3"]) -> Float[Array, "2"]:
    """R and z."""
    r, z = arms.points(angles, LINKS)[-1]
    return jnp.stack([r, SHOULDER + z])


def _heading(yaw: Array) -> Float[Array, "2"]:
    return jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])


def _landing(place: Float[Array, "2"], velocity: Float[Array, "2"]) -> Float[Array, ""]:
    """R where a ball comes down to the floor."""
    rise = velocity[1]
    time = (rise + jnp.sqrt(rise**2 + 2 * GRAVITY * jnp.maximum(place[1], 0.0))) / GRAVITY
    return place[0] + velocity[0] * time


def _path(move: Movement, place: Array, velocity: Array, placed: Array) -> Path:
    time = DT * jnp.arange(1, STEPS + 1)
    joints = jax.vmap(lambda share: _swing(move, share))(jnp.minimum(time / move.duration, 1.0))
    late = (time - move.share * move.duration)[:, None]
    fall = jnp.array([0.0, GRAVITY / 2])
    flown = place + velocity * late - jnp.where(placed, 0.0, fall) * late**2
    landed = jnp.stack([_landing(place, velocity), jnp.zeros(())])
    flown = jnp.where(flown[:, 1:] < 0, landed, flown)
    ball = jnp.where(late > 0, flown, jax.vmap(_tip)(joints))
    ground = ball[:, :1] * _heading(move.yaw)
    yaw = jnp.full(STEPS, move.yaw)
    return Path(joints, yaw, jnp.concatenate([ground, ball[:, 1:]], axis=1), late[:, 0] > 0)


def _aim(goal: Array) -> tuple[Array, Array]:
    """(yaw, sign of r) with which the plane of the arm goes through `goal`: behind it, the arm leans back."""
    angle = jnp.arctan2(goal[1], goal[0])
    behind = jnp.abs(angle) > YAW
    return jnp.where(behind, arms.wrapped(angle + jnp.pi), angle) / YAW, jnp.where(behind, -1.0, 1.0)


def _show_throw(goal: Float[Array, "4"]) -> Float[Array, "1 9"]:
    """One of two throws, at the speed with which the ball lands at the goal."""
    yaw, sign = _aim(goal)
    numbers = jnp.where(sign > 0, jnp.array(FORWARD), jnp.array(BACKWARD))
    move = _movement(jnp.concatenate([yaw[None], numbers[:6], jnp.zeros(1), numbers[6:]]))
    place, way = jax.jvp(lambda share: _tip(_swing(move, share)), (move.share,), (jnp.ones(()),))
    far = sign * FIELD * jnp.sqrt((goal[:2] ** 2).sum()) - place[0]
    flight = jnp.sqrt(2 / GRAVITY * (place[1] + way[1] * far / way[0]))  # s
    duration = flight * way[0] / far
    pace = (duration - DURATION) / DURATION_RANGE
    return jnp.concatenate([yaw[None], numbers[:6], pace[None], numbers[6:]])[None]


def _show_place(goal: Float[Array, "4"]) -> Float[Array, "1 9"]:
    """The ball is let go at the end of the movement, where the arm stands still."""
    yaw, _ = _aim(goal)
    end = _on_table(goal) / jnp.array(LIMITS)
    via = (end + jnp.array(REST) / jnp.array(LIMITS)) / 2
    return jnp.concatenate([yaw[None], via, end, jnp.array([0.0, 1.0])])[None]


def _on_table(goal: Array) -> Float[Array, "3"]:
    """The angles at which the arm is at `goal` on the table, or as near as can be."""
    return arms.posture(_place_of(goal) - jnp.array([0.0, SHOULDER]), LINKS)


def _place_of(goal: Array) -> Float[Array, "2"]:
    """R and z of a goal on the table."""
    radius = TABLE_RADIUS * jnp.sqrt((goal[:2] ** 2).sum())
    return jnp.stack([_aim(goal)[1] * radius, jnp.array(TABLE)])


def _cells() -> Float[np.ndarray, "n 2"]:
    """The centres of all cells."""
    centres = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    return np.stack(np.meshgrid(centres, centres, indexing="ij"), axis=-1).reshape(-1, 2)


def _cells_on_table() -> Float[np.ndarray, "n 2"]:
    """Those of the cells at which the arm can stand still."""

    def able(cell: Array) -> Array:
        angles, place = _on_table(cell), _place_of(cell)
        near = jnp.abs(_tip(angles) - place).max() < 1e-3
        return near & (jnp.abs(angles) <= jnp.array(LIMITS)).all() & (jnp.abs(place[0]) > INNER)

    cells = _cells()
    return cells[np.asarray(jax.jit(jax.vmap(able))(jnp.asarray(cells, jnp.float32)))]


def sketch(figure: Any, path: Path, step: int, task: int | None, goal: Any) -> None:
    """The plane of the arm from the side, and the field from above, after a control step."""
    side, above = figure.subplots(1, 2, width_ratios=[1.3, 1])
    time, until = DT * (step % STEPS + 1), slice(0, step % STEPS + 1)
    heading = np.array([np.cos(path.yaw[0]), np.sin(path.yaw[0])])
    r = path.ball[until, :2] @ heading
    far = max(1.3, float(np.abs(path.ball[:, :2] @ heading).max()) + 0.2)
    draw.panel(
        side, f"from the side, {time:.2f} s", x=(-far, far), y=(-0.3, max(1.8, float(path.ball[:, 2].max()) + 0.1))
    )
    for sign in (-1, 1):
        side.plot([sign * INNER, sign * TABLE_RADIUS], [TABLE, TABLE], color=draw.EDGE, lw=3)
    side.axhline(0, color=draw.EDGE, lw=1)
    side.plot(r, path.ball[until, 2], color=draw.TRAIL, lw=1)
    draw.arm(side, [(x, SHOULDER + z) for x, z in arms.points(path.joints[step], LINKS)])
    draw.panel(above, "from above", x=(-far, far), y=(-far, far))
    for radius in (INNER, TABLE_RADIUS):
        angle = np.linspace(0, 2 * np.pi, 100)
        above.plot(radius * np.cos(angle), radius * np.sin(angle), color=draw.EDGE, lw=1)
    above.plot(*path.ball[until, :2].T, color=draw.TRAIL, lw=1)
    draw.arm(above, [(x * heading[0], x * heading[1]) for x, _ in arms.points(path.joints[step], LINKS)])
    for axes, ball in ((side, (r[-1], path.ball[step, 2])), (above, path.ball[step, :2])):
        axes.plot(*ball, "o", color=draw.TRAIL, mec="white", ms=8, zorder=8)
    if task is not None and goal is not None:
        scale = (FIELD, TABLE_RADIUS)[task]
        draw.star(above, scale * goal[0], scale * goal[1])
        draw.star(side, scale * goal[:2] @ heading, (0.0, TABLE)[task])
