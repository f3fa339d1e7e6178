"""A sheet: the camera's picture of one environment, beside it a map from above, over both a line of text.

On the map, in m: walls, chasms, blocks and gates where they are, the start, the way of the body, its goal with the
radius of success and, if there are any, subgoal, target region and the other regions.

The unchanging part is drawn once; a further sheet costs some milliseconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle

from envs import render, scene
from envs.render import GOAL, SUBGOAL, TARGET, TRAIL, Marks, Stage

DPI = 100
FLOOR, VOID, INK, REGION = "0.95", "0.3", "0.15", "0.6"
BODY = (0.85, 0.55, 0.25)
SMALL = 300  # pixels of height below which ticks and legend are left out
LEGEND_ROW = 17  # pixels


class Sheet:
    """Draws what happens on one stage, again and again."""

    def __init__(
        self, stage: Stage, *, height: int, view_width: int = 0, regions: Any = None, subgoals: bool = False
    ) -> None:
        """`height` is that of map and camera's picture, in pixels, `view_width` the width of the latter.

        `regions` are the regions to outline, (lower, upper), both [n, d] over the abstract dimensions. `subgoals`
        tells whether there will be subgoals and target regions.
        """
        small = height < SMALL
        left, right, bottom, top = (4, 4, 4, 0) if small else (42, 12, 46 + LEGEND_ROW * subgoals, 4)
        inner = round(render.aspect_of(stage.env.arena) * (height - bottom - top)), height - bottom - top
        self._stage = stage
        self._head = max(16, height // 15)
        self.width, self.height = _even(view_width + left + inner[0] + right), _even(self._head + height)
        size = np.array([self.width, self.height])
        figure = Figure(figsize=tuple(size / DPI), dpi=DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(figure)
        corner = np.array([view_width + left, bottom + self.height - self._head - height])
        axes = figure.add_axes((*(corner / size), *(inner / size)))
        font = 72 / DPI * max(9.0, min(0.45 * self._head, 14.0))
        line = 1 - self._head / 2 / self.height
        self._left = figure.text(6 / self.width, line, "", va="center", size=font, color=INK)
        self._right = figure.text(1 - 6 / self.width, line, "", ha="right", va="center", size=font, color=INK)
        self._draw_arena(axes, regions, small=small)
        self._add_movers(axes, scale=min(1.0, height / 400))
        if not small:
            font = 72 / DPI * min(11.0, inner[0] / 28)
            rows = _legend_rows(stage.env.success_radius, regions=regions is not None, subgoals=subgoals)
            for number, row in enumerate(rows):
                below = LEGEND_ROW * (len(rows) - 1 - number) / self.height
                _add_legend(figure, row, ((corner[0] + inner[0] / 2) / self.width, below), font=font)
        self._moving: list[Artist] = [
            self._target, self._reach, *self._gates, *self._blocks, self._trail, self._start, self._goal, self._subgoal,
            self._body, self._left, self._right,
        ]  # fmt: skip
        for artist in self._moving:
            artist.set_animated(True)
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def draw(self, marks: Marks, *, left: str = "", right: str = "", view: np.ndarray | None = None) -> np.ndarray:
        """The stage as it is now: uint8 [self.height, self.width, 3]; `left` and `right` are the line of text."""
        self._left.set_text(left)
        self._right.set_text(right)
        self._move(marks)
        self._canvas.restore_region(self._background)
        renderer = self._canvas.get_renderer()
        for artist in self._moving:
            artist.draw(renderer)
        pixels = np.array(self._canvas.buffer_rgba())[..., :3]
        if view is not None:
            pixels[self._head : self._head + view.shape[0], : view.shape[1]] = view
        return pixels

    def _draw_arena(self, axes: Axes, regions: Any, *, small: bool) -> None:
        env = self._stage.env
        x_lo, y_lo, x_hi, y_hi = render.frame_of(env.arena)
        axes.set(xlim=(x_lo, x_hi), ylim=(y_lo, y_hi), aspect="equal", facecolor=FLOOR)
        axes.add_collection(_rectangles(env.arena.chasms(), facecolor=VOID))
        axes.add_collection(_rectangles(env.arena.walls(), facecolor=scene.WALL_COLOUR))
        if regions is not None:
            columns = [env.abstract_indices.index(i) for i in (0, 1)]
            outlines = np.concatenate([corner[:, columns] for corner in regions], axis=1)
            axes.add_collection(_rectangles(outlines, facecolor="none", edgecolor=REGION, linewidth=0.7))
        axes.tick_params(labelsize=72 / DPI * 11, color=REGION, labelcolor="0.35", length=2)
        width, height = axes.bbox.size
        axes.locator_params("x", nbins=max(2, width // 70), steps=[1, 2, 4, 5, 8, 10])
        axes.locator_params("y", nbins=max(2, height // 70), steps=[1, 2, 4, 5, 8, 10])
        axes.xaxis.set_major_formatter("{x:g} m")
        axes.yaxis.set_major_formatter("{x:g} m")
        axes.spines[:].set_visible(False)
        if small:
            axes.set(xticks=[], yticks=[])

    def _add_movers(self, axes: Axes, *, scale: float) -> None:
        """Artists of what changes from sheet to sheet; `_move` puts them where they belong."""

        def marker(symbol: str, size: float, **style: Any) -> Line2D:
            line = Line2D([], [], marker=symbol, markersize=size * scale, linestyle="none")
            line.set(**{"markeredgecolor": "white", "markeredgewidth": 0.8 * scale} | style)
            return axes.add_line(line)

        def rectangle(**style: Any) -> Rectangle:
            patch = Rectangle((0, 0), 0, 0, **style)
            axes.add_patch(patch)
            return patch

        self._blocks = [rectangle(facecolor=scene.BLOCK_COLOUR, linewidth=0) for _ in self._stage.boxes("block")]
        self._gates = [rectangle(edgecolor=scene.GATE_COLOUR, hatch="///") for _ in self._stage.boxes("gate")]
        self._target = rectangle(facecolor=(*TARGET, 0.2), edgecolor=TARGET, linewidth=1.5 * scale)
        self._reach = Circle(
            (0, 0), self._stage.env.success_radius, facecolor=(*GOAL, 0.2), edgecolor=GOAL, linewidth=1
        )
        axes.add_patch(self._reach)
        (self._trail,) = axes.plot([], [], color=TRAIL, linewidth=1.4 * scale, solid_joinstyle="round")
        self._start = marker("o", 6, markerfacecolor="white", markeredgecolor=TRAIL, markeredgewidth=1.4 * scale)
        self._goal = marker("*", 13, markerfacecolor=GOAL)
        self._subgoal = marker("D", 7, markerfacecolor=SUBGOAL)
        self._body = marker("o", 9, markerfacecolor=BODY, markeredgecolor=INK)

    def _move(self, marks: Marks) -> None:
        stage = self._stage
        trail = stage.body[None, :2] if marks.trail is None else np.asarray(marks.trail)
        self._trail.set_data(*trail.T)
        self._start.set_data(*trail[:1].T)
        self._body.set_data(*stage.body[:2, None])
        self._place(self._goal, stage.env.goal_indices, marks.goal)
        self._place(self._subgoal, stage.env.abstract_indices, marks.subgoal)
        self._reach.set_visible(marks.goal is not None)
        if marks.goal is not None:
            self._reach.center = tuple(self._point(stage.env.goal_indices, marks.goal))
        self._target.set_visible(marks.target is not None)
        if marks.target is not None:
            _span(self._target, *(self._point(stage.env.abstract_indices, corner) for corner in marks.target))
        floor = stage.env.arena.floor_height
        for patch, (low, high, height) in zip(self._blocks, stage.boxes("block"), strict=True):
            _span(patch, low, high)
            patch.set_alpha(1.0 if height > floor else 0.6)  # fallen in
        for patch, (low, high, height) in zip(self._gates, stage.boxes("gate"), strict=True):
            _span(patch, low, high)
            patch.set_facecolor("none" if height > floor + stage.env.arena.wall_height else scene.GATE_COLOUR)

    def _point(self, indices: tuple[int, ...], values: np.ndarray) -> np.ndarray:
        return render.place_of(indices, values, self._stage.body)[:2]

    def _place(self, marker: Line2D, indices: tuple[int, ...], values: np.ndarray | None) -> None:
        marker.set_visible(values is not None)
        if values is not None:
            marker.set_data(*self._point(indices, values)[:, None])


def tiled(pictures: list[np.ndarray], columns: int) -> np.ndarray:
    """Pictures [h, w, 3] of one size side by side in rows of `columns`, on white."""
    if len(pictures) == 1:
        return pictures[0]
    height, width, _ = pictures[0].shape
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        row, column = divmod(i, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = picture
    return sheet


def _legend_rows(radius: float, *, regions: bool, subgoals: bool) -> list[list[Line2D | Patch]]:
    """Handles of what is on each map, and of what an agent aims at; `radius` is that of success, in m."""

    def point(symbol: str, colour: Any, size: float, label: str, **style: Any) -> Line2D:
        return Line2D([], [], marker=symbol, color=colour, linestyle="none", markersize=size, label=label, **style)

    task: list[Line2D | Patch] = [
        Line2D([], [], color=TRAIL, label="way"),
        point("*", GOAL, 9, "goal"),
        point("o", GOAL, 9, f"success: within {radius:g} m", markerfacecolor=(*GOAL, 0.2)),
        Patch(facecolor=scene.WALL_COLOUR, label="wall"),
    ]
    if not subgoals:
        return [task]
    aims: list[Line2D | Patch] = [
        point("D", SUBGOAL, 5, "subgoal"),
        Patch(facecolor=(*TARGET, 0.2), edgecolor=TARGET, label="target: region or goal's box"),
    ]
    if regions:
        aims.append(Patch(facecolor="none", edgecolor=REGION, label="region"))
    return [task, aims]


def _add_legend(figure: Figure, handles: list[Line2D | Patch], middle: tuple[float, float], *, font: float) -> None:
    figure.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=middle,
        ncols=len(handles),
        fontsize=font,
        labelcolor=INK,
        frameon=False,
        borderaxespad=0.2,
        handlelength=1.2,
        handletextpad=0.5,
        columnspacing=1.0,
    )


def _rectangles(corners: np.ndarray, *, facecolor: Any, edgecolor: Any = "none", linewidth: float = 0.0) -> Any:
    patches = [Rectangle((x_lo, y_lo), x_hi - x_lo, y_hi - y_lo) for x_lo, y_lo, x_hi, y_hi in corners]
    return PatchCollection(patches, facecolor=facecolor, edgecolor=edgecolor, linewidth=linewidth)


def _span(patch: Rectangle, low: np.ndarray, high: np.ndarray) -> None:
    patch.set_bounds(*low, *(high - low))


def _even(pixels: int) -> int:
    """The same or one more: videos have even sides."""
    return pixels + pixels % 2
