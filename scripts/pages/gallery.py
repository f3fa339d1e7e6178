"""Draw docs/images/ and write the list of pictures at the end of docs/gallery.md, with the command `star render`.

Starts and goals of OGBench's tasks are drawn from above, into ogbench_tasks.png.

    python scripts/pages/gallery.py [TASK ...]    all tasks, or some

The list always names every task.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

import envs
from envs import layouts
from envs.tasks import TASKS
from scripts.pages import charts
from star import cli
from star.agent.figures import draw_walls, frame

DOCS = Path(__file__).parents[2] / "docs"
HEADING = "## Tasks\n"
SHARED = "A point and an ant in the same maze share a picture, of the ant.\n"
HEIGHT, SMALL = 340, 200  # pixels; small are the mazes of other projects, of which many are alike


def draw_tasks() -> Figure:
    """An arrow for each of the five tasks of OGBench's mazes, from its number at the start to its goal."""
    figure = Figure(figsize=(8.0, 2.6), layout="constrained")
    shown = [name for name, (_, cells) in layouts.OGBENCH.items() if len(cells) > 1]
    for axis, name in zip(figure.subplots(1, len(shown)), shown, strict=True):
        arena, cells = layouts.OGBENCH[name]
        walls = arena.walls()
        draw_walls(axis, walls)
        for number, (start, goal) in enumerate(cells, start=1):
            begin, end = arena.centre(start), arena.centre(goal)
            arrow = {"arrowstyle": "->", "color": f"C{number - 1}", "lw": 1.5}
            axis.annotate("", end, begin, arrowprops=arrow | {"connectionstyle": "arc3,rad=.15"})
            turn = sum(first == start for first, _ in cells[:number]) - 1  # that of several with the same start
            axis.text(begin[0] + 1.6 * turn, begin[1], str(number), color=f"C{number - 1}", ha="center", va="center")
        frame(axis, walls[:, :2], walls[:, 2:])
        axis.set_title(name)
    return figure


def by_maze(names: Sequence[str]) -> dict[str, list[str]]:
    """The tasks that share a picture, by the one that is drawn: the ant's, where a point walks in the same maze."""
    found: dict[str, list[str]] = {}
    for name in names:
        ant = name.replace("point", "ant").replace("Point", "Ant")
        drawn = ant if ant in names and TASKS[ant].arena.rows == TASKS[name].arena.rows else name
        found.setdefault(drawn, []).append(name)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    mazes = by_maze(envs.names())
    for name in parser.parse_args().tasks or mazes:
        height = str(SMALL if TASKS[name].pairs else HEIGHT)
        out = str(charts.IMAGES / f"{name}.jpg")
        code = cli.main(["render", name, "--out", out, "--height", height, "--force"])
        if code:
            return code
    charts.save(draw_tasks(), "ogbench_tasks", dpi=160)
    page = DOCS / "gallery.md"
    before, _, _ = page.read_text(encoding="utf-8").partition(HEADING)
    pictures = [
        f"### {', '.join(f'`{task}`' for task in tasks)}\n\n![{name}](images/{name}.jpg)\n"
        for name, tasks in mazes.items()
    ]
    page.write_text(before + "\n".join([HEADING, SHARED, *pictures]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
