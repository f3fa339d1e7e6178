"""An arm of six joints at a table with two objects, which make sounds, and a strip that does when it is touched.

A primitive lasts 1 s. Its 18 numbers are, for each joint, two weights and the goal of a DMP. One that ends a little
below the table has touched it. With an empty hand a touch takes the object that is there; with a full one it puts it
down. Once both objects were put down, each putting down gives a burst: its pitch is the distance of the two, its
loudness the angle of the line through them. A touch of the strip with an empty hand gives a rhythm by its place.

Six tasks of four levels: touch; move either object, give a rhythm; give a burst; a burst and then a rhythm.

Setup after Duminy, Nguyen and Duhaut (arXiv 2102.09854), whose robot was a real one; the sizes are ours.
"""

from __future__ import annotations

from enum import IntEnum
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import arms, dmp, draw
from envs.worlds.world import Outcomes, Subgoal, Task, World, outcomes

PRIMITIVE, LONGEST, STEPS = 18, 5, 30
JOINTS, WEIGHTS = 6, 2
SHOULDER = 0.15  # m above the table
LINKS, HAND = (0.35, 0.35), 0.15  # m
REST = (0.0, 0.5, 1.2, 0.0, 0.7, 0.0)  # rad
RANGE = (0.9, 0.7, 0.9, 0.8, 0.8, 0.8)  # rad to both sides of rest, of each joint's goals
LOWEST = -0.3  # m: a primitive that ends between here and the table has touched it
LOWER, UPPER = (0.2, -0.45), (0.8, 0.45)  # m: the table, x away from the base
STRIP = (-0.45, -0.35)  # m: the y between which it is
OBJECTS = ((0.45, 0.2), (0.45, -0.2))  # m: blue and green, at first
RADIUS = 0.07  # m from its middle that a touch takes an object
PITCH = 1.1  # m between objects at most
GOALS, SEED = 300, 43  # of the evaluation of a task
TRIED = 20 * GOALS  # places of which goals are made
TOUCHED_STRIP = -0.36  # m: the y at which the teacher touches it
PRESS = -0.02  # m: how deep the teacher touches
FAR = 10.0  # of strain, where a place cannot be reached at all
TILTS = tuple(np.linspace(1.2, 3.6, 25).tolist())  # rad: of the hand, from upright, that he tries
ORDER = 1e-3  # of strain that an earlier pair of places may need more: that mirrored ones are no tie
MIDDLES = ((0.45, 0.1), (0.55, 0.1), (0.35, 0.1), (0.45, 0.0), (0.55, 0.0))  # m: between the objects of a burst


class Hand(IntEnum):
    """The things that can be in the hand."""

    NOTHING, BLUE, GREEN = range(3)


class Tasks(IntEnum):
    """The outcome spaces, in their order."""

    TOUCH, BLUE, GREEN, BURST, RHYTHM, TUNE = range(6)


_TABLE, _BURST, _RHYTHM = (LOWER, UPPER), ((0.0, 0.0), (PITCH, 1.0)), (LOWER[:1], UPPER[:1])
BOUNDS = (_TABLE, _TABLE, _TABLE, _BURST, _RHYTHM, (_BURST[0] + _RHYTHM[0], _BURST[1] + _RHYTHM[1]))


class Body(NamedTuple):
    """An arm: its links over those of the usual one, and its joints' ranges."""

    links: float = 1.0
    limits: float = 1.0

    def points(self, angles: Float[Array, "6 *batch"]) -> list[tuple[Array, Array, Array]]:
        """Elbow, wrist and tip in m; the base is at the origin, on the table."""
        links, hand = [self.links * link for link in LINKS], (0.0, 0.0, self.links * HAND)
        return [(x, y, z + SHOULDER) for x, y, z in arms.spatial(angles, links, hand)]


class Seen(NamedTuple):
    """The table, and what has been reached; pairs of (value, whether there is one)."""

    places: Float[Array, "2 2"]
    """Of blue and green."""
    hand: Int[Array, ""]
    put: Bool[Array, "2"]
    """True for each that was ever put down."""
    burst: tuple[Float[Array, "2"], Bool[Array, ""]]
    touch: tuple[Float[Array, "2"], Bool[Array, ""]]
    rhythm: tuple[Float[Array, "1"], Bool[Array, ""]]
    tune: tuple[Float[Array, "3"], Bool[Array, ""]]


class Path(NamedTuple):
    """The arm and the table after each control step."""

    arm: Float[Array, "steps 3 3"]
    """Elbow, wrist and tip in m."""
    objects: Float[Array, "steps 2 2"]
    """The places where blue and green lie, or were taken."""
    hand: Int[Array, "steps"]
    """One of `Hand`."""
    sounds: Bool[Array, "steps 2"]
    """True for a burst, and for a rhythm."""


def simulate(body: Body, sequence: Float[Array, "L p"], length: Int[Array, ""]) -> tuple[Outcomes, Path]:
    """Execute the first `length` primitives, from rest."""
    starts, goals, weights = _commands(body, sequence)
    tips = jnp.stack(body.points(starts[1:].T)[-1], axis=-1)
    nothing = jnp.zeros((), bool)
    seen = Seen(
        places=jnp.array(OBJECTS),
        hand=jnp.int32(Hand.NOTHING),
        put=jnp.zeros(2, bool),
        **{name: (jnp.zeros(n), nothing) for name, n in (("burst", 2), ("touch", 2), ("rhythm", 1), ("tune", 3))},
    )
    every = [seen]
    for number in range(LONGEST):
        every.append(_touched(every[-1], tips[number], number < length))
    last = every[-1]
    found = outcomes(
        last.touch,
        (last.places[0], last.put[0]),
        (last.places[1], last.put[1]),
        last.burst,
        last.rhythm,
        last.tune,
    )
    return found, _path(body, starts, goals, weights, every, length)


def _commands(body: Body, sequence: Array) -> tuple[Float[Array, "6 6"], Float[Array, "L 6"], Float[Array, "L 6 2"]]:
    """In rad: the joints at rest and at the end of each primitive, and the goals and weights of these."""
    limits = body.limits * jnp.array(RANGE)
    command = limits[:, None] * sequence.reshape(LONGEST, JOINTS, WEIGHTS + 1)
    weights, goals = command[..., :WEIGHTS], jnp.array(REST) + command[..., WEIGHTS]
    end = dmp.curves(STEPS, WEIGHTS)[-1].tolist()
    joints = [jnp.array(REST)]
    for goal, pushes in zip(goals, weights, strict=True):
        pushed = sum(end[2 + i] * pushes[:, i] for i in range(WEIGHTS))
        joints.append(end[0] * joints[-1] + end[1] * goal + pushed)
    return jnp.stack(joints), goals, weights


def _touched(seen: Seen, tip: Float[Array, "3"], active: Bool[Array, ""]) -> Seen:
    """The effect of a primitive that ends at `tip`."""
    place, lower, upper = tip[:2], jnp.array(LOWER), jnp.array(UPPER)
    touch = active & (tip[2] > LOWEST) & (tip[2] <= 0) & (place >= lower).all() & (place <= upper).all()
    empty = seen.hand == Hand.NOTHING
    there = jnp.square(seen.places - place).sum(axis=1) < RADIUS**2
    takes = touch & empty & there.any()
    down = touch & ~empty & (seen.hand == jnp.array([Hand.BLUE, Hand.GREEN]))
    places, put = jnp.where(down[:, None], place, seen.places), seen.put | down
    taken = jnp.where(there[0], Hand.BLUE, Hand.GREEN)
    sounds = down.any() & put.all()
    burst = _where(sounds, _burst(places), seen.burst)
    plays = touch & empty & ~there.any() & (place[1] >= STRIP[0]) & (place[1] <= STRIP[1])
    return Seen(
        places=places,
        hand=jnp.where(takes, taken, jnp.where(down.any(), Hand.NOTHING, seen.hand)),
        put=put,
        burst=burst,
        touch=_where(touch, place, seen.touch),
        rhythm=_where(plays, place[:1], seen.rhythm),
        tune=_where(plays & burst[1], jnp.concatenate([burst[0], place[:1]]), seen.tune),
    )


def _where(now: Array, value: Array, before: tuple[Array, Array]) -> tuple[Array, Array]:
    return jnp.where(now, value, before[0]), before[1] | now


def _burst(places: Float[Array, "2 2"]) -> Float[Array, "2"]:
    """Distance of the objects in m, and the angle of the line through them: 0 where it is along x, 1 where along y."""
    x, y = jnp.abs(places[0] - places[1])
    return jnp.stack([jnp.sqrt(x**2 + y**2), jnp.arctan2(y, x) / (jnp.pi / 2)])


def _path(body: Body, starts: Array, goals: Array, weights: Array, every: list[Seen], length: Array) -> Path:
    """The state after each control step; after the last primitive all stays."""
    basis = jnp.asarray(dmp.curves(STEPS, WEIGHTS), jnp.float32)
    moved = jax.vmap(partial(dmp.rollout, basis))(starts[:-1], goals, weights)  # [L, 6, steps]
    still = (jnp.arange(LONGEST) >= length)[:, None, None]
    angles = jnp.where(still, starts[length][:, None], moved).transpose(1, 0, 2).reshape(JOINTS, -1)
    number = (np.arange(LONGEST * STEPS) + 1) // STEPS

    def over_time(name: str) -> Array:
        return jnp.stack([getattr(seen, name) for seen in every])[number]

    arm = jnp.stack([jnp.stack(point, axis=-1) for point in body.points(angles)], axis=1)
    sounds = jnp.stack([jnp.stack([seen.burst[1], seen.rhythm[1]]) for seen in every])[number]
    return Path(arm, over_time("places"), over_time("hand"), sounds)


def _show(body: Body, task: int, goal: Float[Array, "4"]) -> Float[Array, "n 18"]:
    """The touches that reach a goal, one after the other."""
    objects = jnp.array(OBJECTS)
    if task == Tasks.TOUCH:
        places = [goal[:2]]
    elif task in (Tasks.BLUE, Tasks.GREEN):
        places = [objects[task - Tasks.BLUE], goal[:2]]
    elif task == Tasks.RHYTHM:
        places = [_on_strip(goal[0])]
    else:
        blue, green = _apart(body, goal)[0]
        places = [objects[0], blue, objects[1], green]
    if task == Tasks.TUNE:
        places.append(_on_strip(goal[2]))
    return jax.vmap(partial(_touch, body))(jnp.stack(places))[0]


def _parts(body: Body, task: int, goal: Float[Array, "4"]) -> tuple[Subgoal, Subgoal]:
    """The teacher of procedures."""
    if task == Tasks.TUNE:
        return (Tasks.BURST, goal[:2]), (Tasks.RHYTHM, goal[2:3])
    if task == Tasks.BURST:
        blue, green = _apart(body, goal)[0]
        return (Tasks.BLUE, blue), (Tasks.GREEN, green)
    return (Tasks.TOUCH, OBJECTS[task - Tasks.BLUE]), (Tasks.TOUCH, goal[:2])


def _on_strip(x: Array) -> Float[Array, "2"]:
    return jnp.stack([x, jnp.asarray(TOUCHED_STRIP)])


def _apart(body: Body, goal: Float[Array, "*n"]) -> tuple[Float[Array, "2 2"], Float[Array, ""]]:
    """Places of blue and green with a distance and an angle, and their strain: of a few pairs that with the least."""
    angle = goal[1] * jnp.pi / 2
    away = goal[0] / 2 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    offsets = jnp.stack([away, away * jnp.array([-1.0, 1.0])])
    pairs = jnp.array(MIDDLES)[:, None, None] + offsets[:, None] * jnp.array([[1.0], [-1.0]])
    pairs = pairs.reshape(-1, 2, 2)
    strain = jax.vmap(jax.vmap(lambda place: _touch(body, place)[1]))(pairs).max(axis=1)
    best = jnp.argmin(strain + ORDER * jnp.arange(len(pairs)))
    return pairs[best], strain[best]


def _touch(body: Body, place: Float[Array, "2"]) -> tuple[Float[Array, "18"], Float[Array, ""]]:
    """The primitive, with weights 0, that touches a place, and its strain: the share of a joint's range that it needs.

    Roll and twist stay at 0, so the arm is in a plane: for each tilt of the hand the cosine rule gives the others. Off
    the table the strain is above `FAR`.
    """
    lower, upper = (body.links * link for link in LINKS)
    reach, tilt = jnp.sqrt(jnp.square(place).sum()), jnp.array(TILTS)
    x = reach - body.links * HAND * jnp.sin(tilt)
    z = PRESS - SHOULDER - body.links * HAND * jnp.cos(tilt)
    cosine = (x**2 + z**2 - lower**2 - upper**2) / (2 * lower * upper)
    bend = jnp.arccos(jnp.clip(cosine, -1.0, 1.0))
    lean = jnp.arctan2(x, z) - jnp.arctan2(upper * jnp.sin(bend), lower + upper * jnp.cos(bend))
    zero = jnp.zeros_like(tilt)
    yaw = zero + jnp.arctan2(place[1], place[0])
    angles = jnp.stack([yaw, lean, bend, zero, tilt - lean - bend, zero])
    numbers = (angles - jnp.array(REST)[:, None]) / (body.limits * jnp.array(RANGE)[:, None])
    off = (place < jnp.array(LOWER)).any() | (place > jnp.array(UPPER)).any()
    strain = jnp.abs(numbers).max(axis=0) + FAR * ((jnp.abs(cosine) > 1) | off)
    best = jnp.argmin(strain)
    command = jnp.zeros((JOINTS, WEIGHTS + 1)).at[:, WEIGHTS].set(numbers[:, best])
    return command.ravel(), strain[best]


def _goals(body: Body, task: int) -> Float[np.ndarray, "n d"]:
    """Goals drawn evenly: on the table, of two places on it, or on the strip; those that the teacher reaches.

    He does not where an object that was put down lies in the way of what comes next.
    """
    rng = np.random.default_rng([SEED, task])
    places = rng.uniform(LOWER, UPPER, (2, TRIED, 2)).astype(np.float32)
    x = places[1, :, :1]
    strip = np.column_stack([x, np.full_like(x, TOUCHED_STRIP)])
    if task in (Tasks.TOUCH, Tasks.BLUE, Tasks.GREEN):
        return places[0][_strain(body, places[0]) <= 1][:GOALS]
    if task == Tasks.RHYTHM:
        return x[_strain(body, strip) <= 1][:GOALS]
    away = np.abs(places[0] - places[1])
    bursts = np.column_stack([np.linalg.norm(away, axis=1), np.arctan2(away[:, 1], away[:, 0]) / (np.pi / 2)])
    put, strain = (np.asarray(one) for one in _all_apart(body, bursts))
    able = (strain <= 1) & _free(put[:, 0], np.array(OBJECTS[1]))
    if task == Tasks.BURST:
        return bursts[able][:GOALS]
    able &= (_strain(body, strip) <= 1) & _free(put[:, 0], strip) & _free(put[:, 1], strip)
    return np.column_stack([bursts, x])[able][:GOALS]


def _free(objects: Float[np.ndarray, "n 2"], place: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "n"]:
    """True if a touch at a place takes none of the objects."""
    return np.linalg.norm(objects - place, axis=1) > RADIUS


@partial(jax.jit, static_argnums=0)
def _strain(body: Body, places: Float[Array, "n 2"]) -> Float[Array, "n"]:
    return jax.vmap(lambda place: _touch(body, place)[1])(places)


@partial(jax.jit, static_argnums=0)
def _all_apart(body: Body, goals: Float[Array, "n 2"]) -> tuple[Float[Array, "n 2 2"], Float[Array, "n"]]:
    return jax.vmap(partial(_apart, body))(goals)


def sketch(figure: Any, path: Path, step: int, task: int | None, goal: Any) -> None:
    """The arm from the side, the table from above, and the sounds so far, after a control step."""
    side, above = figure.subplots(1, 2, width_ratios=[1, 1.1])
    step = step % len(path.arm)
    held = ("", ", holds blue", ", holds green")[path.hand[step]]
    sounds = "".join(f", {name}" for name, heard in zip(("burst", "rhythm"), path.sounds[step], strict=True) if heard)
    draw.panel(side, f"from the side, {(step + 1) / STEPS:.1f} s{held}", x=(-0.1, 0.95), y=(-0.3, 0.75))
    draw.panel(above, f"from above{sounds}", x=(-0.1, 0.95), y=(-0.5, 0.5))
    (x, y), (x_, y_) = LOWER, UPPER
    side.plot([x, x_], [0, 0], color=draw.EDGE, lw=3)
    above.fill_between([x, x_], y, y_, color="white", ec=draw.EDGE)
    above.fill_between([x, x_], *STRIP, color=draw.WATER, lw=0)
    above.plot(*path.arm[: step + 1, 2, :2].T, color=draw.TRAIL, lw=0.8, alpha=0.6)
    for number, colour in enumerate((draw.BLUE, draw.GREEN)):
        at = path.arm[step, 2, :2] if path.hand[step] == number + 1 else path.objects[step, number]
        above.plot(*at, "o", color=colour, mec=draw.INK, ms=11, zorder=5)
    arm = np.concatenate([[[0.0, 0.0, SHOULDER]], path.arm[step]])
    draw.arm(side, [(np.hypot(*point[:2]), point[2]) for point in arm])
    draw.arm(above, [(point[0], point[1]) for point in arm])
    if task is None or goal is None:
        return
    if task in (Tasks.TOUCH, Tasks.BLUE, Tasks.GREEN):
        draw.star(above, *goal[:2])
    if task in (Tasks.RHYTHM, Tasks.TUNE):
        draw.star(above, goal[0 if task == Tasks.RHYTHM else 2], TOUCHED_STRIP)
    if task in (Tasks.BURST, Tasks.TUNE):
        angle = goal[1] * np.pi / 2
        way = goal[0] / 2 * np.array([np.cos(angle), np.sin(angle)])
        ends = np.array(MIDDLES[0])[:, None] + way[:, None] * np.array([-1, 1])
        above.plot(*ends, "--", color=draw.GOAL, lw=2, marker="o", ms=4)


@cache  # programs are compiled once for a world, and again for one that is merely alike
def make(*, links: float = 1.0, limits: float = 1.0) -> World:
    """The world `table`: six tasks, sequences of up to five primitives of 18 numbers.

    `links` and `limits` make another body: its links and the ranges of its joints over those of the usual one.
    """
    body = Body(links, limits)
    tasks = tuple(
        Task(
            task.name.lower(),
            bounds[0],
            bounds[1],
            goals=partial(_goals, body, task),
            demonstrate=partial(_show, body, task),
            decompose=None if task in (Tasks.TOUCH, Tasks.RHYTHM) else partial(_parts, body, task),
        )
        for task, bounds in zip(Tasks, BOUNDS, strict=True)
    )
    return World("table", PRIMITIVE, LONGEST, tasks, partial(simulate, body), sketch)
