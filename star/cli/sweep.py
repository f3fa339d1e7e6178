"""`star sweep`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console

from envs.common.files import given_back, new_place
from star.cli.words import count
from star.config import command_line

HELP = "try many settings"
DESCRIPTION = """\
Train with many settings that Optuna chooses, side by side where it can be done, and write down which are best.
The same command with --out goes on with a sweep; with --storage it joins it from any number of machines.
Any setting of all trials can be overridden: --section.key VALUE (see `star settings`)."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("file", type=Path, help="YAML file, such as configs/sweeps/point_maze.yaml")
    parser.add_argument("--trials", type=count(), metavar="N", help="trials of the study in all (default: of the file)")
    parser.add_argument("--batch", type=count(), metavar="N", help="trials side by side at most (default: of the file)")
    parser.add_argument(
        "--storage",
        metavar="URL",
        help="postgresql://USER@HOST/DATABASE (default: sweep.db in the folder of the sweep)",
    )
    parser.add_argument("--study", metavar="NAME", help="name in the database (default: that of the file)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where to write, or what to go on with (default: sweeps/NAME-TIME)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Work on a sweep until it has ended."""
    from star.sweeps import plan, results, work

    given = {"trials": options.trials, "batch": options.batch, "study": options.study}
    found = plan.plan(options.file, settings=overrides, **{key: x for key, x in given.items() if x is not None})
    # workers of one study find the same folder
    folder = Path("sweeps")
    out = options.out or (folder / found.name if options.storage else new_place(folder, options.file.stem))
    with given_back(out):
        summary = work.run(found, out, storage=options.storage, quiet=options.quiet)
    Console().print(results.table(summary.rows, found))
    if not summary.finished:
        again = command_line.of("sweep", options.file, *(["--storage", "URL"] if options.storage else []), "--out", out)
        print(f"interrupted; running trials were given back; go on with: {again}")
        return 130
    print(f"trials:  {out}/trials.csv")
    if summary.best is None:
        print("no trial was completed")
        return 1
    print(f"figures: {out}/figures/\nbest:    trial {summary.best['trial']}")
    print(f"next:    {command_line.of('train', out / 'best.yaml')}")
    return 0
