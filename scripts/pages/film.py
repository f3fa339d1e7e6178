"""Make the film of the README and the docs, docs/images/film.gif: an agent that goes to its goal.

    python scripts/pages/film.py [AGENT] [--evaluation-seed 0] [--every 6] [--height 240]

AGENT is a run, or an agent of the package (default: ant_maze, or point_maze where that one is not shipped). The film
shows its greedy episode on the test goal, with region, subgoal and trail, and ends a little after it has arrived. An
episode that does not end within the goal is refused, so the film may show a success; results tell how often.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from PIL import Image

from envs import video
from envs.common.errors import UserError
from scripts.pages import charts
from star.agent import films
from star.agent.exams import Exam
from star.config import agents
from star.config.loading import load_to_act

FILM = charts.IMAGES / "film.gif"
DEFAULTS = ("ant_maze", "point_maze")


def ending(path: Path = FILM) -> dict[str, Any]:
    """The film's words about its last picture: agent, seconds, distance to the goal (m), and success."""
    with Image.open(path) as film:
        return dict(json.loads(film.info["comment"]))


def make(agent: str, out: Path, *, seed: int, every: int, height: int) -> dict[str, Any]:
    """Record, draw and write the film; returns its `ending`."""
    run = agents.find(Path(agent))
    recording = films.until_settled(
        films.record_run(
            load_to_act(run, {}), run, checkpoint="last", agent=None, envs=1, steps=None, exam=Exam(seed=seed)
        )
    )
    moments = recording.moments
    if not moments.success[-1, 0]:
        raise UserError("the episode does not end within the goal; choose another agent or --evaluation-seed")
    show = films.Show(out, every=every, height=height, camera="follow")
    times = video.moments(out, len(moments.obs), every=every)
    pictures = [Image.fromarray(one) for one in films.draw(recording, show, times)]
    told = {
        "agent": Path(agent).name,
        "seconds": round((len(moments.obs) - 1) * recording.env.dt, 1),
        "distance": round(float(moments.distance[-1, 0]), 2),
        "success": bool(moments.success[-1, 0] > 0),
    }
    few = [one.quantize(charts.COLOURS // 2, dither=Image.Dither.NONE) for one in pictures]
    few[0].save(
        out,
        save_all=True,
        append_images=few[1:],
        duration=100,
        loop=0,
        optimize=True,
        comment=json.dumps(told).encode(),
    )
    return told


def main() -> None:
    """Make the film and print how it ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shipped = [name for name in DEFAULTS if (agents.FOLDER / f"{name}.zip").exists()]
    parser.add_argument("agent", nargs="?", default=shipped[0])
    parser.add_argument("--evaluation-seed", type=int, default=0)
    parser.add_argument("--every", type=int, default=6, help="draw every Nth env step")
    parser.add_argument("--height", type=int, default=240, help="pixels")
    options = parser.parse_args()
    try:
        told = make(options.agent, FILM, seed=options.evaluation_seed, every=options.every, height=options.height)
    except UserError as error:
        parser.exit(2, f"error: {error}\n")
    print(f"{FILM}: {FILM.stat().st_size:,} bytes, {told}")


if __name__ == "__main__":
    main()
