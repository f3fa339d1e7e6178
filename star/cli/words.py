"""The words of a command line: numbers, and settings with dots."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from typing import Any

import yaml

from envs.common import reading
from star.config.section import ConfigError

_SETTING = re.compile(r"[A-Za-z_]\w*(\.\w+)+=")  # at the beginning of a word; a path would have a /


def split_settings(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Take the dotted settings `--section.key VALUE`, `--section.key=VALUE` or `section.key=VALUE` out of `arguments`.

    Returns the other words, and the settings; raises `UserError` for a setting without a value.
    """
    words: list[str] = []
    found: dict[str, Any] = {}
    waiting = list(arguments)
    while waiting:
        word = waiting.pop(0)
        name, equals, text = word.removeprefix("--").partition("=")
        if not (word.startswith("--") and "." in name) and not _SETTING.match(word):
            words.append(word)
            continue
        if not equals:
            if not waiting or waiting[0].startswith("--"):
                raise ConfigError(f"{word}: needs a value")
            text = waiting.pop(0)
        found[name] = value(text)
    return words, found


def value(text: str) -> Any:
    """Numbers, lists and the like as YAML reads them; what is no more than text stays as it was typed."""
    try:
        read = reading.plain(text)
    except yaml.YAMLError:
        return text
    return text if isinstance(read, str) and "\n" in text else read  # YAML would fold the lines of a map


def natural(text: str) -> int:
    """A whole number from 0 on."""
    if not text.isdecimal() or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2^31 - 1")
    return int(text)


def count(most: int = 2**31 - 1) -> Callable[[str], int]:
    """Reads a whole number from 1 to `most`."""

    def read(text: str) -> int:
        if not text.isdecimal() or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return read


def refuse_settings(overrides: dict[str, Any]) -> None:
    """Raise `UserError` for settings that a command does not take."""
    for key in overrides:
        raise ConfigError(f"--{key}: this command takes no settings")
