"""`star evaluate`: by the experiment's own command, or what its `evaluate` measures."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console

from star.cli import runs
from star.cli.words import count, natural
from star.config.loading import experiment_of, load_to_act
from star.config.section import ConfigError

HELP = "success of trained agents"
DESCRIPTION = """\
Greedy episodes of trained agents on test goals, training goals or a grid of goals: success, time and way to the goal,
with 95 % intervals; of several runs also how they compare. With --env.name or --env.options.KEY they act in another
task than that of their training. With --goals grid, JSON and figures go to RUN/evaluation unless --out is given."""
_OF_ITS_OWN: dict[str, Any] = {
    "goals": "test",
    "grid": None,
    "group": [],
    "out": None,
    "force": False,
}  # of commands of experiments


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument(
        "runs",
        nargs="*",
        type=Path,
        metavar="RUN",
        help="run, one RUN/checkpoints/STEPS of it, or an agent of this package",
    )
    parser.add_argument(
        "--checkpoint", default="last", metavar="last|best|all|STEPS", help="which ones of each RUN (default: last)"
    )
    parser.add_argument("--episodes", dest="trainer.eval_episodes", metavar="N", help="episodes per seed")
    parser.add_argument("--evaluation-seed", type=natural, default=0, metavar="N", help="seed of goals and starts")
    add_goals(parser)
    parser.add_argument(
        "--group", action="append", default=[], metavar="NAME=RUN,RUN", help="runs to be compared as one with others"
    )
    parser.add_argument("--json", action="store_true", help="print JSON, a line for each checkpoint")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write JSON and figures there")
    parser.add_argument("--force", action="store_true", help="replace an evaluation that is there already")
    parser.add_argument("--quiet", action="store_true", help="no progress")


def add_goals(command: argparse.ArgumentParser) -> None:
    """The goals: `render` shows episodes of such evaluations."""
    command.add_argument(
        "--goals",
        choices=("test", "train", "grid"),
        default="test",
        help="those of tests (default), those of training, or a grid over the maze",
    )
    command.add_argument("--grid", type=count(64), metavar="N", help="the grid has N x N cells (default: 8)")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Evaluate checkpoints and print what was measured."""
    chosen, groups = runs.chosen(options)
    if not chosen:
        raise ConfigError("star evaluate: give a RUN, or --group NAME=RUN,RUN (see star evaluate --help)")
    kind = runs.kind_of([run for run, _ in chosen], "evaluate")
    if "evaluate" in kind.commands:
        return kind.commands["evaluate"](chosen, groups, options, overrides)
    for flag, usual in _OF_ITS_OWN.items():
        if getattr(options, flag) != usual:
            raise ConfigError(f"--{flag}: experiment {experiment_of(chosen[0][0])} has no such evaluation")

    from star.report import evaluations

    rows = []
    for run_dir, checkpoint in chosen:
        config = load_to_act(run_dir, overrides)
        rows += evaluations.evaluate(config, run_dir, checkpoint=checkpoint, seed=options.evaluation_seed)
    if options.json:
        print("\n".join(json.dumps(row) for row in rows))
    else:
        Console(highlight=False).print(evaluations.table(rows, kind))
    return 0
