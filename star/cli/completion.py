"""`star completion`: what a shell needs to complete commands, flags, configs, runs and settings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from star.cli.words import refuse_settings
from star.config import kinds, shipped
from star.config.described import EACH, settings
from star.config.loading import DEFAULT

HELP = "completion with the Tab key, for bash, zsh or fish"
DESCRIPTION = """\
Print what your shell needs to complete commands, flags, names of configs, folders of runs and keys of settings:

  star completion bash > ~/.local/share/bash-completion/completions/star
  star completion zsh > ~/.zfunc/_star     with fpath+=~/.zfunc before compinit in ~/.zshrc
  star completion fish > ~/.config/fish/completions/star.fish
"""
SHELLS = ("bash", "zsh", "fish")
_WITH_SETTINGS = ("train", "sweep", "evaluate", "render", "record")
_SWEEP = "sweeps/"  # how the names of sweep files begin
_FOLDERS = "find runs -mindepth 1 -maxdepth 1 -type d 2>/dev/null"
_FILES = "find . -maxdepth 1 -name \\*.yaml -printf %f\\\\n"


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("shell", choices=SHELLS)


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Print the script of a shell."""
    refuse_settings(overrides)
    print(script(options.shell))
    return 0


def script(shell: str) -> str:
    """The script of a shell, by shtab."""
    import shtab

    from star.cli.command import parsers

    parser, commands = parsers()
    sweeps = [name for name in shipped.names() if name.startswith(_SWEEP)]
    configs = [name for name in shipped.names() if not name.startswith(_SWEEP)]
    places = {
        ("config", "layers"): shtab.cmd(f"{_one_a_line(configs)}; {_FILES}"),
        ("file",): shtab.cmd(f"{_one_a_line(sweeps)}; {_FILES}"),
        ("run", "runs", "resume"): shtab.cmd(_FOLDERS),
    }  # by where argparse puts them
    for name, one in commands.items():
        for action in one._actions:
            for names, completed in places.items():
                if action.dest in names:
                    action.complete = completed  # type: ignore[attr-defined]
        if name in _WITH_SETTINGS:
            _add_settings(one)
    return shtab.complete(parser, shell)


def _one_a_line(words: Sequence[str]) -> str:
    """A command that any shell understands."""
    return f"echo {' '.join(words)} | xargs -n1"


def _add_settings(parser: argparse.ArgumentParser) -> None:
    """The keys of STAR's settings as flags, with their choices."""
    for one in settings(kinds.find(DEFAULT).Config):
        if "." in one.key and EACH not in one.key:
            parser.add_argument(f"--{one.key}", choices=one.choices or None, help=one.about.replace("%", "%%"))
