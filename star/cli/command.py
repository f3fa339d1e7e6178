"""The command `star`: train from a config file, evaluate and see what came out."""

from __future__ import annotations

import argparse
import difflib
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NoReturn

from envs.common import modes, plugins
from envs.common.errors import Notice, UserError, shown
from star import __version__
from star.cli import (
    completion,
    configs,
    envs,
    evaluate,
    ls,
    record,
    render,
    report,
    settings,
    sweep,
    train,
    tutor,
    watch,
)
from star.cli.streams import unbroken
from star.cli.words import split_settings, value
from star.config.section import ConfigError
from star.training.signals import at_once, end, leave

COMMANDS: Mapping[str, ModuleType] = {
    "train": train,
    "sweep": sweep,
    "ls": ls,
    "evaluate": evaluate,
    "render": render,
    "record": record,
    "report": report,
    "watch": watch,
    "tutor": tutor,
    "configs": configs,
    "envs": envs,
    "settings": settings,
    "completion": completion,
}
"""Each has `HELP`, `DESCRIPTION`, `add(parser)` and `run(options, overrides)`, which returns the exit code."""

_WITHOUT_SETTINGS = ("ls", "report", "watch", "configs", "envs", "settings", "completion")

_HELP = """\
Train a three-level agent (Commander, Tutor, Controller) whose goal regions refine themselves.

  star train configs/point_maze.yaml            train; the result is in runs/point_maze-<time>/
  star train configs/point_maze.yaml --seeds 5  five seeds side by side
  star train configs/ant_maze.yaml --tutor.reward distance --total-env-steps 5000000
  star train configs/ant_maze.yaml --with configs/agents/hiro.yaml   another agent on the same task
  star train --resume runs/NAME                 go on after an interrupt
  star sweep configs/sweeps/three_values.yaml   try several values and draw what they do
  star ls                                       the runs so far
  star evaluate runs/NAME                       success on test goals, with 95 % intervals
  star evaluate runs/A runs/B --checkpoint all  every checkpoint of several runs, and how they compare
  star render point_maze --out maze.png         a picture of a task
  star render --run runs/NAME --out film.html   an episode of a trained agent
  star record runs/NAME --out demos.npz         what a trained agent can show another
  star report runs/A runs/B --out report.html   curves, regions and settings of runs, as one page
  star watch runs/NAME                          the same page in the browser, while the run trains
  star tutor discover scores.csv skills.csv     prerequisites of skills, found from scores of students
  star configs                                  the configs that come with STAR
  star train saht/sgim_pb                       learners of skills, who ask teachers
  star envs                                     the tasks and worlds
  star settings [WORD]                          every setting: meaning, range, unit and default
  star completion bash                          completion with the Tab key
"""
_LONGEST_ERROR = 1000  # characters


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        wrong = re.match(r"argument COMMAND: invalid choice: '(.*?)'", message)
        if wrong:
            near = difflib.get_close_matches(wrong[1], COMMANDS, n=1)
            meant = f"did you mean star {near[0]}?" if near else f"allowed: {', '.join(COMMANDS)}"
            raise ConfigError(f"star: {wrong[1]!r} is no command ({meant})")
        choice = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        near = difflib.get_close_matches(choice[1], re.findall(r"[\w-]+", choice[2]), n=1) if choice else []
        meant = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(f"{self.prog}: {message} ({meant}see {self.prog} --help)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code.

    0: done, or stopped by SIGTERM with a checkpoint. 2: bad input, or a file that cannot be read or written.
    3: numbers that are not finite. 130: interrupted.
    """
    ours = arguments is None  # the process is this command's
    if ours:
        signal.signal(signal.SIGINT, at_once)
    with unbroken() as out:
        code = _guarded(sys.argv[1:] if ours else list(arguments or []), ours=ours)
        if out is not None:
            out.flush()
            if out.error is not None and not isinstance(out.error, BrokenPipeError):  # who reads no more wants no more
                print(f"error: standard output cannot be written: {out.error.strerror}", file=sys.stderr)
                code = code or 2
    return leave(code)


def _guarded(arguments: list[str], *, ours: bool) -> int:
    """Run the command; what is wrong is said in one line."""
    try:
        with _notices():
            return _run(arguments)
    except UserError as error:
        print(f"error: {_on_one_line(str(error))}", file=sys.stderr)
        return 2
    except (RuntimeError, AssertionError):
        line = modes.missing_device()
        if line is None:
            raise
        print(f"error: {line}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        if ours:
            end(130)
        return 130


@contextmanager
def _notices() -> Iterator[None]:
    """Print every `Notice` in one line, and once; other warnings as ever."""
    told: set[str] = set()

    def show(message: Warning | str, *where: Any, **more: Any) -> None:
        if not isinstance(message, Notice):
            usual(message, *where, **more)
        elif str(message) not in told:
            told.add(str(message))
            print(f"note: {_on_one_line(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        usual, warnings.showwarning = warnings.showwarning, show
        yield


def _on_one_line(message: str) -> str:
    """Keys and names may hold anything: what a terminal would not print as it is, is written out."""
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in message[:_LONGEST_ERROR])
    return shown + "..." * (len(message) > _LONGEST_ERROR)


def _run(arguments: list[str]) -> int:
    words, overrides = split_settings(arguments)
    parser, commands = parsers()
    options, unknown = parser.parse_known_args(words)
    for word in unknown:
        asked = commands[options.command] if options.command else parser
        allowed = re.findall(r"--[a-z-]+", asked.format_help())
        near = difflib.get_close_matches(word.partition("=")[0].replace("_", "-"), allowed, n=1)
        meant = f" (did you mean {near[0]}?)" if near and word.startswith("-") else ""
        how = "" if options.command in (None, *_WITHOUT_SETTINGS) else "; settings are given as --section.key VALUE"
        raise ConfigError(f"{word}: unknown argument{meant}{how}")
    if options.command is None:
        parser.print_help()
        return 0
    if getattr(options, "experiment", None) is not None:
        overrides["experiment"] = options.experiment
    for module in getattr(options, "modules", []):
        plugins.check_there(module)
    typed = (*overrides.values(), getattr(options, "task", None))
    for name in (*getattr(options, "modules", []), *filter(plugins.is_plugin, typed)):
        plugins.trust(name.partition(":")[0])
    flags = {name: value(text) for name, text in vars(options).items() if "." in name and text is not None}
    for key in flags.keys() & overrides.keys():
        if flags[key] != overrides[key]:
            raise ConfigError(f"{key}: is given twice, as {shown(overrides[key])} and {shown(flags[key])}")
    return options.function(options, flags | overrides)


def parsers() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """That of `star`, and those of its commands."""
    shape: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    parser = _Parser(prog="star", description=_HELP, **shape)
    parser.add_argument("--version", action="version", version=f"star {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)
    for name, command in COMMANDS.items():
        one = commands.add_parser(name, help=command.HELP, description=command.DESCRIPTION, **shape)
        command.add(one)
        one.set_defaults(function=command.run)
        if name not in ("configs", "envs", "completion"):
            one.add_argument(
                "--import",
                dest="modules",
                action="append",
                default=[],
                metavar="MODULE",
                help="a module of your own that a config or a run names, as in learner: MODULE:NAME",
            )
    return parser, commands.choices
