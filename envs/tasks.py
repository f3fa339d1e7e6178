"""The registry: one row of data for each task. Nothing here needs JAX or MuJoCo.

A row is written in m at the row's own size of cells; `Task.resized` scales its x and y.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from envs import arena as arenas
from envs import layouts
from envs.arena import BLOCK, CHASM, FREE, GATE, GOAL, ROBOT, Arena
from envs.options import ANT, COMMON, ENGINES, JAXGCRL, MAP, EnvError, Option, choice
from envs.places import Places, Point, anywhere, around, box, centres, circle, pairs, point, scaled

CLEARANCE = {"ant": 1.0, "point": 0.6}  # m that a body keeps from the sides of a cell when it starts anywhere


@dataclass(frozen=True)
class Geometry:
    """Facts of a task for a hierarchical agent; indices are those of the state.

    `space` is (lower, upper) of the abstract dimensions, `region_cuts` the interior cuts of each of them, which
    give the first regions, `subgoal_scale` the half-range of a subgoal along each.
    """

    goal_indices: tuple[int, ...]
    abstract_indices: tuple[int, ...]
    space: tuple[Point, Point]
    region_cuts: tuple[Point, ...]
    subgoal_scale: Point

    def resized(self, ratio: float) -> Geometry:
        """The same geometry at `ratio` times the size in x and y."""
        lower, upper = self.space
        ratios = [ratio if i in (0, 1) else 1.0 for i in self.abstract_indices]
        return replace(
            self,
            space=(scaled(lower, ratio), scaled(upper, ratio)),
            region_cuts=tuple(tuple(r * cut for cut in cuts) for r, cuts in zip(ratios, self.region_cuts, strict=True)),
            subgoal_scale=scaled(self.subgoal_scale, ratio),
        )


@dataclass(frozen=True)
class Switch:
    """Place at which a gate opens: positions between `lower` and `upper` (x, y) in m, and the yaw, if any."""

    lower: Point
    upper: Point
    yaw: tuple[float, float]

    def holds(self, position: Any) -> Any:
        """True if `position` [2] is where the gate opens."""
        return ((np.asarray(self.lower) <= position) & (position <= np.asarray(self.upper))).all()

    def resized(self, ratio: float) -> Switch:
        """The same switch at `ratio` times the size."""
        return replace(self, lower=scaled(self.lower, ratio), upper=scaled(self.upper, ratio))


@dataclass(frozen=True)
class Motion:
    """The way a point moves, a square of side 2 `radius` m.

    An action of 1 commands `speed` m/s along an axis. An env step of `dt` s clips the point's own velocity to `limit`
    m/s along each axis, then takes on the share `response` of the commanded one.
    """

    radius: float = 0.5
    speed: float = 4.0
    response: float = 0.3
    dt: float = 0.1
    limit: float = float("inf")


@dataclass(frozen=True)
class Task:
    """A row of the registry.

    `goals` names the distributions of the desired goal, `starts` those of the body's position (x, y). `pairs` names
    those of goals that have a start of their own (x, y, x, y), which the start `task` then is. The first of pairs and
    goals is the default. `place_noise` is the half-range in m of what is added to the start's x and y, `pose_noise` the
    scale of what is added to the rest of a body's position (half-range) and to its velocity (standard deviation), in
    their units. `block_noise` is the standard deviation, in m, of a block's start along x. `defaults` are
    options whose default is not the usual one, `maps` tells whether a map of the user's own may take the row's place.
    `presets` are those of an ant, `motion` is that of a point.
    `clearance` is what the body keeps from the sides of a cell where it may start anywhere, in m.
    """

    body: str
    arena: Arena
    geometry: Geometry
    success_radius: float
    goals: Mapping[str, Places]
    starts: Mapping[str, Places]
    clearance: float
    pairs: Mapping[str, Places] = field(default_factory=dict)
    switch: Switch | None = None
    place_noise: float = 0.1
    pose_noise: float = 0.1
    motion: Motion = Motion()
    block_noise: float = 0.0
    defaults: Mapping[str, Any] = field(default_factory=dict)
    maps: bool = False
    presets: tuple[str, ...] = ("fast", "published")

    def resized(self, cell: float) -> Task:
        """The task with cells of `cell` m; heights stay."""
        ratio, arena = cell / self.arena.cell, arenas.resized(self.arena, cell)
        before, after = (anywhere(one, clearance=self.clearance) for one in (self.arena, arena))  # it does not scale

        def follow(places: Places) -> Places:
            return after if places == before else places.resized(ratio)

        return replace(
            self,
            arena=arena,
            geometry=self.geometry.resized(ratio),
            goals={name: follow(places) for name, places in self.goals.items()},
            starts={name: follow(places) for name, places in self.starts.items()},
            pairs={name: places.resized(ratio, dims=4) for name, places in self.pairs.items()},
            switch=self.switch and self.switch.resized(ratio),
            success_radius=ratio * self.success_radius,
            block_noise=ratio * self.block_noise,
        )

    @property
    def engines(self) -> tuple[str, ...]:
        """The engines to choose from."""
        return ENGINES if self.body == "ant" else ("auto", "jax")

    def options(self) -> dict[str, Option]:
        """The options of the task with their defaults."""
        options = {"goals": choice(*self.pairs, *self.goals), "start": choice(*self.starts), **COMMON}
        if self.maps:
            options["map"] = MAP
        if self.body == "ant":
            options |= {**ANT, "preset": choice(*self.presets)}
        return options | {key: replace(options[key], default=value) for key, value in self.defaults.items()}


def plane(arena: Arena) -> Geometry:
    """Goals and regions over x and y: the box around the free cells, cut in the middle of both."""
    free = arena.free()
    (x_lo, y_lo), (x_hi, y_hi) = free[:, :2].min(0).tolist(), free[:, 2:].max(0).tolist()
    reach = max(1.25 * arena.cell, min(2.5 * arena.cell, 5.0))
    return Geometry(
        goal_indices=(0, 1),
        abstract_indices=(0, 1),
        space=((x_lo, y_lo), (x_hi, y_hi)),
        region_cuts=(((x_lo + x_hi) / 2,), ((y_lo + y_hi) / 2,)),
        subgoal_scale=(reach, reach),
    )


def marked_goals(arena: Arena) -> Places:
    """The centres of the cells marked `g`, else that of the free cell that is the longest walk away."""
    return centres(arena, GOAL) if any(arena.cells(GOAL)) else point(*arenas.farthest(arena))


def maze(
    body: str,
    arena: Arena,
    *,
    goals: Mapping[str, Places] | None = None,
    start: Places | None = None,
    geometry: Geometry | None = None,
    success_radius: float | None = None,
    clearance: float | None = None,
    **columns: Any,
) -> Task:
    """A row over x and y. Unless told otherwise, start, goals and success are as on a map of the user's own.

    Starts are the cells marked `r`. Training goals lie anywhere in the free cells. Test goals are the cells marked
    `g`, else the free cell that is the longest walk away. Success is within 5/8 of a cell.
    """
    clearance = CLEARANCE[body] if clearance is None else clearance
    free = anywhere(arena, clearance=clearance)
    if goals is None:
        goals = {"train": free, "test": marked_goals(arena)}
    return Task(
        body=body,
        arena=arena,
        geometry=geometry or plane(arena),
        success_radius=0.625 * arena.cell if success_radius is None else success_radius,
        goals={**goals, "free": goals.get("free", free)},
        starts={"task": start or centres(arena, ROBOT), "free": free},
        clearance=clearance,
        **columns,
    )


def own(body: str, source: str, *, cell: float | None) -> Task:
    """The row of a map of the user's own, with cells of `cell` m or else of the map's size, or 8 m.

    Raises:
      EnvError: if the map is malformed, or holds what `body` can do nothing with.
    """
    arena = arenas.read_arena(source, cell=8.0)
    if body == "point":
        _refuse(
            arena, {BLOCK: "a block, which the point cannot push", CHASM: "a gap, which the point cannot fall into"}
        )
    if cell is not None:
        arena = arenas.resized(arena, cell)
    return on_map(body, arena, clearance=CLEARANCE[body])


def on_map(body: str, arena: Arena, *, clearance: float) -> Task:
    """The row of an arena of the user's own.

    On a map with a gap goals lie at the centres of cells and success is within 3/8 of a cell, out of the gap's reach.

    Raises:
      EnvError: if the arena holds what nobody can do anything with.
    """
    _refuse(arena, {GATE: "a gate, which no map says how to open"})
    if not arena.floor_height:
        return maze(body, arena, clearance=clearance, maps=True)
    goals = {"train": centres(arena, FREE + ROBOT + GOAL), "test": marked_goals(arena)}
    goals["free"] = goals["train"]
    return maze(body, arena, goals=goals, success_radius=0.375 * arena.cell, clearance=clearance, maps=True)


def _refuse(arena: Arena, strange: Mapping[str, str]) -> None:
    """Raise `EnvError` if `arena` has a cell that holds one of `strange`, symbols and what they stand for."""
    for r, c in arena.cells("".join(strange)):
        row = len(arena.rows) - r  # counted as in the text, from above
        raise EnvError(f"map: row {row}, column {c + 1} is {strange[arena.rows[r][c]]}")


# The published tasks (star.md of the paper's experiments): 8 m cells, success within 5 m.

MAZE_GOALS = {"train": box((-4.0, -4.0), (20.0, 20.0)), "test": point(0.0, 16.0)}
CAM_SWITCH = Switch(lower=(16.0, float("-inf")), upper=(20.0, 8.0), yaw=(-1.0, 0.0))

# Goals on the far side of the chasm, seen in x, y and z: the third abstract dimension tells the chasm's bottom.
FALL_GOALS = {
    "train": point(0.0, 27.0, 4.5),
    "test": point(0.0, 27.0, 4.5),
    "free": around(layouts.FALL, FREE + ROBOT, clearance=3.2, height=(4.5,)),  # nobody in the gap is within 5 m of them
}
FALL_GEOMETRY = Geometry(
    goal_indices=(0, 1, 2),
    abstract_indices=(0, 1, 2),
    space=((-4.0, -4.0, 0.0), (12.0, 28.0, 8.0)),
    region_cuts=((4.0,), (16.0,), ()),
    subgoal_scale=(10.0, 10.0, 0.5),
)


# In OGBench and Gymnasium-Robotics all geoms have a margin of .01 m, and MuJoCo adds those of two that meet.
BOTH_MARGINS = {"margin": 0.02, "wall_margin": 0.02}
GYMNASIUM_DT = 0.01  # s
POINT_MASS = 1000 * 4 / 3 * np.pi * 0.1**3  # kg, of a ball of .1 m as dense as water


def _jaxgcrl(body: str, arena: Arena, train: Places, test: Places, start: Places | None = None) -> Task:
    goals, presets = {"train": train, "test": test}, ("fast", "published", *JAXGCRL)
    return maze(
        body, arena, success_radius=0.5, goals=goals, start=start, defaults={"reward": "sparse"}, presets=presets
    )


def _jaxgcrl_maze(body: str, arena: Arena, test: Arena) -> Task:
    return _jaxgcrl(body, arena, centres(arena, GOAL), centres(test, GOAL))


AROUND, NEAR = circle(10.0, parts=180), box((-0.1, -0.1), (0.1, 0.1))  # of JaxGCRL's `ant`, which has no maze


def _ogbench(body: str, name: str) -> Task:
    """A maze of OGBench: starts and goals lie within a quarter of a cell of the middle, along x and along y."""
    arena, cells = layouts.OGBENCH[name]
    noise, radius = arena.cell / 4, {"ant": 0.5, "point": 1.0}[body]
    every = pairs(arena, cells, noise=noise)
    defaults: dict[str, Any] = {"episode_length": 1000, "reward": "sparse", "at_goal": "terminate"}
    if body == "ant":
        defaults |= {"observe": "untimed", **BOTH_MARGINS}
    return maze(
        body,
        arena,
        goals={},
        pairs=dict.fromkeys(("train", "test", "tasks"), every)
        | {f"task{n}": pairs(arena, [one], noise=noise) for n, one in enumerate(cells, start=1)},
        start=around(arena, ROBOT, clearance=arena.cell / 2 - noise),
        success_radius=radius,
        clearance={"ant": CLEARANCE["ant"], "point": 0.8}[body],
        place_noise=0.0,
        motion=Motion(radius=0.7, speed=2.0, response=1.0),
        defaults=defaults,
    )


def _gymnasium(body: str, name: str, *, cell: float, wall_height: float, episode_length: int) -> Task:
    """A maze of Gymnasium-Robotics: start and goal are in different cells, within a quarter of one of their middles.

    The point of 4.19 kg is pushed by up to 100 N against a drag of 1 N s/m, which MuJoCo's Euler steps take implicitly.
    """
    arena = Arena(layouts.GYMNASIUM[name], cell, wall_height=wall_height)
    noise, drag = cell / 4, GYMNASIUM_DT / (POINT_MASS + GYMNASIUM_DT)
    every = pairs(arena, itertools.permutations(arena.cells(FREE + ROBOT), 2), noise=noise)
    defaults: dict[str, Any] = {"episode_length": episode_length, "reward": "sparse"}
    if body == "ant":
        ant = {"observe": "untimed", "model": "gymnasium", "timestep": GYMNASIUM_DT, "action_scale": 5.0}
        defaults |= ant | BOTH_MARGINS
    return maze(
        body,
        arena,
        goals={},
        pairs={"train": every, "test": every},
        start=around(arena, FREE + ROBOT, clearance=cell / 2 - noise),
        success_radius=0.45,
        clearance={"ant": CLEARANCE["ant"], "point": 0.15}[body],
        place_noise=0.0,
        pose_noise=0.0,
        motion=Motion(radius=0.1, speed=100.0, response=drag, dt=GYMNASIUM_DT, limit=5.0),
        defaults=defaults,
    )


def _both(body: str) -> dict[str, Task]:
    """The tasks that make sense for any body."""
    sparse = {"train": point(2.0, 9.0), "test": point(2.0, 9.0)}
    return {
        f"{body}_maze": maze(body, layouts.MAZE, goals=MAZE_GOALS, maps=True),
        f"{body}_maze_cam": maze(body, layouts.CAM, goals=MAZE_GOALS, switch=CAM_SWITCH),
        f"{body}_maze_sparse": maze(
            body, layouts.SPARSE, success_radius=1.0, goals=sparse, defaults={"reward": "sparse"}
        ),
        f"{body}_2rooms": maze(body, layouts.ROOMS_2),
        f"{body}_3rooms": maze(body, layouts.ROOMS_3),
        f"{body}_4rooms": maze(body, layouts.ROOMS_4),
        f"{body}_u_maze": _jaxgcrl_maze(body, layouts.U_MAZE, layouts.U_MAZE_TEST),
        f"{body}_u4_maze": _jaxgcrl_maze(body, layouts.U4_MAZE, layouts.U4_MAZE_TEST),
        f"{body}_u5_maze": _jaxgcrl_maze(body, layouts.U5_MAZE, layouts.U5_MAZE_TEST),
        f"{body}_big_maze": _jaxgcrl_maze(body, layouts.BIG_MAZE, layouts.BIG_MAZE_TEST),
        f"{body}_hardest_maze": _jaxgcrl_maze(body, layouts.HARDEST_MAZE, layouts.HARDEST_MAZE),
        **{f"{body}maze-{name}": _ogbench(body, name) for name in layouts.OGBENCH},
    }


TASKS: Mapping[str, Task] = {
    **_both("point"),
    **_both("ant"),
    "ant_open": _jaxgcrl("ant", layouts.OPEN, AROUND, AROUND, start=NEAR),
    "ant_push": maze("ant", layouts.PUSH, goals={"train": point(0.0, 19.0), "test": point(0.0, 19.0)}),
    "ant_fall": maze("ant", layouts.FALL, geometry=FALL_GEOMETRY, goals=FALL_GOALS),
    "ant_maze_stochastic": maze(
        "ant",
        layouts.STOCHASTIC,
        goals={"train": box((-12.0, -4.0), (12.0, 20.0)), "test": point(0.0, 16.0)},
        block_noise=1.0,
    ),
    **{
        f"PointMaze_{name}": _gymnasium("point", name, cell=1.0, wall_height=0.4, episode_length=length)
        for name, length in (("UMaze", 300), ("Medium", 600), ("Large", 800))
    },
    **{
        f"AntMaze_{name}": _gymnasium("ant", name, cell=4.0, wall_height=2.0, episode_length=length)
        for name, length in (("UMaze", 700), ("Medium", 1000), ("Large", 1000))
    },
}


def names() -> tuple[str, ...]:
    """The names that `envs.make` knows."""
    return tuple(TASKS)
