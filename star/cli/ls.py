"""`star ls`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from star.cli.words import refuse_settings

HELP = "list runs: task, success, env steps, age, state"
DESCRIPTION = "List the runs in a folder, the latest first."
_USUAL = Path("runs")


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("folder", nargs="?", type=Path, default=_USUAL, help="where to look (default: runs)")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print a table."""
    refuse_settings(overrides)
    from rich.console import Console

    from star.report import listing

    found = listing.of(options.folder) if options.folder != _USUAL or _USUAL.exists() else []
    if not found:
        print(f"no runs in {options.folder}")
        return 0
    Console(highlight=False).print(listing.table(found))
    for one in found:
        if one.fault:
            print(f"{one.path}: {one.fault}")
    return 0
