"""SGIM-SAHT's own commands: pictures of worlds and of learners in them, demonstrations, the list of worlds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import video, worlds
from envs.common import files, modes
from envs.common.errors import shown
from envs.options import known
from envs.worlds import World, draw
from star.config.loading import load_to_act, parse
from star.config.section import ConfigError
from star.saht import evaluation, teachers
from star.saht.experiment import Saht
from star.saht.memory import FAR, Memory, Scale
from star.saht.teachers import Demonstrations
from star.training.checkpoint import load_agent

_OF_EPISODES = {"envs": 1, "steps": None, "camera": None, "goals": "test", "grid": None}
"""Flags of `star render` for tasks of STAR alone, with their defaults."""


def envs() -> list[str]:
    """The worlds."""
    return list(worlds.names())


def render(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Draw how a learner reaches a goal of the evaluation, or what the teacher of a world shows for it."""
    check_flags(options)
    if options.run is None:
        world = Saht(parse({"experiment": "saht"}, overrides | {"world.name": options.task})).world
        task, how = _showable(world), "its teacher"
        goal = _goal(world, task, options.episode)
        sequence, length = _shown(world, task, goal)
    else:
        experiment, memory, rows = _learner(options, overrides)
        world, how = experiment.world, str(options.run)
        task = _task(world, options.task)
        goal = _goal(world, task, options.episode)
        _, _, (row,) = evaluation.best(memory, rows, experiment.scale, task, goal[None])
        sequence, length = memory.sequences[row], memory.lengths[row]
    trace = world.trace(sequence, length, key=modes.key(options.evaluation_seed))
    written = video.write(options.out, _pictures(options, world, trace, int(length), task, goal), fps=options.fps)
    print(f"{video.told(options.out, written)}; {world.names[task]} by {how}")
    return 0


def check_flags(options: argparse.Namespace) -> None:
    """Refuse what `star render` takes for tasks of STAR alone, or of runs, and a file that cannot be written."""
    for flag, usual in _OF_EPISODES.items():
        if getattr(options, flag) != usual:
            raise ConfigError(
                f"--{flag}: is for tasks of experiment star; allowed here: --episode, --every, --fps, --height"
            )
    video.check(options.out, force=options.force)
    for flag in ("checkpoint", "seed"):
        if options.run is None and getattr(options, flag) is not None:
            raise ConfigError(f"--{flag}: needs --run")


def _pictures(
    options: argparse.Namespace, world: World, trace: Any, length: int, task: int, goal: Any
) -> Iterator[np.ndarray]:
    look = {"task": task, "goal": goal, "height": options.height or 340}
    if video.is_still(options.out):
        return iter([draw.still(world, trace, **look)])
    return draw.film(world, trace, length=length, every=options.every, **look)


def _showable(world: World) -> int:
    """The last task that a world's own teacher can show, else the last one."""
    able = [i for i, task in enumerate(world.tasks) if task.demonstrate is not None]
    return able[-1] if able else len(world.tasks) - 1


def _shown(world: World, task: int, goal: Any) -> tuple[Any, Any]:
    """The teacher's demonstration of a goal, or a random sequence if there is none."""
    if world.tasks[task].demonstrate is not None:
        return world.demonstrate(task, goal)
    size = (world.longest, world.primitive)
    return jax.random.uniform(modes.key(0), size, minval=-1.0, maxval=1.0), jnp.int32(world.longest)


def _task(world: World, name: str | None) -> int:
    """The task of that name; the last one if it is that of the world, or none."""
    if name in (None, world.name):
        return len(world.tasks) - 1
    if name not in world.names:
        raise ConfigError(f"{shown(name)} is neither {world.name} nor a task of it; {known(str(name), world.names)}")
    return world.index(str(name))


def _goal(world: World, task: int, number: int | None) -> Any:
    """The goal of the evaluation of that number."""
    goals = world.benchmark(task)
    if (number or 0) >= len(goals):
        raise ConfigError(
            f"--episode: {number} is not one of the goals of {world.names[task]}; allowed: 0 to {len(goals) - 1}"
        )
    return goals[number or 0]


def _learner(options: argparse.Namespace, overrides: dict[str, Any]) -> tuple[Saht, Any, int]:
    """The experiment of a run, the memory of the learner asked for, and how many rows of it are written."""
    config = load_to_act(options.run, overrides)
    checkpoint = options.checkpoint or "last"
    program, state, _ = load_agent(config, options.run, checkpoint=checkpoint, agent=options.seed, seed=0)
    return program.experiment, state.memory, int(state.epoch) * program.steps_per_epoch


def record(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Write what a learner does best for goals drawn evenly in each task, as demonstrations for others."""
    files.check(options.out, (".npz",), force=options.force)
    experiment, memory, rows = _learner(options, overrides)
    world, scale = experiment.world, experiment.scale
    tasks: list[str] = []
    found: list[np.ndarray] = []
    for task, name in enumerate(world.names):
        key = jax.random.fold_in(modes.key(options.evaluation_seed), task)
        goals = jax.random.uniform(key, (options.episodes, 4), minval=world.lower[task], maxval=world.upper[task])
        mine = _best(memory, rows, scale, task, goals)
        tasks += [name] * len(mine)
        found.append(mine)
    if not tasks:
        raise ConfigError(f"{options.run}: has reached nothing, there is nothing to show")
    chosen = np.concatenate(found)
    number = np.array([world.index(name) for name in tasks])
    outcomes = np.asarray(memory.outcomes)[number, :, chosen] * scale.width[number] + scale.lower[number]
    pair, each = np.asarray(memory.pair)[chosen], len(world.tasks)
    pairs = np.where(pair[:, None] >= 0, np.column_stack([pair // each, pair % each]), -1).astype(np.int32)
    subgoals = np.asarray(memory.subgoals)[chosen] * scale.width[pairs] + scale.lower[pairs]
    subgoals = np.where(pairs[..., None] >= 0, subgoals, 0.0).astype(np.float32)
    sequences, lengths = np.asarray(memory.sequences)[chosen], np.asarray(memory.lengths)[chosen]
    demos = Demonstrations(sequences, lengths, outcomes, pairs, subgoals)
    teachers.save(options.out, world, tasks, demos)
    counts = ", ".join(f"{name} {tasks.count(name)}" for name in world.names)
    print(f"{options.out}: {len(tasks)} demonstrations: {counts}")
    return 0


def _best(memory: Memory, rows: int, scale: Scale, task: int, goals: Any) -> np.ndarray:
    """The rows of a memory nearest to goals of a task, and those nearest of the ones that are procedures."""
    _, distance, row = (np.asarray(x) for x in evaluation.best(memory, rows, scale, task, goals))
    _, other, made = (np.asarray(x) for x in evaluation.best(memory, rows, scale, task, goals, procedures=True))
    made = made[(other < FAR / 2) & (np.asarray(memory.pair)[made] >= 0)]
    return np.unique(np.concatenate([row[distance < FAR / 2], made]))
