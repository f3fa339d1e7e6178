"""Draw the three levels and a split for README and docs, docs/images/levels.png: python scripts/pages/levels.py."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import envs
from scripts.pages import charts
from star.agent.figures import draw_walls, frame
from star.agent.sections import Config

SPACE = np.array([[-4.0, -4.0, 20.0, 20.0]])  # m, of the U-maze
BOXES = np.array([(-4, -4, 8, 8), (8, -4, 20, 8), (-4, 8, 8, 20), (8, 8, 20, 20)], float)
AGENT, SUBGOAL, GOAL = np.array([0.0, 0.0]), np.array([6.0, -1.0]), np.array([0.0, 16.0])
HELD, REACHES, MISSES = "tab:blue", "tab:green", "tab:red"


def figure() -> Figure:
    """Four maps of one maze: what each level chooses, and how a region is cut."""
    config = Config()
    walls = np.asarray(envs.make("point_maze").walls)
    drawn = Figure(figsize=(10.4, 3.1), layout="constrained")
    commander, tutor, controller, split = drawn.subplots(1, 4)
    for axis, title in (
        (commander, f"Commander: a target region\nevery {config.commander.period} env steps"),
        (tutor, f"Tutor: a subgoal\nevery {config.tutor.period} env steps"),
        (controller, "Controller: an action\nevery env step"),
        (split, "Refinement: a verdict and a split\nafter an epoch"),
    ):
        _maze(axis, walls, title)
    _box(commander, BOXES[1], HELD)
    _arrow(commander, AGENT, (14, 2), "black")
    _box(tutor, BOXES[1], HELD, alpha=0.15)
    tutor.plot(*SUBGOAL, "D", color="tab:orange", ms=8)
    _arrow(tutor, AGENT, SUBGOAL, "tab:orange")
    controller.plot(*SUBGOAL, "D", color="tab:orange", ms=8)
    way = np.array([AGENT, (1.2, -0.9), (2.6, -1.4), (4.2, -1.3)])
    controller.plot(*way.T, ".-", color="tab:purple")
    _arrow(controller, way[-1], way[-1] + (1.7, 0.2), "tab:purple")
    _box(split, (8, -4, 20, 2), MISSES)
    _box(split, (8, 2, 20, 8), REACHES)
    _box(split, BOXES[3], HELD, alpha=0.15)
    _arrow(split, (14, 4), (14, 13), REACHES)
    split.annotate("reaches", (16.8, 5), ha="center", va="center", fontsize=9)
    split.annotate("misses", (16.8, -1), ha="center", va="center", fontsize=9)
    return drawn


def _maze(axis: Axes, walls: np.ndarray, title: str) -> None:
    """Walls, first regions, start and goal."""
    draw_walls(axis, walls)
    for x_low, y_low, x_high, y_high in BOXES:
        axis.add_patch(Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, fill=False, edgecolor="0.6"))
    axis.plot(*AGENT, "o", color="black", ms=6)
    axis.plot(*GOAL, "*", color="tab:green", ms=12)
    frame(axis, SPACE[:, :2], SPACE[:, 2:])
    axis.set(xlabel="", ylabel="", xticks=[], yticks=[])
    axis.set_title(title, fontsize=10)


def _box(axis: Axes, box: tuple[float, ...] | np.ndarray, colour: str, *, alpha: float = 0.35) -> None:
    x_low, y_low, x_high, y_high = box
    axis.add_patch(
        Rectangle((x_low, y_low), x_high - x_low, y_high - y_low, facecolor=colour, alpha=alpha, edgecolor=colour)
    )


def _arrow(axis: Axes, start: object, end: object, colour: str) -> None:
    axis.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8})


if __name__ == "__main__":
    charts.save(figure(), "levels", dpi=90)
