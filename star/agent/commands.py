"""STAR's own commands: evaluations of many kinds, pictures, demonstrations and the list of tasks."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from star.config import agents
from star.config.loading import load_to_act, parse
from star.config.section import ConfigError


def evaluate(
    chosen: Sequence[tuple[Path, str]],
    groups: Mapping[str, Sequence[Path]],
    options: argparse.Namespace,
    overrides: dict[str, Any],
) -> int:
    """Evaluate checkpoints (run, which one) on test goals, a grid of goals or another task, and compare groups."""
    task, others = _split_task(overrides)
    configs = {run: load_to_act(run, others) for run, _ in chosen}
    out = options.out or (_own_place(chosen[0][0]) if options.goals == "grid" else None)

    from star.agent import exam_results, exam_tables, exams  # after what can be refused at once

    exam = exams.Exam(**_goals(options), seed=options.evaluation_seed, task=task)
    exam_results.check_groups(groups, configs)
    if out is not None:
        exam_results.check_place(out, force=options.force)
    targets = [exams.Target(run, checkpoint, configs[run]) for run, checkpoint in chosen]
    rows = exams.evaluate(targets, exam, quiet=options.quiet)
    comparison = exam_results.compare(rows, groups) if options.group or len(groups) > 1 else None
    written = exam_results.write(out, rows, comparison) if out is not None else []
    if options.json:
        for line in [*rows, *([comparison] if comparison else [])]:
            print(json.dumps(line))
        return 0

    exam_tables.show(rows, comparison, again=_again(options, overrides))
    for path in written:
        print(path)
    return 0


def _own_place(run_dir: Path) -> Path:
    """The folder of a run for an evaluation of its agent."""
    if agents.is_unpacked(run_dir):
        name = agents.told(run_dir)
        raise ConfigError(f"--goals: grid writes files, and {name} has no folder for them; add --out DIR")
    return run_dir / "evaluation"


def measure(run_dir: Path, overrides: Mapping[str, Any], *, checkpoint: str, seed: int) -> list[dict[str, Any]]:
    """A row of plain values for each checkpoint, as `star evaluate --json` prints it; raises `UserError`."""
    task, others = _split_task(overrides)
    config = load_to_act(run_dir, others)

    from star.agent import exams

    return exams.evaluate([exams.Target(run_dir, checkpoint, config)], exams.Exam(seed=seed, task=task))


def _goals(options: argparse.Namespace) -> dict[str, Any]:
    """The goals, as an `Exam` has them."""
    if options.goals != "grid" and options.grid is not None:
        raise ConfigError("--grid: needs --goals grid")
    return {"grid": (options.grid or 8) if options.goals == "grid" else None, "training": options.goals == "train"}


def _split_task(overrides: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The settings that send an agent to another task than its own, and the others."""
    task = {k: v for k, v in overrides.items() if k == "env.name" or k.split(".")[:2] == ["env", "options"]}
    return task, {k: v for k, v in overrides.items() if k not in task}


def _again(options: argparse.Namespace, overrides: dict[str, Any]) -> list[str]:
    """The arguments with which `star render --episode` shows an episode of this evaluation."""
    words = []
    if options.evaluation_seed:
        words += ["--evaluation-seed", str(options.evaluation_seed)]
    if options.goals != "test":
        words += ["--goals", options.goals]
    if options.goals == "grid":
        words += ["--grid", str(_goals(options)["grid"])]
    for key, value in overrides.items():
        name = "--episodes" if key == "trainer.eval_episodes" else f"--{key}"
        words += [name, value if isinstance(value, str) else json.dumps(value)]
    return words


def render(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Draw an episode of a trained agent, or of random actions in a task."""
    if options.run is None:
        if options.task is None:
            raise ConfigError("star render: give a task, or --run RUN (see star render --help)")
        for flag in ("checkpoint", "seed", "episode", "grid"):
            if getattr(options, flag) is not None:
                raise ConfigError(f"--{flag}: needs --run; random actions are chosen by --evaluation-seed")
        for key in overrides:
            if not key.startswith("env.") and key != "trainer.device":
                raise ConfigError(f"--{key}: random actions take only env settings and trainer.device")
        if options.goals != "test":
            raise ConfigError(f"--goals: {options.goals} needs --run; random actions take --env.options.goals")
        task: dict[str, Any] = {}
        config = parse({}, overrides | {"env.name": options.task})
    else:
        if options.episode is not None and options.envs > 1:
            raise ConfigError("--episode: shows one environment, so --envs cannot be more")
        if options.episode is None and (options.goals != "test" or "trainer.eval_episodes" in overrides):
            raise ConfigError("--goals and --episodes: need --episode K, they say of which evaluation")
        task, others = _split_task(overrides)
        config = load_to_act(options.run, others)
        if options.task not in (None, config.env.name):
            raise ConfigError(
                f"{agents.told(options.run)}: its agent was trained on {config.env.name}, not on {options.task}"
            )
    check_output(options.out, force=options.force)

    from star.agent import exams, films

    show = films.Show(
        out=options.out,
        envs=options.envs,
        steps=options.steps,
        every=options.every,
        fps=options.fps,
        camera=options.camera,
        height=options.height,
    )
    print(
        films.render(
            config,
            show,
            run_dir=options.run,
            checkpoint=options.checkpoint or "last",
            agent=options.seed,
            exam=exams.Exam(**_goals(options), seed=options.evaluation_seed, task=task),
            episode=options.episode,
            quiet=options.quiet,
        )
    )
    return 0


def check_output(out: Path, *, force: bool) -> None:
    """Refuse a picture that cannot be written, or a machine that cannot draw, before anything heavy is imported."""
    from envs import opengl, video

    video.check(out, force=force)
    opengl.backend()


def record(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Write demonstrations of a trained agent."""
    config = load_to_act(options.run, overrides)

    from star.agent import demonstrations

    print(
        demonstrations.record(
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


def envs() -> list[str]:
    """The tasks."""
    from envs import names

    return list(names())
