"""`star tutor`: what the experiment of tutoring does with a user's own data."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from star.cli.words import natural
from star.config import kinds

HELP = "prerequisites of skills, found from scores"
DESCRIPTION = """\
Find which skills come before which from the scores of students: SCORES has the columns student, exercise and correct
(0 or 1), a student's rows in the order of time; SKILLS has the columns exercise and skill. The graph is written as
JSON, GraphML and a figure. Any setting of discovery can be overridden: --discovery.members 20."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("action", choices=("discover",), metavar="discover", help="find the graph of prerequisites")
    parser.add_argument("scores", type=Path, metavar="SCORES", help="CSV file: student,exercise,correct")
    parser.add_argument("skills", type=Path, metavar="SKILLS", help="CSV file: exercise,skill")
    parser.add_argument(
        "--out", type=Path, default=Path("prerequisites"), metavar="DIR", help="where to write (default: prerequisites)"
    )
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="of what is drawn at random (default: 0)")
    parser.add_argument("--force", action="store_true", help="replace a graph that is there already")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Find and write the graph."""
    return kinds.find("tutoring").commands[options.action](options, overrides)
