"""`star watch`."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from star.cli.words import natural, refuse_settings
from star.config.loading import load_run

HELP = "a run while it trains, in the browser"
DESCRIPTION = """\
The page of `star report`, renewed while the run trains: curves, regions as they grow, and a film of the newest
checkpoint. Only this machine can open it. It ends with the run; the page that is open then stays."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run directory")
    parser.add_argument("--port", type=natural, default=0, metavar="N", help="of the page (default: a free one)")
    parser.add_argument("--no-films", dest="films", action="store_false", help="draw none: each takes a core a minute")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Serve the page until training ends."""
    refuse_settings(overrides)
    config = load_run(options.run, {})

    from star.report import watching

    watching.serve(options.run, config, port=options.port, films=options.films, say=partial(print, flush=True))
    return 0
