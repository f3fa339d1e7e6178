"""CHIME's own commands: pictures of a robot that does a test, and of its graph of models as it grows."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.patches import Circle, Rectangle

from envs import video
from envs.common import modes
from envs.worlds import draw
from envs.worlds import room as rooms
from envs.worlds.room import Errand, Room
from star.config.loading import load_run, load_to_act, parse
from star.config.section import ConfigError
from star.saht.chime import figures
from star.saht.chime.experiment import Chime, tested
from star.saht.commands import check_flags
from star.training import program as programs
from star.training.checkpoint import agent_number, load_agent
from star.training.journal import Journal

GRAPH = "models"
"""The word for `star render` that asks for the graph of models, in the place of the room."""


def envs() -> list[str]:
    """The room."""
    return ["room"]


def record(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """There is nothing to record."""
    raise ConfigError("star record: a run of experiment chime makes no demonstrations; allowed: one of star or saht")


def render(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Draw a learner that does a test, or random actions; or how the models of a learner have grown."""
    check_flags(options)
    if options.task == GRAPH:
        return _render_graph(options, overrides)
    if options.task not in (None, *envs()):
        raise ConfigError(f"{options.task}: is not in a run of experiment chime; allowed: room, {GRAPH}")
    if options.run is None:
        values = {"experiment": "chime", "chime": {"tasks": "none"}, "trainer": {"num_seeds": 1}}
        program = programs.build(parse(values, overrides))
        state = jax.tree.map(lambda leaf: leaf[0], program.init(program.seed_keys()))
        how = "random actions"
    else:
        config = load_to_act(options.run, overrides)
        found = load_agent(config, options.run, checkpoint=options.checkpoint or "last", agent=options.seed, seed=0)
        program, state, how = found[0], found[1], str(options.run)
    experiment = program.experiment
    number, errands = options.episode or 0, experiment.errands
    if number >= len(errands):
        raise ConfigError(f"--episode: {number} is not one of the tests; allowed: 0 to {len(errands) - 1}")
    errand = errands[number]
    key = modes.key(options.evaluation_seed)
    path = np.asarray(tested(program.hyper, experiment.room, [errand], state, key=key)[0])
    alone = jax.tree.map(lambda leaf: leaf[None], jax.device_get(state.replace(key=None)))
    (table,) = experiment.tables(program.hyper, alone, [options.seed or 0])
    height = options.height or 340
    steps = video.moments(options.out, len(path), every=options.every)
    drawn = _pictures(experiment.room, errand, path, table["models"], steps=steps, height=height)
    written = video.write(options.out, drawn, fps=options.fps)
    print(f"{video.told(options.out, written)}; test {number}, {errand.kind}, by {how}")
    return 0


def _pictures(
    room: Room, errand: Errand, path: np.ndarray, models: Sequence[Any], *, steps: Sequence[int], height: int
) -> Iterator[np.ndarray]:
    """The room after so many `steps`, beside the models that are on."""
    shares = figures.competences(models)
    for step in steps:
        figure = draw.figure_of(height, 2.4)
        left, right = figure.subplots(1, 2)
        sketch(left, room, path[: step + 1])
        draw.star(left, *errand.goal)
        figures.graph(right, room, shares)
        off = np.linalg.norm(path[step, errand.disc] - np.array(errand.goal))
        figure.suptitle(f"{errand.kind}: {off:.0f} from the goal", x=0.01, ha="left", size=10, color=draw.INK)
        yield draw.pixels(figure)


def _render_graph(options: argparse.Namespace, overrides: dict[str, Any]) -> int:
    """Draw the models of a learner at each evaluation of its run."""
    for flag in ("checkpoint", "episode"):
        if getattr(options, flag) is not None:
            raise ConfigError(f"--{flag}: is for the room; the film of {GRAPH} shows all evaluations")
    config = load_run(options.run, overrides)
    rows = Journal.of(options.run, tables=GRAPH).tables.read()
    if not rows:
        raise ConfigError(f"{options.run}: has no evaluation yet, there are no {GRAPH} to show")
    seeds = programs.seeds_of(config)
    seed = seeds[agent_number(seeds, options.run, options.seed)]
    mine = [row for row in rows if row["seed"] == seed]
    shown = [mine[number] for number in video.moments(options.out, len(mine), every=options.every)]
    written = video.write(options.out, _graphs(Chime(config).room, shown, options.height or 340), fps=options.fps)
    print(f"{video.told(options.out, written)}; {GRAPH} of seed {seed} of {options.run}")
    return 0


def _graphs(room: Room, rows: Sequence[Any], height: int) -> Iterator[np.ndarray]:
    """The models that are on at each evaluation, with their competence."""
    for row in rows:
        figure = draw.figure_of(height, 1.5)
        figures.graph(figure.subplots(), room, figures.competences(row["models"]))
        figure.suptitle(f"{row['env_steps']:,} actions", x=0.01, ha="left", size=10, color=draw.INK)
        yield draw.pixels(figure)


def sketch(axes: Any, room: Room, path: np.ndarray) -> None:
    """The room at the end of a path [t, D, 2], with where the discs have been."""
    (left, low), (right, high) = rooms.LOWER, rooms.UPPER
    draw.panel(axes, "room", x=(left, right), y=(low, high))
    if room.wall:
        axes.add_patch(Rectangle(rooms.WALL[0], *(rooms.WALL[1] - rooms.WALL[0]), color=draw.EDGE))
    for number, (x, y) in enumerate(path[-1]):
        shade = draw.TIP if number == 0 else draw.TRAIL if number <= room.movable else draw.EDGE
        axes.plot(*path[:, number].T, color=shade, lw=1, alpha=0.6)
        axes.add_patch(Circle((x, y), rooms.RADIUS, facecolor=shade, edgecolor=draw.INK, zorder=3))
