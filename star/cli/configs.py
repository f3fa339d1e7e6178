"""`star configs`."""

from __future__ import annotations

import argparse
from typing import Any

from star.cli.words import refuse_settings
from star.config import shipped
from star.config.section import ConfigError

HELP = "list the configs that come with STAR, for star train and star sweep"
DESCRIPTION = """\
List the config files that come with this package, by name: star train ant_maze --with agents/hiro.
Those in agents/, ablations/ and sgim/, paper/many and saht/even are laid over others with --with. star sweep takes
those of sweeps/. All others train as they are."""


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("word", nargs="?", default="", help="only names that contain this, such as fall")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print names with a sentence each."""
    refuse_settings(overrides)
    found = [(name, about) for name, about in shipped.described() if options.word in name]
    if not found:
        raise ConfigError(f"{options.word}: no config has this in its name; star configs lists all")
    width = max(len(name) for name, _ in found)
    for name, about in found:
        print(f"{name:{width}}  {about}")
    return 0
