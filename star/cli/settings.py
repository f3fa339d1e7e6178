"""`star settings`."""

from __future__ import annotations

import argparse
import json
from typing import Any

from star.cli.words import refuse_settings
from star.config import kinds
from star.config.loading import DEFAULT, fields
from star.config.section import ConfigError

HELP = "list every setting with its default and meaning"
DESCRIPTION = None


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("prefix", nargs="?", default="", help="only settings that begin so, such as tutor")
    parser.add_argument("--experiment", default=DEFAULT, metavar="NAME", help="star (default), or MODULE:NAME")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print the settings of a kind of experiment."""
    refuse_settings({key: value for key, value in overrides.items() if key != "experiment"})
    model = kinds.find(options.experiment).Config
    rows = [row for row in fields(model) if row[0].startswith(options.prefix)]
    if not rows:
        raise ConfigError(f"{options.prefix}: no setting begins so; sections are {', '.join(model.model_fields)}")
    width = max(len(key) for key, _, _ in rows)
    for key, default, description in rows:
        print(f"{key:{width}}  {description} (default {json.dumps(default)})")
    return 0
