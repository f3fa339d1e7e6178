"""An arm of six joints with a fishing rod, whose float is to come down at a place on the water.

A primitive moves every joint along a Bezier curve of degree four, from rest; its 25 numbers are the four control points
of each joint, and the duration. The rod swings a line with a float (`envs.worlds.rope`). The outcome is where the float
first meets the water; a float that does not within 2 s has none.

Setup after Nguyen and Oudeyer (arXiv 1804.07269), whose human teacher's casts were alike, but for their size; the sizes
are ours.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import arms, draw, rope
from envs.worlds.world import Outcomes, Task, World, outcomes

SHOULDER = 0.45  # m above the water
LINKS, ROD = (0.3, 0.3), (0.15, 0.0, 0.8)  # m; the rod as the hand holds it
REST = (0.0, -0.3, 0.8, 0.0, 0.2, 0.0)  # rad
RANGE = (0.96, 0.72, 0.72, 0.96, 0.72, 0.96)  # rad to both sides of rest, of the control points of each joint
JOINTS, CONTROLS = 6, 4
DURATION, DURATION_RANGE = 1.05, 0.45  # s: middle, and half of the range
STEPS = 800  # of `rope.DT`: 2 s
FIELD = 2.2  # m that are 1 in the outcome
SMOOTH = (0.25, 0.5, 0.75, 1.0)  # control points of a teacher's cast, of its last one
CASTS, SEED = 1024, 43  # that the teacher has tried
CELLS = 22  # along each side of the outcome space, of .2 m
REACHED = (0,) * 9 + (
    0x48170, 0xFF3F8, 0x7FFF8, 0xFFFFC, 0xFFFFC, 0xFFFFC, 0x7FFF8, 0x7FFF8, 0x7FFF0, 0x1FFE0, 0xFF80, 0x800, 0,
)  # fmt: skip
"""Cells that five of 400,000 random movements reach: along x a number, along y its bits from the highest."""


class Path(NamedTuple):
    """Arm, rod and line every `rope.DT` seconds; once the float is in the water all stay where they are."""

    arm: Float[Array, "steps 4 3"]
    """Shoulder, elbow, wrist and the tip of the rod in m."""
    line: Float[Array, "steps 2 3"]
    """The middle of the line, and the float, in m."""
    wet: Bool[Array, "steps"]
    """True once the float is in the water."""


def simulate(sequence: Float[Array, "1 25"], length: Int[Array, ""]) -> tuple[Outcomes, Path]:
    """Execute the primitive, from rest."""
    arm = arms.spatial(_angles(sequence[0]), LINKS, ROD)
    tip = jnp.stack(arm[-1]) + jnp.array([[0.0], [0.0], [SHOULDER]])
    line = rope.swing(tip)
    place, last, wet = _landing(line[1])
    shown = jnp.minimum(jnp.arange(1, STEPS + 1), last)
    base = jnp.zeros((3, STEPS + 1)).at[2].set(SHOULDER)
    points = jnp.stack([base, *(base + jnp.stack(point) for point in arm)])
    over_time = [one[..., shown].transpose(2, 0, 1) for one in (points, line)]
    path = Path(over_time[0], over_time[1], wet & (shown == last))
    return outcomes((place / FIELD, wet & (jnp.abs(place) <= FIELD).all())), path


def _angles(numbers: Float[Array, "25"]) -> Float[Array, "6 steps"]:
    """The joints at rest, and after each control step; in rad."""
    share = jnp.minimum(rope.DT * np.arange(STEPS + 1) / (DURATION + DURATION_RANGE * numbers[-1]), 1.0)
    left = 1 - share
    bumps = jnp.stack([4 * share * left**3, 6 * share**2 * left**2, 4 * share**3 * left, share**4])
    control = numbers[:-1].reshape(JOINTS, CONTROLS) * jnp.array(RANGE)[:, None]
    return jnp.array(REST)[:, None] + jnp.matmul(control, bumps, precision="highest")


def _landing(float_: Float[Array, "3 steps"]) -> tuple[Float[Array, "2"], Int[Array, ""], Bool[Array, ""]]:
    """The place where the float first meets the water, the number of that moment, and True if it does at all."""
    under = float_[2] <= 0
    wet = under.any()
    after = jnp.maximum(jnp.argmax(under), 1)
    (x, y, z), (x_, y_, z_) = float_[:, after - 1], float_[:, after]
    share = jnp.clip(z / jnp.where(z > z_, z - z_, 1.0), 0.0, 1.0)
    return jnp.stack([x + share * (x_ - x), y + share * (y_ - y)]), jnp.where(wet, after, STEPS), wet


@cache
def _casts() -> tuple[Float[np.ndarray, "n 1 25"], Float[np.ndarray, "n 2"]]:
    """Casts of one smooth shape that reach the water, and where: what the teacher has found by random search."""
    numbers = np.random.default_rng(SEED).uniform(-1, 1, (CASTS, JOINTS + 1)).astype(np.float32)
    control = numbers[:, :JOINTS, None] * np.array(SMOOTH, np.float32)
    casts = np.concatenate([control.reshape(CASTS, -1), numbers[:, JOINTS:]], axis=1)[:, None]
    with jax.ensure_compile_time_eval():
        found, _ = jax.jit(jax.vmap(simulate, in_axes=(0, None)))(jnp.asarray(casts), jnp.int32(1))
        reached, places = np.asarray(found.reached[:, 0]), np.asarray(found.value[:, 0, :2])
    return casts[reached], places[reached]


def _show(goal: Float[Array, "4"]) -> Float[Array, "1 25"]:
    """The teacher's cast that came down nearest to the goal."""
    casts, places = (jnp.asarray(one) for one in _casts())
    return casts[jnp.argmin(jnp.square(places - goal[:2]).sum(axis=1))]


def _goals() -> Float[np.ndarray, "n 2"]:
    """The centres of the cells that random movements reach."""
    reached = np.array([[int(mark) for mark in f"{row:0{CELLS}b}"] for row in REACHED], bool)
    return (np.argwhere(reached) + 0.5) / CELLS * 2 - 1


def sketch(figure: Any, path: Path, step: int, task: int | None, goal: Any) -> None:
    """Arm, rod and line from the side and from above, after a control step."""
    panels = figure.subplots(1, 2, width_ratios=[1, 1.1])
    step = step % STEPS
    wet = ", in the water" if path.wet[step] else ""
    titles = f"from the side, {rope.DT * (step + 1):.2f} s{wet}", "from above"
    views = zip(panels, titles, ((0, 2), (0, 1)), ((-0.3, 2.4), (-2.3, 2.3)), strict=True)
    for axes, title, (i, j), span in views:
        draw.panel(axes, title, x=(-2.3, 2.3), y=span)
        if j == 2:
            axes.axhspan(span[0], 0, color=draw.WATER, lw=0)
        arm, line = path.arm[step], path.line[step]
        axes.plot(*path.line[: step + 1, 1][:, (i, j)].T, color=draw.TRAIL, lw=0.8, alpha=0.6)
        axes.plot(*np.stack([arm[3], *line])[:, (i, j)].T, color=draw.INK, lw=0.8, zorder=5)
        axes.plot(*arm[2:][:, (i, j)].T, color=draw.INK, lw=1.6, zorder=4)
        draw.arm(axes, [(point[i], point[j]) for point in arm[:3]])
        axes.plot(*line[1, (i, j)], "o", color=draw.TRAIL, mec="white", ms=8, zorder=8)
        if goal is not None and task is not None:
            place = np.array([*goal[:2] * FIELD, 0.0])
            draw.star(axes, place[i], place[j])


@cache  # programs are compiled once for a world, and again for one that is merely alike
def make(*, scale: float = 1.0) -> World:
    """The world `fishing`: one task, sequences of one primitive of 25 numbers.

    `scale` makes the bounds of goals larger, not what can be reached.
    """
    task = Task("float", (-scale, -scale), (scale, scale), goals=_goals, demonstrate=_show)
    return World("fishing", JOINTS * CONTROLS + 1, 1, (task,), simulate, sketch)
