"""Pictures of a task by MuJoCo, off screen.

    follow     steeply from above and behind, centred on the body
    overview   the whole arena, from above and behind
    top        the whole arena, from straight above

In all of them +x points right and +y up, as on the map of `envs.topdown`. Walls between the camera and the body are
drawn translucent. Of the outer walls only the part near the free cells is drawn.
"""

from __future__ import annotations

import atexit
import copy
import threading
from typing import Any, NamedTuple, Self

import mujoco
import numpy as np

from envs import opengl
from envs.arena import Arena
from envs.options import EnvError, known

CAMERAS = ("follow", "overview", "top")
ELEVATION = {"follow": -62.0, "overview": -58.0, "top": -90.0}  # degrees
FOLLOW_DISTANCE = (9.0, 1.9, 16.0)  # m, cells, m: least, usual, most
FIELD_OF_VIEW = 45.0  # degrees, vertical
ASPECTS = (0.6, 1.8)  # narrowest, widest picture of a whole arena
MARGIN = 1.03  # of the picture's width and height around the arena
RIM = 0.15  # of a cell: how much of the outer walls is drawn
SHADOWS, FINE_SHADOWS = 1024, 4096  # pixels along a side of the map that shadows come from
MAX_GEOMS = 2000
TRAIL_WIDTH = 3.0  # pixels
MARKER = 0.014  # radius of a marker over its distance from the camera

GOAL, SUBGOAL, TARGET, TRAIL = (0.0, 0.62, 0.45), (0.9, 0.55, 0.0), (0.0, 0.45, 0.7), (0.6, 0.15, 0.45)
PAPER = (1.0, 1.0, 1.0)
CHASM = 0.4  # brightness of its ground, to that of the floor


class Marks(NamedTuple):
    """Marks drawn besides the task itself; any that is None is left out.

    `goal` [k] is a desired goal, over the goal dimensions. `subgoal` [d] is a point and `target` ([d], [d]) a box, over
    the abstract dimensions. `trail` [n, 2] are the places (x, y) that the body has been to.
    """

    goal: np.ndarray | None = None
    subgoal: np.ndarray | None = None
    target: tuple[np.ndarray, np.ndarray] | None = None
    trail: np.ndarray | None = None


NOTHING = Marks()


class Stage:
    """A task's bodies, where `place` puts them. The walls, as they are drawn, reach up to `top`, in m."""

    def __init__(self, env: Any):
        self.env = env
        self.model = _dressed(env.model, env.arena)
        self.data = mujoco.MjData(self.model)
        walls = [i for i in range(self.model.ngeom) if self.model.geom(i).name.startswith("wall_")]
        self.top = float((self.model.geom_pos[walls, 2] + self.model.geom_size[walls, 2]).max())

    def place(self, qpos: np.ndarray, mocap_pos: np.ndarray) -> None:
        """Put all bodies where `env.pose` says they are."""
        self.data.qpos[:] = qpos
        self.data.mocap_pos[:] = mocap_pos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def body(self) -> np.ndarray:
        """The position [3] of what the agent moves, in m."""
        return self.data.xpos[1]

    def boxes(self, kind: str) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """(lower corner [2], upper corner [2], height of the middle) of what is of a kind, `block` or `gate`."""
        found = []
        for i in range(self.model.ngeom):
            is_box = self.model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX
            if is_box and self.model.geom(i).name.startswith(f"{kind}_"):
                centre, half = self.data.geom_xpos[i], self.model.geom_size[i]
                found.append((centre[:2] - half[:2], centre[:2] + half[:2], float(centre[2])))
        return found


class Painter:
    """Draws a stage at one size. Its owner closes it, or uses it in a `with`."""

    def __init__(self, stage: Stage, *, width: int, height: int, shadows: int = SHADOWS):
        """`shadows` says how sharp they are; 0 draws none, in half the time.

        Raises `EnvError` in one line if this machine has no OpenGL without a window.
        """
        stage.model.vis.quality.shadowsize = shadows
        self.stage = stage
        self._width, self._height = width, height
        self._context = opengl.new_context(width, height)
        self._scene = mujoco.MjvScene(stage.model, maxgeom=MAX_GEOMS)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = shadows > 0
        self._options = mujoco.MjvOption()
        with opengl.current(self._context):
            self._gl = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gl)
            mujoco.mjr_resizeOffscreen(width, height, self._gl)
        atexit.register(self.close)  # before the display that the context lives on is closed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give back what it holds; more than once is fine."""
        atexit.unregister(self.close)
        if self._context is not None:
            with opengl.current(self._context):
                self._gl.free()
            self._context.free()
            self._context = None

    def paint(self, marks: Marks = NOTHING, *, camera: str = "follow") -> np.ndarray:
        """The stage as it is now, from one of `CAMERAS`: uint8 [height, width, 3]."""
        if self._context is None:
            raise ValueError("this painter is closed")
        with opengl.current(self._context):
            return self._painted(marks, camera)

    def _painted(self, marks: Marks, camera: str) -> np.ndarray:
        stage, scene = self.stage, self._scene
        eye = _camera(stage, camera, self._width / self._height)
        mujoco.mjv_updateScene(
            stage.model, stage.data, self._options, None, eye, mujoco.mjtCatBit.mjCAT_ALL.value, scene
        )
        _clear_view(scene, stage.body)
        _add_marks(scene, stage.env, marks, size=MARKER * eye.distance)
        view = mujoco.MjrRect(0, 0, self._width, self._height)
        mujoco.mjr_render(view, scene, self._gl)
        pixels = np.empty((self._height, self._width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, view, self._gl)
        return pixels[::-1].copy()


_painters: dict[tuple[int, int, int], Painter] = {}
_FRAMES = threading.Lock()  # of the painters above, which all threads share


def frame(
    env: Any, data: Any, *, width: int, height: int, camera: str = "follow", marks: Marks = NOTHING
) -> np.ndarray:
    """One picture of the body's `data` (`state.pipeline_state.data` of one environment): uint8 [height, width, 3].

    Raises:
      EnvError: in one line, if the camera is unknown or this machine has no OpenGL without a window.
    """
    key, pose = (id(env), width, height), [np.asarray(part) for part in env.pose(data)]
    with _FRAMES:
        if key not in _painters:
            if len(_painters) >= 4:
                _painters.pop(next(iter(_painters))).close()
            _painters[key] = Painter(Stage(env), width=width, height=height)
        painter = _painters[key]
        painter.stage.place(*pose)
        return painter.paint(marks, camera=camera)


def frame_of(arena: Arena) -> np.ndarray:
    """The part of an arena worth a picture (x_lo, y_lo, x_hi, y_hi): the cells without a wall, and a rim."""
    free, rim = arena.free(), RIM * arena.cell
    return np.concatenate([free[:, :2].min(axis=0) - rim, free[:, 2:].max(axis=0) + rim])


def aspect_of(arena: Arena) -> float:
    """Width over height of a picture of the whole arena: its own within `ASPECTS`."""
    x_lo, y_lo, x_hi, y_hi = frame_of(arena)
    return float(np.clip((x_hi - x_lo) / (y_hi - y_lo), *ASPECTS))


def place_of(indices: tuple[int, ...], values: np.ndarray, default: np.ndarray) -> np.ndarray:
    """The point (x, y, z) of which `values` gives the coordinates in `indices`, and `default` [3] all others."""
    point = np.array(default, np.float64)
    for i, value in zip(indices, values, strict=True):
        if i < 3:
            point[i] = value
    return point


def _dressed(model: mujoco.MjModel, arena: Arena) -> mujoco.MjModel:
    """A copy of `model` with light from the side, and cropped walls."""
    model = copy.copy(model)
    model.vis.global_.fovy = FIELD_OF_VIEW
    model.vis.headlight.ambient[:] = 0.35
    model.vis.headlight.diffuse[:] = 0.25
    model.vis.headlight.specular[:] = 0.0
    model.light_diffuse[:] = 0.55
    model.light_ambient[:] = 0.0
    model.light_specular[:] = 0.05
    outline = frame_of(arena)
    model.stat.center[:] = *(outline[:2] + outline[2:]) / 2, 0.0
    model.stat.extent = np.linalg.norm(outline[2:] - outline[:2]) / 2
    model.vis.map.shadowclip = 1.5  # of the extent: else shadows are speckled in the corners
    sun = np.array([0.35, 0.45, -1.0])
    model.light_dir[:] = sun / np.linalg.norm(sun)
    model.light_pos[:] = model.stat.center - 1.5 * model.stat.extent * sun
    for i in range(model.ngeom):
        if model.geom(i).name.startswith("floor"):
            model.geom_rgba[i, :3] = CHASM if arena.floor_height and model.geom(i).name == "floor" else 1.0
        if model.geom(i).name == "floor" or model.geom(i).name.startswith("wall_"):
            centre, half = model.geom_pos[i], model.geom_size[i]
            low, high = np.maximum(centre[:2] - half[:2], outline[:2]), np.minimum(centre[:2] + half[:2], outline[2:])
            model.geom_pos[i, :2], model.geom_size[i, :2] = (low + high) / 2, np.maximum(high - low, 1e-3) / 2
    return model


def _camera(stage: Stage, name: str, aspect: float) -> mujoco.MjvCamera:
    if name not in CAMERAS:
        raise EnvError(f'camera "{name}" is unknown; {known(name, CAMERAS)}')
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 90.0, ELEVATION[name]
    if name == "follow":
        low, cells, high = FOLLOW_DISTANCE
        camera.lookat[:] = stage.body
        camera.distance = float(np.clip(cells * stage.env.arena.cell, low, high))
        return camera
    camera.lookat[:], camera.distance = _fit(frame_of(stage.env.arena), stage.top, ELEVATION[name], aspect)
    return camera


def _fit(outline: np.ndarray, top: float, elevation: float, aspect: float) -> tuple[np.ndarray, float]:
    """(point to look at [3], distance) from where a camera just sees all that is in `outline`, up to the height `top`.

    `elevation` is the camera's, in degrees, `aspect` the width of the picture over its height.
    """
    low, high = [*outline[:2], 0.0], [*outline[2:], top]
    middle = np.add(low, high) / 2
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - middle
    tilt = np.radians(-elevation)
    up, forward = np.array([0.0, np.sin(tilt), np.cos(tilt)]), np.array([0.0, np.cos(tilt), -np.sin(tilt)])
    height, depth = corners @ up, corners @ forward
    tall = np.tan(np.radians(FIELD_OF_VIEW) / 2) / MARGIN
    above, below = np.max(height - tall * depth), np.max(-height - tall * depth)
    distance = max((above + below) / (2 * tall), np.max(np.abs(corners[:, 0]) / (tall * aspect) - depth))
    return middle + (above - below) / 2 * up, float(distance)


def _clear_view(scene: mujoco.MjvScene, body: np.ndarray) -> None:
    """Make translucent what stands between the camera and the body, or half a metre beside it."""
    eye = np.mean([scene.camera[i].pos for i in range(2)], axis=0)
    for geom in scene.geoms[: scene.ngeom]:
        if geom.type == mujoco.mjtGeom.mjGEOM_BOX and any(_meets(geom, eye, body + [x, 0, 0.2]) for x in (-0.5, 0.5)):
            geom.rgba[3] = 0.25


def _meets(box: mujoco.MjvGeom, start: np.ndarray, end: np.ndarray) -> bool:
    """True if the segment from `start` to `end` goes into `box`, whose axes are those of the world, and out again."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = ((box.pos + sign * box.size - start) / (end - start) for sign in (-1, 1))
    enter, leave = np.fmax.reduce(np.fmin(near, far)), np.fmin.reduce(np.fmax(near, far))
    return bool(enter < leave and leave < 1.0 and enter > 0.0)


def _add_marks(scene: mujoco.MjvScene, env: Any, marks: Marks, *, size: float) -> None:
    """Add what `marks` names; a marker has a radius of `size` m."""
    x_lo, y_lo, x_hi, y_hi = frame_of(env.arena)
    floor = env.arena.floor_height
    # Under everything: paper, where there would be a black sky.
    far = 20 * max(x_hi - x_lo, y_hi - y_lo)
    _add(scene, "PLANE", [far, far, 1], [(x_lo + x_hi) / 2, (y_lo + y_hi) / 2, -0.05], (*PAPER, 1.0), emission=1.0)
    ground = np.array([0.0, 0.0, floor])
    if marks.target is not None:
        low, high = (place_of(env.abstract_indices, corner, ground) for corner in marks.target)
        low, high = np.maximum(low[:2], [x_lo, y_lo]), np.minimum(high[:2], [x_hi, y_hi])
        _add(scene, "BOX", [*(high - low) / 2, 0.02], [*(low + high) / 2, floor + 0.03], (*TARGET, 0.25), emission=0.3)
    if marks.goal is not None:
        goal = place_of(env.goal_indices, marks.goal, ground)
        _add(scene, "CYLINDER", [env.success_radius, 0.02, 0.0], [*goal[:2], floor + 0.06], (*GOAL, 0.35))
        _add(scene, "SPHERE", [size] * 3, [*goal[:2], max(goal[2], floor + size)], (*GOAL, 1.0), emission=0.3)
    if marks.subgoal is not None:
        subgoal = place_of(env.abstract_indices, marks.subgoal, ground)
        _add(scene, "SPHERE", [0.8 * size] * 3, [*subgoal[:2], floor + size], (*SUBGOAL, 1.0), emission=0.3)
    if marks.trail is not None:
        _add_trail(scene, marks.trail, height=floor + 0.1)


def _add_trail(scene: mujoco.MjvScene, trail: np.ndarray, *, height: float) -> None:
    points = np.asarray(trail, np.float64)[:: max(1, len(trail) // 400)]
    colour = 0.6 * np.array(TRAIL)  # lines are lit from all sides
    points = np.column_stack([points, np.full(len(points), height)])
    for start, end in zip(points[:-1], points[1:], strict=True):
        if np.linalg.norm(end - start) > 1e-6:
            geom = _add(scene, "LINE", [1, 1, 1], start, (*colour, 1.0))
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, TRAIL_WIDTH, start, end)


def _add(
    scene: mujoco.MjvScene, kind: str, size: Any, position: Any, colour: tuple[float, ...], *, emission: float = 0.0
) -> mujoco.MjvGeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(
        geom,
        getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"),
        np.asarray(size, np.float64),
        np.asarray(position, np.float64),
        np.eye(3).ravel(),
        np.asarray(colour, np.float32),
    )
    geom.emission = emission
    geom.specular = 0.0
    scene.ngeom += 1
    return geom
