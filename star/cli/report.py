"""`star report`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from envs.common import files
from star.cli.runs import groups_of
from star.cli.words import refuse_settings
from star.config.loading import load_run
from star.config.run import RunConfig
from star.config.section import ConfigError

HELP = "runs as one HTML page"
DESCRIPTION = """\
One page with the curves of the runs over each other, how their regions grew, what they are worth to the Commander,
the settings in which the runs differ, and films. It needs no network. A run may still be going on."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run directory")
    parser.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME=RUN,RUN",
        help="runs that differ in their seeds alone, to be shown as one",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help=".html")
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Write the page."""
    refuse_settings(overrides)
    files.check(options.out, (".html",), force=options.force)
    groups = groups_of(options.group)
    chosen = [one for members in groups.values() for one in members] + options.runs
    if not chosen:
        raise ConfigError("star report: give a RUN, or --group NAME=RUN,RUN (see star report --help)")
    found: dict[Path, RunConfig] = {}
    for one in chosen:
        if one.resolve() in {other.resolve() for other in found}:
            raise ConfigError(f"{one}: is given twice")
        found[one] = load_run(one, {})

    from star.report import page

    print(page.write(found, options.out, groups=groups))
    return 0
