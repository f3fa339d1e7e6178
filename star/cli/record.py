"""`star record`: demonstrations, if the experiment can make them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from star.cli import runs
from star.cli.words import count, natural
from star.config import agents
from star.config.section import ConfigError

HELP = "demonstrations by a trained agent"
DESCRIPTION = """\
Greedy episodes of a trained agent on training goals. Those that reach the goal are written, up to the step that
does, as demonstrations for other agents: routes, states and actions."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("run", type=Path, help="run directory, or an agent of this package")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".npz")
    parser.add_argument("--episodes", type=count(10_000), default=100, metavar="N", help="to play (default: 100)")
    parser.add_argument("--checkpoint", default="last", metavar="last|best|STEPS", help="which one (default: last)")
    parser.add_argument("--seed", type=natural, metavar="N", help="which agent of the run (default: its first seed)")
    parser.add_argument("--evaluation-seed", type=natural, default=0, metavar="N", help="seed of goals and starts")
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Write demonstrations of the agent of a run."""
    options.run = agents.find(options.run)
    kind = runs.kind_of([options.run], "record")
    if "record" not in kind.commands:
        raise ConfigError(f"{agents.told(options.run)}: its experiment makes no demonstrations")
    return kind.commands["record"](options, overrides)
