"""Draw the pictures of docs/worlds.md into docs/images/.

python scripts/pages/worlds.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from envs import video, worlds
from envs.worlds import World, draw

IMAGES = Path(__file__).parents[2] / "docs" / "images"


def main() -> None:
    pen, throw, fishing, table = (worlds.make(name) for name in ("pen", "throw", "fishing", "table"))
    shown_goals = (("pen_line", pen, "line", 7), ("throw", throw, "thrown", 330), ("fishing", fishing, "float", 77))
    for name, world, task, goal in (*shown_goals, ("table", table, "tune", 3)):
        trace, _, shown = demonstration(world, task, goal)
        video.write(IMAGES / f"{name}.png", [draw.still(world, trace, **shown)])
    trace, length, shown = demonstration(pen, "character", 3)
    frames = draw.film(pen, trace, length=length, every=4, **shown)
    video.write(IMAGES / "pen_character.gif", frames, fps=8)


def demonstration(world: World, task: str, goal: int) -> tuple[Any, int, dict[str, Any]]:
    """The trace and length of what the teacher shows for a goal of the evaluation, and the goal."""
    wanted = world.benchmark(task)[goal]
    sequence, length = world.demonstrate(task, wanted)
    return world.trace(sequence, length), int(length), {"task": task, "goal": wanted}


if __name__ == "__main__":
    main()
