"""`star render`: pictures, if the experiment has some."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from star.cli import runs
from star.cli.evaluate import add_goals
from star.cli.words import count, natural
from star.config import agents, kinds
from star.config.loading import DEFAULT
from star.config.section import ConfigError

HELP = "pictures of a task or of an agent"
DESCRIPTION = """\
Random actions in TASK, or with --run the greedy policy of a trained agent on test goals.
Of a world: what its teacher shows, or with --run how a learner reaches goal K of its TASK (--episode K).
Of a run of CHIME: a test in its room, or with `models` for TASK its graph of models, at each evaluation.
.png and .jpg hold one picture, of a task its start, of an agent the end of the episode; .mp4, .gif and .html hold all.
A setting of the task is given as --env.options.KEY VALUE."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument(
        "task",
        nargs="?",
        help="one of `star envs`, MODULE:NAME, or a run; with --run its own task, or one of its world",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".png, .jpg, .mp4, .gif or .html")
    parser.add_argument(
        "--run",
        "--agent",
        type=Path,
        metavar="RUN",
        help="show the agent of this run, or of this package",
    )
    parser.add_argument("--checkpoint", metavar="last|best|STEPS", help="which one of the run (default: last)")
    parser.add_argument("--seed", type=natural, metavar="N", help="which agent of the run (default: its first seed)")
    parser.add_argument(
        "--evaluation-seed", type=natural, default=0, metavar="N", help="seed of goals, starts and random actions"
    )
    parser.add_argument("--envs", type=count(25), default=1, metavar="N", help="environments side by side (default: 1)")
    parser.add_argument("--episode", type=natural, metavar="K", help="show episode K of `star evaluate` of the run")
    parser.add_argument("--episodes", dest="trainer.eval_episodes", metavar="N", help="that evaluation's --episodes")
    add_goals(parser)
    parser.add_argument(
        "--steps",
        type=natural,
        metavar="N",
        help="env steps (default: the episode, in a film until 2 s after arrival; 0 in a picture of a task)",
    )
    parser.add_argument("--every", type=count(), default=2, metavar="N", help="draw every Nth env step (default: 2)")
    parser.add_argument("--fps", type=count(50), default=20, metavar="N", help="pictures a second (default: 20)")
    parser.add_argument(
        "--camera", choices=("follow", "overview", "top"), help="default: overview in a still, follow in a film"
    )
    parser.add_argument("--height", type=count(1080), metavar="PX", help="of the picture of one environment")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Draw what the experiment of the run draws, or a task of STAR."""
    if options.run is None and options.task and Path(options.task, "config.yaml").is_file():
        options.run, options.task = Path(options.task), None
    options.run = options.run and agents.find(options.run)
    kind = runs.kind_of([options.run], "render") if options.run else kinds.find(_experiment(options.task))
    if "render" not in kind.commands:
        raise ConfigError(f"{options.run}: its experiment draws no episodes; see its figures in {options.run}/figures")
    return kind.commands["render"](options, overrides)


def _experiment(task: str | None) -> str:
    """The experiment that a task or world is of."""
    return next((name for name, places in kinds.places().items() if task in places), DEFAULT)
