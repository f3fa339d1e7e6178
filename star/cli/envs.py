"""`star envs`."""

from __future__ import annotations

import argparse
from typing import Any

from star.cli.words import refuse_settings
from star.config import kinds
from star.config.loading import DEFAULT

HELP = "list the tasks"
DESCRIPTION = None


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments: none."""


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print the tasks of STAR."""
    refuse_settings(overrides)
    return kinds.find(DEFAULT).commands["envs"]()
