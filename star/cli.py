"""The command `star`: train from a config file, evaluate and see what came out."""

from __future__ import annotations

import argparse
import difflib
import itertools
import json
import re
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import yaml
from rich.console import Console

from envs.common import files, modes, reading
from envs.common.errors import Notice, UserError
from star.agent.sections import Config
from star.config import plugins
from star.config.run import TrainerConfig
from star.config.section import ConfigError
from star.loading import fields, load, parse
from star.stopping import at_once, end, leave
from star.streams import unbroken

if TYPE_CHECKING:
    from star.stretch import Result

_HELP = """\
Train a three-level agent (Commander, Tutor, Controller) whose goal regions refine themselves.

  star train configs/point_maze.yaml            train; the result is in runs/point_maze-<time>/
  star train configs/point_maze.yaml --seeds 5  five seeds side by side
  star train configs/ant_maze.yaml --tutor.reward distance --total-env-steps 5000000
  star train configs/ant_maze.yaml --with configs/agents/hiro.yaml   another agent on the same task
  star train --resume runs/NAME                 go on after an interrupt
  star sweep configs/sweeps/three_values.yaml   try several values and draw what they do
  star evaluate runs/NAME                       success on test goals, with 95 % intervals
  star evaluate runs/A runs/B --checkpoint all  every checkpoint of several runs, and how they compare
  star render point_maze --out maze.png         a picture of a task
  star render --run runs/NAME --out film.html   an episode of a trained agent
  star record runs/NAME --out demos.npz         what a trained agent can show another
  star report runs/A runs/B --out report.html   curves, regions and settings of runs, as one page
  star envs                                     the tasks
  star settings [PREFIX]                        every setting, its default and its meaning
"""

_RENDER = """\
Random actions in TASK, or with --run the greedy policy of a trained agent on test goals.
.png and .jpg hold one picture, the end of the episode; .mp4, .gif and .html the whole of it.
A setting of the task is given as --env.options.KEY VALUE."""
_EVALUATE = """\
Greedy episodes of trained agents on test goals, or on a grid of goals: success, time and way to the goal, with 95 %
intervals; of several runs also how they compare. With --env.name or --env.options.KEY they act in another task than
that of their training. With --goals grid, JSON and figures go to RUN/evaluation unless --out is given."""
_RECORD = """\
Greedy episodes of a trained agent on training goals. Those that reach the goal are written, up to the step that
does, as demonstrations for other agents: routes, states and actions."""
_REPORT = """\
One page with the curves of the runs over each other, how their regions grew, what they are worth to the Commander,
the settings in which the runs differ, and films. It needs no network. A run may still be going on."""
_READ_CONFIGS = ("train", "sweep", "evaluate", "render", "record", "report")
_LONGEST_ERROR = 1000  # characters
_MOST_PROFILED = 20  # epochs; a trace takes tens of MB for each
_SWEEP = """\
Train with many settings that Optuna chooses, side by side where it can be done, and write down which are best.
The same command with --out goes on with a sweep; with --storage it joins it from any number of machines.
Any setting of all trials can be overridden: --section.key VALUE (see `star settings`)."""
_OVERRIDES = "Any setting can be overridden: --section.key VALUE (see `star settings`)."


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{self.prog}: {message} (see {self.prog} --help)")


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
    parser, commands = _parser()
    options, unknown = parser.parse_known_args(words)
    for word in unknown:
        allowed = re.findall(r"--[a-z-]+", commands[options.command].format_help() if options.command else "")
        near = difflib.get_close_matches(word.partition("=")[0].replace("_", "-"), allowed, n=1)
        meant = f" (did you mean {near[0]}?)" if near and word.startswith("-") else ""
        raise ConfigError(f"{word}: unknown argument{meant}; settings are given as --section.key VALUE")
    if options.command is None:
        parser.print_help()
        return 0
    for name in (*getattr(options, "modules", []), *filter(plugins.is_plugin, overrides.values())):
        plugins.trust(name.partition(":")[0])
    flags = {name: _value(text) for name, text in vars(options).items() if "." in name and text is not None}
    return options.function(options, flags | overrides)


def _parser() -> tuple[argparse.ArgumentParser, Mapping[str, argparse.ArgumentParser]]:
    """That of `star`, and those of its commands."""
    shape: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    parser = _Parser(prog="star", description=_HELP, **shape)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    train = commands.add_parser("train", help="train from a config file", description=_OVERRIDES, **shape)
    train.add_argument("config", nargs="?", type=Path, help="YAML file, such as configs/point_maze.yaml")
    train.add_argument(
        "--with", dest="layers", action="append", type=Path, default=[], metavar="FILE", help="YAML laid over CONFIG"
    )
    train.add_argument("--resume", type=Path, metavar="RUN", help="go on with the run in this directory")
    train.add_argument("--run-dir", type=Path, metavar="DIR", help="where to write (default: runs/CONFIG-TIME)")
    train.add_argument("--seed", dest="trainer.seed", metavar="N", help="first seed")
    train.add_argument("--seeds", dest="trainer.num_seeds", metavar="N", help="seeds trained side by side")
    train.add_argument("--total-env-steps", dest="trainer.total_env_steps", metavar="N", help="env steps per seed")
    train.add_argument(
        "--profile",
        nargs="?",
        type=_count(_MOST_PROFILED),
        const=1,
        default=0,
        metavar="EPOCHS",
        help="trace so many epochs after compilation (default: 1) with JAX's profiler, to RUN/profile",
    )
    train.add_argument(
        "--debug", action="store_true", help="stop at the first NaN with a Python traceback, and check shapes; slow"
    )
    train.add_argument(
        "--distributed",
        metavar="auto|HOST:PORT,I,N",
        help="be one of several processes: as SLURM or Open MPI started them, or process I of N that meet at HOST:PORT",
    )
    train.add_argument("--quiet", action="store_true", help="no progress")
    train.set_defaults(function=_train)

    _add_sweep(commands.add_parser("sweep", help="try many settings", description=_SWEEP, **shape))
    _add_evaluate(commands.add_parser("evaluate", help="success of trained agents", description=_EVALUATE, **shape))
    _add_render(commands.add_parser("render", help="pictures of a task or of an agent", description=_RENDER, **shape))
    _add_record(commands.add_parser("record", help="demonstrations by a trained agent", description=_RECORD, **shape))
    _add_report(commands.add_parser("report", help="runs as one HTML page", description=_REPORT, **shape))
    listing = commands.add_parser("envs", help="list the tasks", **shape)
    listing.set_defaults(function=_envs)
    settings = commands.add_parser("settings", help="list every setting with its default and meaning", **shape)
    settings.add_argument("prefix", nargs="?", default="", help="only settings that begin so, such as tutor")
    settings.set_defaults(function=_settings)
    for name in _READ_CONFIGS:
        commands.choices[name].add_argument(
            "--import",
            dest="modules",
            action="append",
            default=[],
            metavar="MODULE",
            help="a module of your own that a config or a run names, as in learner: MODULE:NAME",
        )
    return parser, commands.choices


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    evaluate.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run, or one RUN/checkpoints/STEPS of it")
    evaluate.add_argument(
        "--checkpoint", default="last", metavar="last|best|all|STEPS", help="which ones of each RUN (default: last)"
    )
    evaluate.add_argument("--episodes", dest="trainer.eval_episodes", metavar="N", help="episodes per seed")
    evaluate.add_argument("--evaluation-seed", type=_natural, default=0, metavar="N", help="seed of goals and starts")
    _add_goals(evaluate)
    evaluate.add_argument(
        "--group", action="append", default=[], metavar="NAME=RUN,RUN", help="runs to be compared as one with others"
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON, a line for each checkpoint")
    evaluate.add_argument("--out", type=Path, metavar="DIR", help="write JSON and figures there")
    evaluate.add_argument("--force", action="store_true", help="replace an evaluation that is there already")
    evaluate.add_argument("--quiet", action="store_true", help="no progress")
    evaluate.set_defaults(function=_evaluate)


def _add_goals(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--goals", choices=("test", "grid"), default="test", help="of the task (default), or a grid over the maze"
    )
    command.add_argument("--grid", type=_count(64), metavar="N", help="the grid has N x N cells (default: 8)")


def _add_sweep(sweep: argparse.ArgumentParser) -> None:
    sweep.add_argument("file", type=Path, help="YAML file, such as configs/sweeps/point_maze.yaml")
    sweep.add_argument("--trials", type=_count(), metavar="N", help="trials of the study in all (default: of the file)")
    sweep.add_argument("--batch", type=_count(), metavar="N", help="trials side by side at most (default: of the file)")
    sweep.add_argument(
        "--storage",
        metavar="URL",
        help="postgresql://USER@HOST/DATABASE (default: sweep.db in the folder of the sweep)",
    )
    sweep.add_argument("--study", metavar="NAME", help="name in the database (default: that of the file)")
    sweep.add_argument(
        "--out", type=Path, metavar="DIR", help="where to write, or what to go on with (default: sweeps/NAME-TIME)"
    )
    sweep.add_argument("--quiet", action="store_true", help="no progress")
    sweep.set_defaults(function=_sweep)


def _add_render(render: argparse.ArgumentParser) -> None:
    render.add_argument("task", nargs="?", help="one of `star envs`; with --run its own task")
    render.add_argument("--out", type=Path, required=True, metavar="FILE", help=".png, .jpg, .mp4, .gif or .html")
    render.add_argument("--run", type=Path, metavar="RUN", help="show the agent in this run directory")
    render.add_argument("--checkpoint", metavar="last|best|STEPS", help="which one of the run (default: last)")
    render.add_argument("--seed", type=_natural, metavar="N", help="which agent of the run (default: its first seed)")
    render.add_argument(
        "--evaluation-seed", type=_natural, default=0, metavar="N", help="seed of goals, starts and random actions"
    )
    render.add_argument(
        "--envs", type=_count(25), default=1, metavar="N", help="environments side by side (default: 1)"
    )
    render.add_argument("--episode", type=_natural, metavar="K", help="show episode K of `star evaluate` of the run")
    render.add_argument("--episodes", dest="trainer.eval_episodes", metavar="N", help="that evaluation's --episodes")
    _add_goals(render)
    render.add_argument("--steps", type=_natural, metavar="N", help="env steps (default: the whole episode)")
    render.add_argument("--every", type=_count(), default=2, metavar="N", help="draw every Nth env step (default: 2)")
    render.add_argument("--fps", type=_count(50), default=20, metavar="N", help="pictures a second (default: 20)")
    render.add_argument(
        "--camera", choices=("follow", "overview", "top"), help="default: overview in a still, follow in a film"
    )
    render.add_argument("--height", type=_count(1080), metavar="PX", help="of the picture of one environment")
    render.add_argument("--force", action="store_true", help="replace an existing file")
    render.add_argument("--quiet", action="store_true", help="no progress")
    render.set_defaults(function=_render)


def _add_record(record: argparse.ArgumentParser) -> None:
    record.add_argument("run", type=Path, help="run directory")
    record.add_argument("--out", type=Path, required=True, metavar="FILE", help=".npz")
    record.add_argument("--episodes", type=_count(10_000), default=100, metavar="N", help="to play (default: 100)")
    record.add_argument("--checkpoint", default="last", metavar="last|best|STEPS", help="which one (default: last)")
    record.add_argument("--seed", type=_natural, metavar="N", help="which agent of the run (default: its first seed)")
    record.add_argument("--evaluation-seed", type=_natural, default=0, metavar="N", help="seed of goals and starts")
    record.add_argument("--force", action="store_true", help="replace an existing file")
    record.add_argument("--quiet", action="store_true", help="no progress")
    record.set_defaults(function=_record)


def _add_report(report: argparse.ArgumentParser) -> None:
    report.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="run directory")
    report.add_argument(
        "--group",
        action="append",
        default=[],
        metavar="NAME=RUN,RUN",
        help="runs that differ in their seeds alone, to be shown as one",
    )
    report.add_argument("--out", type=Path, required=True, metavar="FILE", help=".html")
    report.add_argument("--force", action="store_true", help="replace an existing file")
    report.set_defaults(function=_report)


def split_settings(arguments: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """Take the dotted settings `--section.key VALUE` or `--section.key=VALUE` out of `arguments`.

    Returns the other words, and the settings; raises `UserError` for a setting without a value.
    """
    words: list[str] = []
    found: dict[str, Any] = {}
    waiting = list(arguments)
    while waiting:
        word = waiting.pop(0)
        name, equals, value = word.removeprefix("--").partition("=")
        if not word.startswith("--") or "." not in name:
            words.append(word)
            continue
        if not equals:
            if not waiting or waiting[0].startswith("--"):
                raise ConfigError(f"{word}: needs a value")
            value = waiting.pop(0)
        found[name] = _value(value)
    return words, found


def _value(text: str) -> Any:
    """Numbers, lists and the like as YAML reads them; what is no more than text stays as it was typed."""
    try:
        value = reading.plain(text)
    except yaml.YAMLError:
        return text
    return text if isinstance(value, str) and "\n" in text else value  # YAML would fold the lines of a map


def _new(folder: Path, name: str) -> Path:
    """A new place in `folder`, named after the time. It is made at once, so that no other command takes it."""
    first = folder / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    places = itertools.chain([first], (first.with_name(f"{first.name}-{number}") for number in itertools.count(2)))
    for place in places:
        try:
            files.check_name(place)
            place.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigError(f"{place}: cannot be written: {error.strerror}") from None
        return place
    raise AssertionError


@contextmanager
def _given_back(place: Path) -> Iterator[None]:
    """If what is done here is refused, remove the new `place` for it, and the folder around, as far as empty."""
    try:
        yield
    except UserError:
        with suppress(OSError):
            place.rmdir()
            place.parent.rmdir()
        raise


def _natural(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 2^31 - 1")
    return int(text)


def _count(most: int = 2**31 - 1) -> Callable[[str], int]:
    def read(text: str) -> int:
        if not text.isdecimal() or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return read


def _train(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    if (options.config is None) == (options.resume is None):
        raise ConfigError("star train: give either a config file or --resume RUN (see star train --help)")
    if options.resume is not None:
        if options.run_dir is not None:
            raise ConfigError("--run-dir: a resumed run stays where it is")
        if options.layers:
            raise ConfigError("--with: a resumed run keeps its config file")
        config = _run_config(options.resume, overrides)
    else:
        config = load(options.config, overrides, layers=options.layers)

    if options.debug:
        from star import debugging

        debugging.turn_on()

    from star import devices, trainer

    if options.distributed is not None:
        if options.resume is None and options.run_dir is None:
            raise ConfigError("--distributed: needs --run-dir, the same for all processes")
        devices.join(options.distributed)
    name = "-".join(file.stem for file in (options.config, *options.layers) if file)
    run_dir = options.resume or options.run_dir or _new(Path("runs"), name)
    with _given_back(run_dir):
        result = trainer.train(
            config, run_dir, resume=options.resume is not None, quiet=options.quiet, profile=options.profile
        )
    if devices.first():
        _say_how_it_ended(result, config.trainer)
    if result.fault is not None:
        return 3
    return 130 if result.interrupted and not result.terminated else 0


def _say_how_it_ended(result: Result, config: TrainerConfig) -> None:
    run_dir = result.run_dir
    if result.fault is not None:
        print(f"stopped: {result.fault}; {_after_a_fault(result, config)}", file=sys.stderr)
        return
    if result.interrupted:
        print(f"interrupted at {result.env_steps:,} env steps; go on with: star train --resume {_typed(run_dir)}")
        return
    success = "" if result.success_final is None else f", success_final {result.success_final:.2f} on test goals"
    print(f"trained {result.env_steps:,} env steps{success}")
    print(f"figure:  {run_dir}/figures/summary.png\nmetrics: {run_dir}/metrics.jsonl")
    print(f"next:    star evaluate {_typed(run_dir)}")


def _typed(path: Path) -> str:
    """A path as one types it in a shell."""
    return shlex.quote(str(path))


def _after_a_fault(result: Result, config: TrainerConfig) -> str:
    """What is left of a run whose numbers were not finite, and how to go on."""
    flags = "--trainer.on_non_finite rollback"
    if config.on_non_finite == "rollback":
        flags += f" --trainer.rollbacks {2 * config.rollbacks}"
    if result.saved is None:
        return f"there is no checkpoint from before; begin anew with {flags}"
    return (
        f"the checkpoint of {result.saved:,} env steps is sound; "
        f"go on with: star train --resume {_typed(result.run_dir)} {flags}"
    )


def _sweep(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    from star import sweep, sweep_report

    given = {"trials": options.trials, "batch": options.batch, "study": options.study}
    found = sweep.plan(options.file, settings=overrides, **{key: x for key, x in given.items() if x is not None})
    # workers of one study find the same folder
    folder = Path("sweeps")
    out = options.out or (folder / found.name if options.storage else _new(folder, options.file.stem))
    with _given_back(out):
        summary = sweep.run(found, out, storage=options.storage, quiet=options.quiet)
    Console().print(sweep_report.table(summary.rows, parameters=list(found.distributions), objective=found.objective))
    if not summary.finished:
        again = ["sweep", str(options.file), *(["--storage", "URL"] if options.storage else []), "--out", str(out)]
        print(f"interrupted; running trials were given back; go on with: star {shlex.join(again)}")
        return 130
    print(f"trials:  {out}/trials.csv")
    if summary.best is None:
        print("no trial was completed")
        return 1
    print(f"figures: {out}/figures/\nbest:    trial {summary.best['trial']}")
    print(f"next:    star train {_typed(out / 'best.yaml')}")
    return 0


def _evaluate(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    task, others = _split_task(overrides)
    chosen, groups = _chosen(options)
    if not chosen:
        raise ConfigError("star evaluate: give a RUN, or --group NAME=RUN,RUN (see star evaluate --help)")
    configs = {run: _agent_config(run, others) for run, _ in chosen}
    out = options.out or (chosen[0][0] / "evaluation" if options.goals == "grid" else None)

    from star import assessment

    exam = assessment.Exam(grid=_grid(options), seed=options.evaluation_seed, task=task)
    assessment.check_groups(groups, configs)
    if out is not None:
        assessment.check_place(out, force=options.force)
    targets = [assessment.Target(run, checkpoint, configs[run]) for run, checkpoint in chosen]
    rows = assessment.evaluate(targets, exam, quiet=options.quiet)
    comparison = assessment.compare(rows, groups) if options.group or len(groups) > 1 else None
    written = assessment.write(out, rows, comparison) if out is not None else []
    if options.json:
        for line in [*rows, *([comparison] if comparison else [])]:
            print(json.dumps(line))
        return 0

    from star import tables

    tables.show(rows, comparison, again=_again(options, overrides))
    for path in written:
        print(path)
    return 0


def _chosen(options: argparse.Namespace) -> tuple[list[tuple[Path, str]], dict[str, list[Path]]]:
    """The (run, checkpoint) to evaluate, and the groups of runs: those given, then each other run by itself."""
    names: dict[Path, Path] = {}
    chosen: list[tuple[Path, str]] = []

    def add(path: Path) -> Path:
        run, checkpoint = _run_and_checkpoint(path, options.checkpoint)
        run = names.setdefault(run.resolve(), run)
        chosen.append((run, checkpoint))
        return run

    single = list(dict.fromkeys(add(path) for path in options.runs))
    groups = {name: list(dict.fromkeys(map(add, runs))) for name, runs in _groups(options.group).items()}
    for name, other in itertools.combinations(groups, 2):
        for run in groups[name]:
            if run in groups[other]:
                raise ConfigError(f"--group: {run} is both in {name} and in {other}")
    grouped = {run for runs in groups.values() for run in runs}
    for run in single:
        if run not in grouped:
            groups[str(run)] = [run]
    return chosen, groups


def _groups(texts: Sequence[str]) -> dict[str, list[Path]]:
    """The runs of each NAME=RUN,RUN."""
    groups: dict[str, list[Path]] = {}
    for text in texts:
        name, equals, runs = text.partition("=")
        if not (name and equals and all(runs.split(","))):
            raise ConfigError(f"--group: {text!r} is not of the form NAME=RUN,RUN")
        if name in groups:
            raise ConfigError(f"--group: {name} is given twice")
        groups[name] = [Path(run) for run in runs.split(",")]
    return groups


def _run_and_checkpoint(path: Path, wanted: str) -> tuple[Path, str]:
    """(RUN, STEPS) of a path RUN/checkpoints/STEPS, else the path as a run and what is wanted of it."""
    if path.parent.name == "checkpoints" and path.name.isdecimal():
        return path.parent.parent, path.name
    return path, wanted


def _grid(options: argparse.Namespace) -> int | None:
    if options.goals == "test" and options.grid is not None:
        raise ConfigError("--grid: needs --goals grid")
    return (options.grid or 8) if options.goals == "grid" else None


def _split_task(overrides: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings that send an agent to another task than its own, and the others."""
    task = {k: v for k, v in overrides.items() if k == "env.name" or k.split(".")[:2] == ["env", "options"]}
    return task, {k: v for k, v in overrides.items() if k not in task}


def _again(options: argparse.Namespace, overrides: dict[str, Any]) -> str:
    """The arguments with which `star render --episode` shows an episode of this evaluation."""
    words = []
    if options.evaluation_seed:
        words += ["--evaluation-seed", str(options.evaluation_seed)]
    if options.goals == "grid":
        words += ["--goals", "grid", "--grid", str(_grid(options))]
    for key, value in overrides.items():
        name = "--episodes" if key == "trainer.eval_episodes" else f"--{key}"
        words += [name, value if isinstance(value, str) else json.dumps(value)]
    return shlex.join(words)


def _render(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    if options.run is None:
        if options.task is None:
            raise ConfigError("star render: give a task, or --run RUN (see star render --help)")
        for flag in ("checkpoint", "seed", "episode", "grid"):
            if getattr(options, flag) is not None:
                raise ConfigError(f"--{flag}: needs --run; random actions are chosen by --evaluation-seed")
        for key in overrides:
            if not key.startswith("env.") and key != "trainer.device":
                raise ConfigError(f"--{key}: random actions take only env settings and trainer.device")
        if options.goals == "grid":
            raise ConfigError("--goals: grid needs --run; random actions take --env.options.goals")
        task: dict[str, Any] = {}
        config = parse({}, overrides | {"env.name": options.task})
    else:
        if options.episode is not None and options.envs > 1:
            raise ConfigError("--episode: shows one environment, so --envs cannot be more")
        if options.episode is None and (options.goals == "grid" or "trainer.eval_episodes" in overrides):
            raise ConfigError("--goals and --episodes: need --episode K, they say of which evaluation")
        task, others = _split_task(overrides)
        config = _agent_config(options.run, others)
        if options.task not in (None, config.env.name):
            raise ConfigError(f"{options.run}: its agent was trained on {config.env.name}, not on {options.task}")
    _check_output(options)

    from star import assessment, rendering

    show = rendering.Show(
        out=options.out,
        envs=options.envs,
        steps=options.steps,
        every=options.every,
        fps=options.fps,
        camera=options.camera,
        height=options.height,
    )
    print(
        rendering.render(
            config,
            show,
            run_dir=options.run,
            checkpoint=options.checkpoint or "last",
            agent=options.seed,
            exam=assessment.Exam(grid=_grid(options), seed=options.evaluation_seed, task=task),
            episode=options.episode,
            quiet=options.quiet,
        )
    )
    return 0


def _check_output(options: argparse.Namespace) -> None:
    """Refuse a file that cannot be written, or a machine that cannot draw, before anything heavy is imported."""
    from envs import opengl, video

    video.check(options.out, force=options.force)
    opengl.backend()


def _record(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    config = _agent_config(options.run, overrides)

    from star import record

    print(
        record.record(
            config,
            options.run,
            options.out,
            episodes=options.episodes,
            checkpoint=options.checkpoint,
            agent=options.seed,
            seed=options.evaluation_seed,
            force=options.force,
            quiet=options.quiet,
        )
    )
    return 0


def _report(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    _refuse(overrides)
    from envs.common import files

    files.check(options.out, (".html",), force=options.force)
    groups = _groups(options.group)
    chosen = [run for members in groups.values() for run in members] + options.runs
    if not chosen:
        raise ConfigError("star report: give a RUN, or --group NAME=RUN,RUN (see star report --help)")
    runs: dict[Path, Config] = {}
    for run in chosen:
        if run.resolve() in {other.resolve() for other in runs}:
            raise ConfigError(f"{run}: is given twice")
        runs[run] = _run_config(run, {})

    from star import page

    print(page.write(runs, options.out, groups=groups))
    return 0


def _envs(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    import envs

    _refuse(overrides)
    print("\n".join(envs.names()))
    return 0


def _settings(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    _refuse(overrides)
    rows = [row for row in fields() if row[0].startswith(options.prefix)]
    if not rows:
        raise ConfigError(f"{options.prefix}: no setting begins so; sections are {', '.join(Config.model_fields)}")
    width = max(len(key) for key, _, _ in rows)
    for key, default, description in rows:
        print(f"{key:{width}}  {description} (default {json.dumps(default)})")
    return 0


def _refuse(overrides: dict[str, Any]) -> None:
    for key in overrides:
        raise ConfigError(f"--{key}: this command takes no settings")


def _agent_config(run_dir: Path, overrides: dict[str, Any]) -> Config:
    """That of a run, to act on this machine, whatever it was trained on."""
    return _run_config(run_dir, {"env.engine": "auto", "trainer.devices": 1} | overrides)


def _run_config(run_dir: Path, overrides: dict[str, Any]) -> Config:
    path = run_dir / "config.yaml"
    try:
        if not run_dir.exists():
            raise ConfigError(f"{run_dir}: is not a run directory, there is nothing of this name")
        if not path.is_file():
            raise ConfigError(f"{run_dir}: is not a run directory, it holds no config.yaml")
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be read: {error.strerror}") from None
    return load(path, overrides)


if __name__ == "__main__":
    sys.exit(main())
