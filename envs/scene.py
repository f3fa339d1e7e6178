"""The MuJoCo model of a body in an arena.

    floor   a plane at z = 0, and boxes under the cells that have a floor if some have none
    walls   one box for each merged rectangle
    block   a body on slide joints: light, 1 % smaller than its cell, with stiff contacts and limits (BLOCK_SOLIMP)
            the ant meets its box, floor and walls meet spheres in its four lower corners
    gate    a mocap body, lifted out of the way by whoever steps the model

Geoms that stand still have contype 0 and conaffinity 1, so that they never meet each other. Walls and gates also meet
contype 2, for a torso that the floor lets through. All take the contact parameters of the body's default class, but
for margins: contacts with the plane begin `margin` above it, those with walls and gates `wall_margin` before them,
those with other boxes where they touch. Without a margin is where MJX begins them between capsule and box.

Boxes of 8 m that lie on each other are missed now and then by MJX-Warp, spheres on boxes are not. Since no wall is
narrower than a block, its corners meet all that it would meet. A block that falls begins a tenth of a millimetre
inside the floor it stands on, where all engines find a contact; any other begins clear of the floor.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from envs.arena import BLOCK, HEIGHT, Arena

FLOOR_COLOUR = (0.8, 0.8, 0.8, 1.0)
WALL_COLOUR = (0.4, 0.5, 0.6, 1.0)
BLOCK_COLOUR = (0.75, 0.35, 0.25, 1.0)
GATE_COLOUR = (0.35, 0.55, 0.4, 1.0)
PLANE_MARGIN = 0.01  # m
BLOCK_SHRINK = 0.99  # side of a block over the side of its cell
BLOCK_MASS = 0.001  # kg
BLOCK_CORNER = 0.1  # radius of its spheres, m
BLOCK_SUNK = 1e-4  # m
BLOCK_CLEAR = 2 * PLANE_MARGIN
# MuJoCo scales stiffness with mass: the ant's soft contacts give way by .3 m under a bridge of 1 g, and usual limits
# by .5 m when the ant pushes it to the end of its way.
BLOCK_SOLIMP = (0.99, 0.999, 0.001)
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
TORSO = 2  # contype of a torso that touches walls and no floor
STATIC: dict[str, Any] = {"contype": 0, "conaffinity": 1}
UPRIGHT: dict[str, Any] = {"contype": 0, "conaffinity": 1 | TORSO}  # walls and gates


def build_model(
    arena: Arena,
    body: mujoco.MjSpec,
    options: Mapping[str, Any],
    *,
    margin: float = PLANE_MARGIN,
    wall_margin: float = 0.0,
    visual: bool = False,
) -> Any:
    """The `MjModel` of `body` in `arena`. `options` are attributes of `MjSpec.option`.

    `margin` is the plane's, `wall_margin` that of walls and gates (m).
    The joints of `body` come first, then the slides of the blocks in the order of x, y, z. With `visual` the floor
    has a checkered texture and the walls of small cells are lower; places and joints are the same.
    """
    for name, value in options.items():
        setattr(body.option, name, value)
    x_lo, y_lo, x_hi, y_hi = arena.bounds
    middle, half = [(x_lo + x_hi) / 2, (y_lo + y_hi) / 2], [(x_hi - x_lo) / 2, (y_hi - y_lo) / 2]
    world = body.worldbody
    world.add_light(pos=[*middle, 40.0], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    floor = world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[*middle, 0.0],
        size=[*half, 0.1],
        rgba=FLOOR_COLOUR,
        margin=margin,
        **STATIC,
    )
    floors = [
        _box(world, f"floor_{i}", rectangle, 0.0, arena.floor_height, FLOOR_COLOUR)
        for i, rectangle in enumerate(arena.floors())
        if arena.floor_height
    ]
    top = arena.floor_height + (min(arena.wall_height, arena.cell / 2) if visual else arena.wall_height)
    for i, rectangle in enumerate(arena.walls()):
        _box(world, f"wall_{i}", rectangle, 0.0, top, WALL_COLOUR).margin = wall_margin
    for i, centre in enumerate(arena.centres(BLOCK)):
        _add_block(world, f"block_{i}", centre, arena)
    for i, rectangle in enumerate(arena.gates()):
        _add_gate(world, f"gate_{i}", rectangle, arena).margin = wall_margin
    if visual:
        _checker(body, [floor, *floors], cell=arena.cell)
    return body.compile()


def _box(parent: Any, name: str, rectangle: np.ndarray, low: float, high: float, colour: Any) -> Any:
    return parent.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[*(rectangle[:2] + rectangle[2:]) / 2, (low + high) / 2],
        size=[*(rectangle[2:] - rectangle[:2]) / 2, (high - low) / 2],
        rgba=colour,
        **UPRIGHT,
    )


def _add_block(world: Any, name: str, centre: np.ndarray, arena: Arena) -> None:
    half, height = arena.cell / 2, -BLOCK_SUNK if "z" in arena.block else BLOCK_CLEAR
    body = world.add_body(name=name, pos=[*centre, arena.floor_height + HEIGHT / 2 + height])
    side = BLOCK_SHRINK * half
    contacts: dict[str, Any] = {"rgba": BLOCK_COLOUR, "priority": 1, "solimp": [*BLOCK_SOLIMP, 0.5, 2.0]}
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[side, side, HEIGHT / 2],
        mass=BLOCK_MASS,
        **contacts,
        **STATIC,
    )
    for i, (x, y) in enumerate(itertools.product((-1, 1), repeat=2)):
        inset = side - BLOCK_CORNER
        body.add_geom(
            name=f"{name}_corner_{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[x * inset, y * inset, BLOCK_CORNER - HEIGHT / 2],
            size=[BLOCK_CORNER, 0, 0],
            mass=0.0,
            contype=1,
            conaffinity=0,
            **contacts,
        )
    for axis in sorted(arena.block):
        reach = [-arena.floor_height, 0.0] if axis == "z" else [-arena.cell, arena.cell]
        body.add_joint(
            name=f"{name}_{axis}",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=AXES[axis],
            armature=0.0,
            damping=0.0,
            limited=True,
            range=reach,
            margin=0.0,
            solimp_limit=[*BLOCK_SOLIMP, 0.5, 2.0],
        )


def _add_gate(world: Any, name: str, rectangle: np.ndarray, arena: Arena) -> Any:
    centre, half = (rectangle[:2] + rectangle[2:]) / 2, (rectangle[2:] - rectangle[:2]) / 2
    body = world.add_body(name=name, mocap=True, pos=[*centre, arena.floor_height + HEIGHT / 2])
    return body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[*half, HEIGHT / 2], rgba=GATE_COLOUR, **UPRIGHT
    )


def _checker(spec: mujoco.MjSpec, floors: list[Any], *, cell: float) -> None:
    """Tiles of a quarter of a cell on the floor."""
    spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.85, 0.85, 0.85],
        rgb2=[0.78, 0.78, 0.8],
        width=256,
        height=256,
    )
    material = spec.add_material(name="floor", texrepeat=[2 / cell, 2 / cell], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "checker"
    for floor in floors:
        floor.material = "floor"
