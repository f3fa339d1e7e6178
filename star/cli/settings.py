"""`star settings`."""

from __future__ import annotations

import argparse
import difflib
from typing import Any

from star.cli.words import refuse_settings
from star.config import kinds
from star.config.described import settings
from star.config.loading import DEFAULT
from star.config.section import ConfigError

HELP = "list every setting: meaning, type, range, unit, default"
DESCRIPTION = "List settings: what each does, its type with range or choices, its unit and its default."


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument(
        "word", nargs="?", default="", help="only settings with this in key or text, such as tutor; or an experiment"
    )
    parser.add_argument("--experiment", default=DEFAULT, metavar="NAME", help="star, saht, tutoring or MODULE:NAME")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print the settings of a kind of experiment."""
    refuse_settings({key: value for key, value in overrides.items() if key != "experiment"})
    named = options.word in kinds.OURS and options.word != DEFAULT
    model = kinds.find(options.word if named else options.experiment).Config
    word = "" if named else options.word.lower()
    found = [one for one in settings(model) if word in one.key or word in one.line.lower()]
    if not found:
        keys = {part for one in settings(model) for part in (one.key, *one.key.split("."))}
        near = difflib.get_close_matches(word, sorted(keys), n=1)
        meant = f" (did you mean {near[0]}?)" if near else f"; sections are {', '.join(model.model_fields)}"
        raise ConfigError(f"{options.word}: no setting has this in its key or its text{meant}")
    width = max(len(one.key) for one in found)
    for one in found:
        print(f"{one.key:{width}}  {one.line}")
    return 0
