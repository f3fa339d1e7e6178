"""A closed room: a round robot moves in it, pushes discs, and meets some that do not move.

Not a world of sequences: it goes on by one action at a time.

    room = Room()
    state = reset(room, key=key)
    state = step(room, state, action)         # two numbers in [-1, 1], 20 of the room's units each
    values = observe(state)                   # [B, 2]: where each disc is, and its colour
    inputs = see(room, values)                # [O, 2]: the same, and each disc seen from another one

Motion is quasi-static: nothing goes on moving by itself. Source: the simulated room of CHIME (Manoury, Nguyen, Buche,
arXiv 2009.10968) with the sizes of its public code; how discs touch is ours.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

RADIUS = 20.0
STRIDE = 20.0
"""The robot goes so far for an action of 1."""
SUBSTEPS = 12
ROUNDS = 3
LOWER, UPPER = np.array([50.0, 50.0]), np.array([550.0, 500.0])
WALL = np.array([[250.0, 200.0], [270.0, 400.0]])
"""Two corners of the inner wall."""
NEAR = 2 * RADIUS
"""The distance of two discs that touch."""


class Room(NamedTuple):
    """The contents of a room besides the robot."""

    movable: int = 2
    fixed: int = 1
    wall: bool = True

    @property
    def discs(self) -> tuple[str, ...]:
        """Names of all discs [D], the robot first."""
        objects = [f"object_{i + 1}" for i in range(self.movable)]
        return ("robot", *objects, *(f"fixed_{i + 1}" for i in range(self.fixed)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observables [B]: the place of each disc, then the colour of each but the robot."""
        return (*self.discs, *(f"colour_{name}" for name in self.discs[1:]))

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of discs (i, j) [P]; what is derived is where j is, seen from i."""
        return tuple(itertools.combinations(range(len(self.discs)), 2))

    @property
    def contexts(self) -> tuple[str, ...]:
        """Names of all that can be an input [B + P]: the observables, and what is derived of them."""
        return (*self.names, *(f"{self.discs[j]}_from_{self.discs[i]}" for i, j in self.pairs))

    @property
    def units(self) -> Float[Array, "B"]:
        """Changes of an observable are small or large in this unit: a stride of the robot, or 1 for colours."""
        return jnp.array([STRIDE] * len(self.discs) + [1.0] * (len(self.discs) - 1))

    @property
    def lower(self) -> Float[Array, "B 2"]:
        """Bounds of observables."""
        return jnp.asarray(np.array([LOWER] * len(self.discs) + [[-1.0, -1.0]] * (len(self.discs) - 1)), jnp.float32)

    @property
    def upper(self) -> Float[Array, "B 2"]:
        """Bounds of observables."""
        return jnp.asarray(np.array([UPPER] * len(self.discs) + [[1.0, 1.0]] * (len(self.discs) - 1)), jnp.float32)


class RoomState(struct.PyTreeNode):
    """The places of all things."""

    places: Float[Array, "D 2"]
    colours: Float[Array, "D-1 2"]


def reset(room: Room, *, key: Array) -> RoomState:
    """Discs anywhere, none in another one, and colours drawn anew."""
    place_key, colour_key = jax.random.split(key)
    count = len(room.discs)
    places = jax.random.uniform(place_key, (count, 2), minval=jnp.asarray(LOWER), maxval=jnp.asarray(UPPER))
    share = jnp.full((count, count), 0.5)
    places = jax.lax.fori_loop(0, 30, lambda _, x: _clear(room, _apart(x, share)), places)
    return RoomState(places, jax.random.uniform(colour_key, (count - 1, 2), minval=-1.0))


def step(room: Room, state: RoomState, action: Float[Array, "2"]) -> RoomState:
    """The room after an action, each number of which is clipped to [-1, 1]."""
    turns = [True] * ROUNDS + [False]
    shares = jnp.array([_shares(room, heavy=heavy) for heavy in turns] * SUBSTEPS)
    moves = jnp.array(([1.0] + [0.0] * ROUNDS) * SUBSTEPS)[:, None] * jnp.clip(action, -1.0, 1.0) * STRIDE / SUBSTEPS

    def relax(places: Array, turn: tuple[Array, Array]) -> tuple[Array, None]:
        move, share = turn
        return _clear(room, _apart(places.at[0].add(move), share)), None

    return state.replace(places=jax.lax.scan(relax, state.places, (moves, shares))[0])


def observe(state: RoomState) -> Float[Array, "B 2"]:
    """The observables: places in units of the room, and colours in [-1, 1]."""
    return jnp.concatenate([state.places, state.colours])


def apart(room: Room, values: Float[Array, "*n B 2"]) -> Float[Array, "*n P 2"]:
    """From the first disc of each pair to the second one."""
    first, second = np.array(room.pairs).T
    return values[..., second, :] - values[..., first, :]


def see(room: Room, values: Float[Array, "*n B 2"]) -> Float[Array, "*n O 2"]:
    """All that can be an input, in about [-1, 1]: observables, and for each pair of discs a direction.

    It points from the first disc to the second one, and is as long as the other disc looks large: its solid angle, in
    units of that when they touch.
    """
    discs = len(room.discs)
    places = (values[..., :discs, :] - (LOWER + UPPER) / 2) / ((UPPER - LOWER) / 2)
    between = apart(room, values)
    distance = jnp.maximum(jnp.sqrt(jnp.square(between).sum(axis=-1, keepdims=True)), NEAR / 2)
    return jnp.concatenate([places, values[..., discs:, :], between * NEAR**2 / distance**3], axis=-2)


def _shares(room: Room, *, heavy: bool) -> np.ndarray:
    """[i, j]: how much of an overlap of i and j is undone by i.

    The robot pushes what can be moved; two of these share; what is fixed stays. Where not `heavy` the robot yields to
    all, as something that it pushed could not go on.
    """
    count = len(room.discs)
    weight = np.array([1.0] + [0.0] * room.movable + [2.0] * room.fixed)  # the lighter one yields
    share = (weight[:, None] < weight) + 0.5 * (weight[:, None] == weight) * (weight[:, None] < 2)
    if not heavy:
        share[0], share[:, 0] = 1.0, 0.0
    return share * (1 - np.eye(count))


def _apart(places: Float[Array, "D 2"], share: Float[Array, "D D"]) -> Float[Array, "D 2"]:
    """Discs after overlaps of all pairs were undone at once along the line between both."""
    between = places[:, None] - places[None]
    distance = jnp.sqrt(jnp.square(between).sum(axis=-1) + 1e-12)
    overlap = jnp.maximum(NEAR - distance, 0.0) * share / distance
    return places + (overlap[..., None] * between).sum(axis=1)


def _clear(room: Room, places: Float[Array, "D 2"]) -> Float[Array, "D 2"]:
    """Discs after those in a wall were put beside it."""
    places = jnp.clip(places, LOWER + RADIUS, UPPER - RADIUS)
    if not room.wall:
        return places
    low, high = WALL
    nearest = jnp.clip(places, low, high)
    away = places - nearest
    distance = jnp.sqrt(jnp.square(away).sum(axis=-1, keepdims=True) + 1e-12)
    outside = jnp.where(distance < RADIUS, nearest + away / distance * RADIUS, places)
    left = places[:, :1] < (low + high)[0] / 2  # the wall is narrow: who is in it leaves to the left or right
    aside = places.at[:, :1].set(jnp.where(left, low[0] - RADIUS, high[0] + RADIUS))
    inside = (
        (distance < 1e-3) & (places > low).all(axis=-1, keepdims=True) & (places < high).all(axis=-1, keepdims=True)
    )
    return jnp.where(inside, aside, outside)


class Errand(NamedTuple):
    """A disc shall be brought to a place."""

    kind: str
    """position, wall or push."""
    places: tuple[tuple[float, float], ...]
    """Of all discs, at first."""
    disc: int
    goal: tuple[float, float]


KINDS = ("position", "wall", "push")
_MIDDLE, _LEFT, _BEHIND, _PUSH = (400.0, 275.0), (180.0, 300.0), 370.0, 25.0


def errands(room: Room) -> tuple[Errand, ...]:
    """Eight places around the robot, four beyond the inner wall, and four pushes of the first object."""
    count = len(room.discs) - 1
    west, east = ([(x, float(y)) for y in np.linspace(90, 460, max(count, 2))][:count] for x in (90.0, 515.0))
    circle = [110 * np.array([np.cos(angle), np.sin(angle)]).round(3) for angle in np.arange(8) * np.pi / 4]
    around = [Errand("position", (_MIDDLE, *west), 0, (_MIDDLE[0] + x, _MIDDLE[1] + y)) for x, y in circle]
    behind = [Errand("wall", (_LEFT, *east), 0, (_BEHIND, y)) for y in (225.0, 275.0, 325.0, 375.0)]
    pushes = [
        Errand("push", ((_MIDDLE[0], 165.0), _MIDDLE, *west[1:]), 1, (_MIDDLE[0] + x, _MIDDLE[1] + y))
        for x, y in ((_PUSH, 0.0), (-_PUSH, 0.0), (0.0, _PUSH), (0.0, -_PUSH))
    ]
    return (*around, *(behind if room.wall else ()), *(pushes if room.movable else ()))
