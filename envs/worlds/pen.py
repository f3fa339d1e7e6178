"""An arm, a pen, two joysticks and a game character, in the cube [-1, 1]^3 (m).

The tip of the arm takes what it touches with an empty hand. The pen stays in the hand, and draws where the tip presses
it on the paper, z <= 0. A joystick is let go outside of its cube. At the end of a primitive joystick 1 gives the game
character its x, and joystick 2 its y. Touching another object with a full hand breaks both, and only the tip counts.

A primitive lasts 1 s, 30 control steps. Its 14 numbers are, for each joint, three weights and the goal of a DMP over
pi rad, then the height half way through and at the end, in m.

Setup after Duminy, Nguyen and Duhaut (arXiv 1810.04877, doi 10.3389/fnbot.2018.00087); the sizes are ours.
"""

from __future__ import annotations

import itertools
from enum import IntEnum
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from envs.worlds import arms, dmp, draw
from envs.worlds.world import Outcomes, Subgoal, Task, World, outcomes

LINKS = (0.40, 0.35, 0.25)  # m; joints turn about vertical axes
PRIMITIVE, LONGEST, STEPS = 14, 4, 30
JOINTS, NUMBERS = 3, dmp.WEIGHTS + 1  # numbers of a joint
REST_HEIGHT = 0.5  # m; the joints rest at 0
FLOOR = -0.2  # m: the tip goes no lower
TOO_HARD = -0.3  # m: a command below breaks the pen
PAPER = 0.0  # m
TOUCH = 0.1  # m between the way of the tip in a control step and the middle of an object
OBJECTS = ((-0.35, 0.55, 0.25), (0.55, -0.45, 0.45), (-0.45, -0.55, 0.45))  # pen, joystick 1, joystick 2
CUBE = 0.2  # m from the middle of a joystick to the sides of the cube in which it moves
PLAY = 0.01  # of that: how far outside a joystick is still held
_PLACE, _CUBE = ((-1.0, -1.0, FLOOR), (1.0, 1.0, 1.0)), ((-1.0,) * 3, (1.0,) * 3)
BOUNDS = (_PLACE, _PLACE, ((-1.0,) * 4, (1.0,) * 4), _CUBE, _CUBE, ((-1.0,) * 2, (1.0,) * 2))
GOALS, SEED = 300, 43  # of the evaluation of a task
PRESS = -0.1  # m: the height at which the teacher draws
LIFTS = (0.25, 0.95, FLOOR)  # m: heights on the way to the goal that the teacher tries with the pen
NEAR = 0.005  # how near to the goal is near enough for him


class Hand(IntEnum):
    """All that can be in the hand; who has broken something has nothing else."""

    NOTHING, PEN, JOYSTICK_1, JOYSTICK_2, BROKEN = range(5)


class Tasks(IntEnum):
    """The outcome spaces, in their order."""

    TIP, PEN, LINE, JOYSTICK_1, JOYSTICK_2, CHARACTER = range(6)


class Path(NamedTuple):
    """The arm and the objects after each control step."""

    joints: Float[Array, "steps 3"]
    """Angles in rad."""
    tip: Float[Array, "steps 3"]
    hand: Int[Array, "steps"]
    """One of `Hand`."""
    contact: Bool[Array, "steps"]
    """True while the pen draws."""
    sticks: Float[Array, "steps 2 3"]
    """The positions that the joysticks count as being in, [-1, 1]^3."""


def simulate(sequence: Float[Array, "L p"], length: Int[Array, ""]) -> tuple[Outcomes, Path]:
    """Execute the first `length` primitives, from rest."""
    joints, height = _move(sequence, length)
    tip = jnp.clip(jnp.stack([*arms.points(joints, LINKS)[-1], jnp.maximum(height, FLOOR)]), -1.0, 1.0)
    sticks = jnp.stack([(tip - jnp.array(place)[:, None]) / CUBE for place in OBJECTS[1:]])
    hand = _hold(_touched(tip), (jnp.abs(sticks) <= 1 + PLAY).all(axis=1))
    whole = jnp.cumsum((hand == Hand.PEN) & (height < TOO_HARD)) == 0
    contact = (hand == Hand.PEN) & whole & (tip[2] <= PAPER)
    line, drawn = _last_line(contact, tip[:2])
    after, moved = _follow(hand, jnp.clip(sticks, -1.0, 1.0))
    alive = hand[-1] != Hand.BROKEN
    found = outcomes(
        (tip[:, -1], True),
        (tip[:, -1], hand[-1] == Hand.PEN),
        (line, drawn & alive),
        (after[-1, 0], moved[0] & alive),
        (after[-1, 1], moved[1] & alive),
        (jnp.stack([after[-1, 0, 0], after[-1, 1, 1]]), moved.any() & alive),
    )
    return found, Path(joints.T, tip.T, hand, contact, after[(np.arange(len(hand)) + 1) // STEPS])


def _move(sequence: Array, length: Array) -> tuple[Float[Array, "3 steps"], Float[Array, "steps"]]:
    """Joints in rad and commanded height in m after each control step; after the last primitive they stay."""
    basis = jnp.asarray(dmp.curves(STEPS), jnp.float32)
    share = np.linspace(0, 2, STEPS + 1)[1:]
    up, on = (dmp.minimum_jerk(np.clip(share - half, 0, 1)).astype(np.float32) for half in (0, 1))

    def execute(at: Array, numbers: tuple[Array, Array]) -> tuple[Array, Array]:
        primitive, active = numbers
        command = jnp.pi * primitive[: JOINTS * NUMBERS].reshape(JOINTS, NUMBERS)
        via, end = primitive[-2], primitive[-1]
        angles = dmp.rollout(basis, at[:JOINTS], command[:, -1], command[:, :-1])
        height = at[JOINTS] + (via - at[JOINTS]) * up + (end - via) * on
        path = jnp.where(active, jnp.concatenate([angles, height[None]]), at[:, None])
        return path[:, -1], path

    rest = jnp.array([0.0] * JOINTS + [REST_HEIGHT])
    _, paths = jax.lax.scan(execute, rest, (sequence, jnp.arange(LONGEST) < length))
    path = jnp.moveaxis(paths, 0, 1).reshape(JOINTS + 1, LONGEST * STEPS)
    return path[:JOINTS], path[JOINTS]


def _touched(tip: Float[Array, "3 steps"]) -> Bool[Array, "3 steps"]:
    """True where the way of the tip in a control step comes near the first place of an object."""
    rest = jnp.array([[sum(LINKS)], [0.0], [REST_HEIGHT]])
    start = jnp.concatenate([rest, tip[:, :-1]], axis=1)
    way = tip - start
    length = jnp.maximum(_dot(way, way), 1e-12)

    def near(place: tuple[float, ...]) -> Array:
        apart = jnp.array(place)[:, None] - start
        nearest = apart - jnp.clip(_dot(way, apart) / length, 0.0, 1.0) * way
        return _dot(nearest, nearest) < TOUCH**2

    return jnp.stack([near(place) for place in OBJECTS])


def _dot(one: Float[Array, "3 steps"], other: Float[Array, "3 steps"]) -> Float[Array, "steps"]:
    """Scalar products, written out: several times faster on a CPU than a sum over an axis."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _hold(touched: Bool[Array, "3 steps"], inside: Bool[Array, "2 steps"]) -> Int[Array, "steps"]:
    """The content of the hand after each control step, one of `Hand`."""
    objects = jnp.array([Hand.PEN, Hand.JOYSTICK_1, Hand.JOYSTICK_2])

    def step(hand: Array, seen: tuple[Array, Array]) -> tuple[Array, Array]:
        touched, inside = seen
        taken = jnp.where(touched, objects, Hand.BROKEN).min() % Hand.BROKEN
        other = (touched & (objects != hand)).any()
        now = jnp.where(hand == Hand.NOTHING, taken, jnp.where(other, Hand.BROKEN, hand))
        lost = ((now == Hand.JOYSTICK_1) & ~inside[0]) | ((now == Hand.JOYSTICK_2) & ~inside[1])
        now = jnp.where(lost, Hand.NOTHING, now)
        return now, now

    return jax.lax.scan(step, jnp.int32(Hand.NOTHING), (touched.T, inside.T))[1]


def _follow(hand: Int[Array, "steps"], sticks: Float[Array, "2 3 steps"]) -> tuple[Array, Bool[Array, "2"]]:
    """Positions of both joysticks before the first primitive and after each, [L + 1, 2, 3]; and if they ever moved.

    A joystick counts as being where it was when last a primitive ended with it in the hand, and at 0 before.
    """
    held = hand[STEPS - 1 :: STEPS, None] == jnp.array([Hand.JOYSTICK_1, Hand.JOYSTICK_2])
    after = [jnp.zeros((2, 3))]
    for now, there in zip(held, jnp.moveaxis(sticks[..., STEPS - 1 :: STEPS], -1, 0), strict=True):
        after.append(jnp.where(now[:, None], there, after[-1]))
    return jnp.stack(after), held.any(axis=0)


def _last_line(contact: Bool[Array, "steps"], ground: Float[Array, "2 steps"]) -> tuple[Float[Array, "4"], Array]:
    """First and latest point of the last contact in one piece, and if there was any."""
    begins = contact & ~jnp.concatenate([jnp.zeros(1, bool), contact[:-1]])
    number = jnp.arange(len(contact))
    first, last = jnp.where(begins, number, 0).max(), jnp.where(contact, number, 0).max()
    return jnp.concatenate([ground[:, first], ground[:, last]]), contact.any()


def _show_pen(goal: Float[Array, "4"]) -> Float[Array, "2 14"]:
    """The teacher of the pen: of the ways in which the arm may bring it there, the first that is near enough.

    Some ways lead past a joystick, and touching that breaks both.
    """
    tried = jnp.array(list(itertools.product((1.0, -1.0), (1.0, -1.0), LIFTS)))
    ways = jax.vmap(lambda way: _way(Tasks.PEN, goal, *way))(tried)
    whole = jnp.pad(ways, ((0, 0), (0, LONGEST - ways.shape[1]), (0, 0)))
    found, _ = jax.vmap(simulate, in_axes=(0, None))(whole, jnp.int32(ways.shape[1]))
    error = jnp.where(found.reached[:, Tasks.PEN], jnp.abs(found.value[:, Tasks.PEN] - goal).max(axis=1), jnp.inf)
    return ways[jnp.argmin(jnp.where(error < NEAR, 0.0, error))]


def _way(
    task: int, goal: Float[Array, "4"], elbow: Any = 1.0, wrist: Any = 1.0, lift: Any = LIFTS[0]
) -> Float[Array, "n 14"]:
    """The primitives that reach a goal; `lift` is the height on the way with the pen, the sides are those of `arms`."""
    pen = jnp.array(OBJECTS[0])
    if task == Tasks.TIP:
        stops = [goal[:3]]
    elif task == Tasks.PEN:
        stops = [pen, goal[:3]]
    elif task == Tasks.LINE:
        stops = [pen, *_ends(goal)]
    elif task == Tasks.CHARACTER:
        stops = [place for number, one in enumerate(_axes(goal)) for place in _push(number, one)]
    else:
        stops = [*_push(task - Tasks.JOYSTICK_1, goal[:3])]
    vias = [stop[2] for stop in stops]
    if task in (Tasks.PEN, Tasks.LINE):
        vias[1] = jnp.asarray(lift)
    return jnp.stack([_reach(stop, via, elbow, wrist) for stop, via in zip(stops, vias, strict=True)])


def _parts(task: int, goal: Float[Array, "4"]) -> tuple[Subgoal, Subgoal]:
    """The teacher of procedures: two goals that make up one of any task but the tip."""
    if task == Tasks.PEN:
        return (Tasks.TIP, OBJECTS[0]), (Tasks.TIP, goal[:3])
    if task == Tasks.LINE:
        first, last = _ends(goal)
        return (Tasks.PEN, first), (Tasks.TIP, last)
    if task == Tasks.CHARACTER:
        first, last = _axes(goal)
        return (Tasks.JOYSTICK_1, first), (Tasks.JOYSTICK_2, last)
    first, last = _push(task - Tasks.JOYSTICK_1, goal[:3])
    return (Tasks.TIP, first), (Tasks.TIP, last)


def _reach(place: Array, via: Array, elbow: Any, wrist: Any) -> Float[Array, "14"]:
    """A primitive that ends with the tip at `place` [3] and passes the height `via` half way through: w = 0."""
    angles = arms.posture(place[:2], LINKS, elbow=elbow, wrist=wrist)
    command = jnp.zeros((JOINTS, NUMBERS)).at[:, -1].set(angles / jnp.pi)
    return jnp.concatenate([command.ravel(), jnp.stack([via, place[2]])])


def _push(stick: int, position: Array) -> tuple[Array, Array]:
    """Two places of the tip, one after the other, that bring joystick 0 or 1 to `position` [3]."""
    middle = jnp.array(OBJECTS[1 + stick])
    return middle, middle + CUBE * position


def _ends(line: Array) -> tuple[Array, Array]:
    """Two places of the tip, in which the pen presses on the paper, at the ends of a line [4]."""
    press = jnp.array([PRESS])
    return jnp.concatenate([line[:2], press]), jnp.concatenate([line[2:], press])


def _axes(character: Array) -> tuple[Array, Array]:
    """Positions of the joysticks that bring the character to (x, y)."""
    return character[:3] * jnp.array([1.0, 0.0, 0.0]), character[:3] * jnp.array([0.0, 1.0, 0.0])


def _goals(task: int) -> Float[np.ndarray, "n d"]:
    """Uniform over what can be reached: the disc of the arm, and the cubes of the joysticks.

    The pen is never above or below a joystick: the arm might touch that on its way.
    """
    rng = np.random.default_rng([SEED, task])
    if task not in (Tasks.TIP, Tasks.PEN, Tasks.LINE):
        return rng.uniform(-1, 1, (GOALS, len(BOUNDS[task][0])))
    ground = _on_disc(rng)
    if task == Tasks.LINE:
        return np.concatenate([ground[:GOALS], _on_disc(rng)[:GOALS]], axis=1)
    if task == Tasks.PEN:
        apart = np.linalg.norm(ground[:, None] - np.array(OBJECTS)[1:, :2], axis=-1)
        ground = ground[(apart > TOUCH).all(axis=1)]
    return np.column_stack([ground, rng.uniform(FLOOR, 1, len(ground))])[:GOALS]


def _on_disc(rng: np.random.Generator) -> Float[np.ndarray, "n 2"]:
    """More than enough points, uniform over what the arm reaches."""
    points = rng.uniform(-1, 1, (2 * GOALS, 2)) * sum(LINKS)
    return points[np.linalg.norm(points, axis=1) <= sum(LINKS)]


def sketch(figure: Any, path: Path, step: int, task: int | None, goal: Any) -> None:
    """The arm from above, the height of its tip, and the game, after a control step."""
    above, height, game = figure.subplots(1, 3, width_ratios=[1.2, 0.8, 0.8])
    until, second = slice(0, step % len(path.tip) + 1), np.arange(1, len(path.tip) + 1) / STEPS
    broken = ", broken" if path.hand[step] == Hand.BROKEN else ""
    draw.panel(above, f"from above, {second[step]:.1f} s{broken}", x=(-1.05, 1.05), y=(-1.05, 1.05))
    _sketch_objects(above, path, step)
    above.plot(*path.tip[until, :2].T, color=draw.TRAIL, lw=0.8, alpha=0.6)
    drawn = np.where(path.contact[until, None], path.tip[until, :2], np.nan)
    above.plot(*drawn.T, color=draw.INK, lw=2.5)
    draw.arm(above, arms.points(path.joints[step], LINKS))
    draw.panel(height, "height (m) over time (s)", x=(0, second[-1]), y=(-0.3, 1.05), equal=False)
    height.axhline(PAPER, color=draw.EDGE, lw=1)
    height.plot(second[until], path.tip[until, 2], color=draw.TRAIL, lw=1.2)
    draw.panel(game, "game", x=(-1.1, 1.1), y=(-1.1, 1.1))
    game.plot(path.sticks[until, 0, 0], path.sticks[until, 1, 1], ":", color=draw.TRAIL, lw=1)
    game.plot(path.sticks[step, 0, 0], path.sticks[step, 1, 1], "s", color=draw.TIP, mec=draw.INK, ms=9)
    if task is None or goal is None:
        return
    if task == Tasks.CHARACTER:
        draw.star(game, *goal[:2])
    elif task == Tasks.LINE:
        above.plot(goal[[0, 2]], goal[[1, 3]], "--", color=draw.GOAL, lw=2, marker="o", ms=4)
    else:
        place = goal[:3] if task in (Tasks.TIP, Tasks.PEN) else _push(task - Tasks.JOYSTICK_1, goal[:3])[1]
        draw.star(above, *place[:2])
        height.axhline(place[2], color=draw.GOAL, lw=1, ls="--")


def _sketch_objects(axes: Any, path: Path, step: int) -> None:
    hand = path.hand[step]
    for number, (x, y, _) in enumerate(OBJECTS[1:]):
        axes.plot(
            CUBE * np.array([-1, 1, 1, -1, -1]) + x, CUBE * np.array([-1, -1, 1, 1, -1]) + y, color=draw.EDGE, lw=1
        )
        at = path.tip[step, :2] if hand == Hand.JOYSTICK_1 + number else (x, y)
        axes.plot(*at, "o", color="white", mec=draw.INK, mew=2, ms=10, zorder=5)
        axes.annotate(str(number + 1), (x - CUBE, y + CUBE), size=7, color=draw.INK, va="bottom")
    if hand != Hand.BROKEN:
        at = path.tip[step, :2] if hand == Hand.PEN else OBJECTS[0][:2]
        axes.plot(*at, "d", color=draw.INK, ms=8, zorder=7)


@cache  # programs are compiled once for a world, and again for one that is merely alike
def make() -> World:
    """The world `pen`: six tasks, sequences of up to four primitives of 14 numbers."""
    tasks = tuple(
        Task(
            task.name.lower(),
            *bounds,
            goals=partial(_goals, task),
            demonstrate=_show_pen if task == Tasks.PEN else partial(_way, task),
            decompose=None if task == Tasks.TIP else partial(_parts, task),
        )
        for task, bounds in zip(Tasks, BOUNDS, strict=True)
    )
    return World("pen", PRIMITIVE, LONGEST, tasks, simulate, sketch)
