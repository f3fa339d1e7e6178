"""`star train`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs.common.files import given_back, new_place
from star.cli.words import count
from star.config import command_line, kinds
from star.config.loading import load, load_run, parse
from star.config.run import RunConfig
from star.config.section import ConfigError

if TYPE_CHECKING:
    from star.training.loop import Result

HELP = "train from a config file"
DESCRIPTION = "Any setting can be overridden: --section.key VALUE (see `star settings`)."
_MOST_PROFILED = 20  # epochs; a trace takes tens of MB for each


def add(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("config", nargs="?", type=Path, help="YAML file, such as configs/point_maze.yaml")
    parser.add_argument(
        "--with", dest="layers", action="append", type=Path, default=[], metavar="FILE", help="YAML laid over CONFIG"
    )
    parser.add_argument("--resume", type=Path, metavar="RUN", help="go on with the run in this directory")
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="where to write (default: runs/CONFIG-TIME)")
    parser.add_argument("--seed", dest="trainer.seed", metavar="N", help="first seed")
    parser.add_argument("--seeds", dest="trainer.num_seeds", metavar="N", help="seeds trained side by side")
    parser.add_argument("--total-env-steps", dest="trainer.total_env_steps", metavar="N", help="env steps per seed")
    parser.add_argument(
        "--profile",
        nargs="?",
        type=count(_MOST_PROFILED),
        const=1,
        default=0,
        metavar="EPOCHS",
        help="trace so many epochs after compilation (default: 1) with JAX's profiler, to RUN/profile",
    )
    parser.add_argument(
        "--debug", action="store_true", help="stop at the first NaN with a Python traceback, and check shapes; slow"
    )
    parser.add_argument(
        "--distributed",
        metavar="auto|HOST:PORT,I,N",
        help="be one of several processes: as SLURM or Open MPI started them, or process I of N that meet at HOST:PORT",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    for sink, where in (("tensorboard", "as TensorBoard's events in the run directory"), ("wandb", "to W&B")):
        parser.add_argument(
            f"--{sink}", dest="sinks", action="append_const", const=sink, default=[], help=f"write metrics {where} too"
        )
    parser.add_argument(
        "--dry-run", action="store_true", help="show settings, memory and what would be written; write nothing"
    )
    parser.add_argument("--experiment", metavar="NAME", help="what learns: star, saht, tutoring, chime, or MODULE:NAME")


def run(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Train, or go on with a run."""
    if (options.config is None) == (options.resume is None):
        raise ConfigError("star train: give either a config file or --resume RUN (see star train --help)")
    if options.resume is not None:
        if options.run_dir is not None:
            raise ConfigError("--run-dir: a resumed run stays where it is")
        if options.layers:
            raise ConfigError("--with: a resumed run keeps its config file")
        config = load_run(options.resume, overrides)
    else:
        config = load(options.config, overrides, layers=options.layers)
    if options.sinks:
        sinks = list(dict.fromkeys([*config.trainer.sinks, *options.sinks]))
        config = parse(config.model_dump(mode="json"), {"trainer.sinks": sinks})

    if options.debug:
        from star import debugging

        debugging.turn_on()

    from star import devices
    from star.training import trainer

    if options.distributed is not None:
        if options.resume is None and options.run_dir is None:
            raise ConfigError("--distributed: needs --run-dir, the same for all processes")
        devices.join(options.distributed)
    name = "-".join(file.stem for file in (options.config, *options.layers) if file)
    if options.dry_run:
        from star.training import dry_run

        print(dry_run.told(config, options.resume or options.run_dir or Path("runs") / f"{name}-<time>"))
        return 0
    run_dir = options.resume or options.run_dir or new_place(Path("runs"), name)
    with given_back(run_dir):
        result = trainer.train(
            config, run_dir, resume=options.resume is not None, quiet=options.quiet, profile=options.profile
        )
    if devices.first():
        _say_how_it_ended(result, config)
    if result.fault is not None:
        return 3
    return 130 if result.interrupted and not result.terminated else 0


def _say_how_it_ended(result: Result, config: RunConfig) -> None:
    run_dir, kind = result.run_dir, kinds.of(config)
    if result.fault is not None:
        print(f"stopped: {result.fault}; {_after_a_fault(result, config)}", file=sys.stderr)
        return
    if result.interrupted:
        again = command_line.of("train", "--resume", run_dir)
        print(f"interrupted at {result.env_steps:,} {kind.unit}; go on with: {again}")
        return
    if result.env_steps == result.began:
        print(f"{run_dir}: already at {result.env_steps:,} {kind.unit}; nothing to do")
        return
    measure = kind.measures[0]
    score = "" if result.score is None else f", {measure.name} {result.score:.2f} {measure.where}".rstrip()
    print(f"trained {result.env_steps:,} {kind.unit}{score}")
    print(f"figure:  {run_dir}/figures/summary.png\nmetrics: {run_dir}/metrics.jsonl")
    print(f"next:    {command_line.of('evaluate', run_dir)}")


def _after_a_fault(result: Result, config: RunConfig) -> str:
    """The remains of a run whose numbers were not finite, and the way on."""
    flags = ["--trainer.on_non_finite", "rollback"]
    if config.trainer.on_non_finite == "rollback":
        flags += ["--trainer.rollbacks", str(2 * config.trainer.rollbacks)]
    if result.saved is None:
        return f"there is no checkpoint from before; begin anew with {' '.join(flags)}"
    return (
        f"the checkpoint of {result.saved:,} {kinds.of(config).unit} is sound; "
        f"go on with: {command_line.of('train', '--resume', result.run_dir, *flags)}"
    )
