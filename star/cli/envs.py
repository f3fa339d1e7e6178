"""`star envs`."""

from __future__ import annotations

import argparse
from typing import Any

from star.cli.words import refuse_settings
from star.config import kinds
from star.config.loading import DEFAULT

HELP = "list the tasks and worlds"
DESCRIPTION = None
_WIDTH = 20  # columns


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments: none."""


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print the tasks of STAR, and what other experiments learn in."""
    refuse_settings(overrides)
    for name, places in kinds.places().items():
        for place in places:
            print(place if name == DEFAULT else f"{place:{_WIDTH}} a world of experiment {name}")
    return 0
