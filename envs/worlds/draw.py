"""Pictures of an execution: a still, or the frames of a film, which `envs.video.write` puts into a file.

    trace = world.trace(sequence, length)
    video.write(Path("line.gif"), draw.film(world, trace, length=length, task="line", goal=goal))

The `sketch` of a world draws its looks; one without a sketch is shown by its outcomes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from envs import video
from envs.worlds.world import World, sole

DPI = 100
GOAL, TRAIL, ARM, TIP, INK, EDGE, PAPER = "#009e73", "#992673", "0.45", "#d98c40", "0.15", "0.6", "0.95"
WATER, BLUE, GREEN = "#d6e6f2", "#4477aa", "#66bb55"


def still(
    world: World, trace: Any, *, step: int = -1, task: int | str | None = None, goal: Any = None, height: int = 340
) -> np.ndarray:
    """The world after one control step of a trace without batch axes, the last by default: uint8 [height, width, 3].

    `goal` [4] of `task` is marked, if they are given.

    Raises:
      EnvError: in one line, if there is no such task, or the trace is of several executions.
    """
    sole(trace.outcomes.reached, world)
    index = None if task is None else world.index(task)
    path, found = jax.tree.map(np.asarray, (trace.path, trace.outcomes))
    figure = figure_of(height, 2.4 if world.sketch else len(world.tasks))
    marked = None if index is None or goal is None else np.asarray(goal)
    if world.sketch is None:
        _sketch_outcomes(figure, world, found, index, marked)
    else:
        world.sketch(figure, path, step, index, marked)
    if index is not None and marked is not None:
        apart = np.linalg.norm(found.value[index] - marked)
        said = f"ends {apart:.3f} from the goal" if found.reached[index] else "not reached"
        figure.suptitle(f"{world.names[index]}: {said}", x=0.01, ha="left", size=10, color=INK)
    return pixels(figure)


def film(
    world: World,
    trace: Any,
    *,
    length: int | None = None,
    every: int = 2,
    task: int | str | None = None,
    goal: Any = None,
    height: int = 340,
) -> Iterator[np.ndarray]:
    """A still after every so many control steps of the first `length` primitives, by default of all, and the last."""
    steps = len(jax.tree.leaves(trace.path)[0]) * (length or world.longest) // world.longest
    for step in video.sampled(steps, every):
        yield still(world, trace, step=step, task=task, goal=goal, height=height)


def panel(axes: Any, title: str, *, x: tuple[float, float], y: tuple[float, float], equal: bool = True) -> Any:
    """Dress axes: title, limits of x and y, small ticks; returns them."""
    axes.set(xlim=x, ylim=y, aspect="equal" if equal else "auto", facecolor=PAPER)
    axes.set_title(title, size=9, color=INK)
    axes.tick_params(labelsize=7, color=EDGE, labelcolor="0.35", length=2)
    axes.spines[:].set_visible(False)
    return axes


def arm(axes: Any, points: Sequence[tuple[Any, Any]]) -> None:
    """Draw links and joints, from the base to the tip."""
    axes.plot(*zip(*points, strict=True), color=ARM, lw=5, solid_capstyle="round", zorder=3)
    axes.plot(*zip(*points[:-1], strict=True), ".", color="white", ms=4, zorder=4)
    axes.plot(*points[-1], "o", color=TIP, mec=INK, ms=6, zorder=6)


def star(axes: Any, x: float, y: float) -> None:
    """Mark a goal."""
    axes.plot(x, y, "*", color=GOAL, mec="white", mew=0.8, ms=13, zorder=9, clip_on=False)


def _sketch_outcomes(figure: Any, world: World, found: Any, task: int | None, goal: Any) -> None:
    """A panel for each task: its first two dimensions, what was reached and, in its own, the goal."""
    lower, upper = np.asarray(world.lower), np.asarray(world.upper)
    panels = figure.subplots(1, len(world.tasks), squeeze=False)[0]
    for i, (axes, name, dims) in enumerate(zip(panels, world.names, world.dims, strict=True)):
        spans = [(lower[i, k], upper[i, k]) if k < dims else (-1.0, 1.0) for k in range(2)]
        panel(axes, name, x=spans[0], y=spans[1], equal=False)
        if found.reached[i]:
            axes.plot(*found.value[i, :2], "o", color=TIP, mec=INK, ms=7, clip_on=False)
        if i == task and goal is not None:
            star(axes, *goal[:2])


def figure_of(height: int, aspect: float) -> Any:
    """A Matplotlib figure so many pixels high, and `aspect` times as wide."""
    from matplotlib.figure import Figure

    size = np.array([round(height * aspect / 2) * 2, height])
    figure = Figure(figsize=tuple(size / DPI), dpi=DPI, facecolor="white")
    # Given once and for all: to work out a layout takes half of the time of a picture.
    figure.subplots_adjust(left=0.05, right=0.98, bottom=0.1, top=0.84, wspace=0.2)
    return figure


def pixels(figure: Any) -> np.ndarray:
    """Its picture: uint8 [height, width, 3]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3]
