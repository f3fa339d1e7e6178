"""Evaluation afterwards: many checkpoints of many runs, on test goals or a grid of them, in their own task or another.

prepare   the environment, the goals and one compiled function for all agents of one structure
evaluate  every checkpoint in turn: a row of plain values each
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from envs import goal_env, routes
from envs.common import modes
from envs.vector import VectorEnv
from star.agent import environment
from star.agent.episodes import MEASURES, Trials, failures, success_behind, summarise, summarise_way
from star.agent.play import MISHAPS, Episode, greedy
from star.agent.sections import Config
from star.config import agents
from star.config.loading import parse
from star.config.section import ConfigError
from star.report import statistics
from star.spec import Spec
from star.training import checkpoint
from star.training import program as programs
from star.training.checkpoint import Checkpoints
from star.training.compatibility import check_compatible
from star.training.program import Program

FAILED = 10  # episodes that failed, named for each seed


@dataclass(frozen=True)
class Exam:
    """The exam of agents: with `grid` N on a grid of N x N goals, else on those of tests, or of `training`.

    `seed` chooses starts and goals. `task` are dotted settings of the task, `env.name` and `env.options`, where they
    are not to be those of training.
    """

    grid: int | None = None
    training: bool = False
    seed: int = 0
    task: Mapping[str, Any] = field(default_factory=dict)

    @property
    def goals(self) -> str:
        """The goals in words."""
        if self.grid is not None:
            return f"grid {self.grid}"
        return "train" if self.training else "test"


@dataclass(frozen=True)
class Target:
    """Checkpoints of a run: "last", "best", "all" or env steps. `config` is the run's own."""

    run_dir: Path
    checkpoint: str
    config: Config


@dataclass(frozen=True)
class Course:
    """The course on which agents of one structure are evaluated. `program` is that of their training.

    `options` are those of the task. `goals` [E, k] are the goals of the episodes, None if the task draws them, and
    `cells` [G, 4] the rectangles that they are the middles of, one after another.
    """

    program: Program
    env: Any
    spec: Spec
    options: dict[str, Any]
    goals: jax.Array | None
    cells: np.ndarray | None


def prepare(config: Config, exam: Exam, *, episodes: int, source: Path) -> Course:
    """The course of `episodes` episodes for the agents of the run `source`, whose settings are `config`.

    Raises:
      UserError: in one line, if they cannot act there, or there are not as many episodes as goals.
    """
    program = programs.build(config)
    task = elsewhere(config, exam.task)
    env = environment.make(task, "trained" if exam.training else "test")
    spec = _fitting(program, env, source=source)
    goals = cells = None
    if exam.grid is not None:
        goal_env.need(env, "--goals grid", "with_goal", "arena")
        cells = env.arena.grid(exam.grid)
        if not len(cells):
            raise ConfigError(f"--grid: {exam.grid} puts no goal on a free floor of {env.name}")
        if len(cells) > episodes:
            raise ConfigError(
                f"--grid: {exam.grid} makes {len(cells)} goals, more than the {episodes} episodes; "
                f"allowed: a smaller grid, or --episodes {len(cells)} and more"
            )
        goals = jnp.asarray(_goals(env, (cells[:, :2] + cells[:, 2:]) / 2)[np.arange(episodes) % len(cells)])
    return Course(program, env, spec, task.env.options, goals, cells)


def elsewhere(config: Config, task: Mapping[str, Any]) -> Config:
    """`config` with the settings `task` of the environment; those of another task begin with its defaults."""
    env = config.env.model_dump(mode="json")
    if task.get("env.name", config.env.name) != config.env.name:
        env |= {"options": {}}
    return parse(config.model_dump(mode="json") | {"env": env}, task)


def _fitting(program: Program, env: Any, *, source: Path) -> Spec:
    """The spec of `env` for levels trained by `program`: their own space and subgoals, and its goals."""
    trained, here = program.experiment.spec, Spec.of(env, heading=program.experiment.spec.heading)
    for words, name in (("a state of", "state_dim"), ("actions of", "action_size")):
        here_size, trained_size = getattr(here, name), getattr(trained, name)
        if here_size != trained_size:
            raise ConfigError(
                f"env: {env.name} has {words} {here_size} numbers, the agent of {source} was trained with "
                f"{trained_size} ({program.config.env.name})"
            )
    if here.orientation != trained.orientation:
        raise ConfigError(f"env: {env.name} has another body than {program.config.env.name}, see {source}")
    period = program.config.tutor.period
    if here.episode_length % period:
        raise ConfigError(
            f"env.options.episode_length: {here.episode_length} is not a multiple of tutor.period {period} of {source}"
        )
    return trained.within(env)


def _goals(env: Any, middles: np.ndarray) -> np.ndarray:
    """Goals [G, k] at `middles` [G, 2]; what else there is in a goal is as in a test goal."""
    goals = np.repeat(np.asarray(env.reset(modes.key(0)).obs[None, env.state_dim :]), len(middles), axis=0)
    goals[:, _xy(env.goal_indices)] = middles
    return goals


def _xy(indices: Sequence[int]) -> list[int]:
    """Places of x and y, the first two numbers of a state, among `indices`."""
    return [indices.index(0), indices.index(1)]


def player(course: Course, episodes: int) -> Callable[[Any, Any, jax.Array], Trials]:
    """The jitted function from the settings, states and keys of S seeds to their trials [S, E]."""
    spec, tested = course.spec, VectorEnv(course.env, episodes, auto_reset=False)

    def look(env_state: Any, *_: Any) -> tuple[jax.Array, jax.Array]:
        return spec.abstract(env_state.obs), env_state.metrics["success"]

    def one(agent: Any, state: Any, key: jax.Array) -> Trials:
        streams, moments = greedy(agent, spec, tested, state, goals=course.goals, record=look, key=key)
        position, success = jax.tree.map(
            lambda many, end: jnp.concatenate([many, end[None]]), moments, look(streams.env)
        )
        goal = spec.goal(streams.env.obs)
        return measure(streams.episode, position, success, goal=goal, radius=spec.success_radius)

    return jax.jit(lambda agent, states, keys: jax.vmap(lambda state, key: one(agent, state, key))(states, keys))


def measure(ended: Episode, position: jax.Array, success: jax.Array, *, goal: jax.Array, radius: float) -> Trials:
    """Steps and paths of E episodes, from `position` [T + 1, E, d] and `success` [T + 1, E] at every moment.

    As in the statistics of episodes, the moment before the first step does not count as success. A body is
    stuck that stays within `radius` of its end for the last half of the time.
    """
    reached = success[1:] > 0
    steps = jnp.where(reached.any(axis=0), jnp.argmax(reached, axis=0) + 1, len(reached))
    legs = jnp.linalg.norm(position[1:] - position[:-1], axis=-1)
    path = jnp.where(jnp.arange(len(legs))[:, None] < steps, legs, 0.0).sum(axis=0)
    late = position[len(legs) // 2 :]
    stuck = (jnp.linalg.norm(late - late[-1], axis=-1) <= radius).all(axis=0)
    reasons = jnp.stack([*(getattr(ended, name) > 0 for name in MISHAPS), stuck, jnp.ones_like(stuck)])
    return Trials(
        episode=ended,
        steps=steps.astype(jnp.float32),
        path=path,
        start=position[0],
        goal=goal,
        failure=jnp.where(ended.success_any > 0, -1, jnp.argmax(reasons, axis=0)),
    )


def evaluate(targets: Sequence[Target], exam: Exam, *, quiet: bool = True) -> list[dict[str, Any]]:
    """A row of plain values for every checkpoint, in the order of `targets`.

    Agents whose settings agree in structure share what is compiled. The config in every checkpoint is looked at before
    the first episode is played.

    Raises:
      UserError: in one line, for whatever cannot be evaluated.
    """
    console = Console(stderr=True)
    busy = contextlib.nullcontext() if quiet or not console.is_terminal else console.status("preparing")
    with contextlib.ExitStack() as stack:
        status = stack.enter_context(busy)
        entries = list(_plan(targets, exam, stack))
        rows = []
        for number, entry in enumerate(entries):
            if status is not None:
                status.update(f"checkpoint {number + 1} of {len(entries)}")
            state = checkpoint.restore(entry.program, entry.checkpoints, entry.step, source=entry.run_dir)
            keys = entry.program.evaluation_keys(exam.seed, stream=programs.AFTERWARDS)
            trials = jax.device_get(entry.play(entry.program.config.hyper(), state, keys))
            rows.append(_row(entry, exam, trials, entry.shortest(trials)))
    return rows


@dataclass(frozen=True)
class _Entry:
    """A checkpoint to evaluate, and what does it. `program` is that of the course with the run's own settings."""

    run_dir: Path
    step: int
    checkpoints: Checkpoints
    program: Program
    course: Course
    play: Callable[[Any, Any, jax.Array], Trials]
    ways: dict[bytes, np.ndarray | None]

    def shortest(self, trials: Trials) -> np.ndarray | None:
        """The shortest ways [S, E] of `trials`, worked out once: all checkpoints have the same starts and goals."""
        key = trials.start.tobytes() + trials.goal.tobytes()
        if key not in self.ways:
            self.ways[key] = shortest_ways(self.course, trials)
        return self.ways[key]


def _plan(targets: Sequence[Target], exam: Exam, stack: contextlib.ExitStack) -> Iterator[_Entry]:
    """The checkpoints that are asked for, each once."""
    courses: dict[Any, tuple[Course, Any, dict]] = {}
    seen: set[tuple[Path, int]] = set()
    for target in targets:
        config, source = target.config, target.run_dir
        checkpoints = stack.enter_context(checkpoint.opened(source))
        steps = checkpoints.steps()
        if target.checkpoint != "all" or not steps:
            steps = [checkpoint.choose(checkpoints, source, target.checkpoint)]
        else:
            for step in steps:
                checkpoints.check(step)
        structure = _structure(config)
        if structure not in courses:
            episodes = config.trainer.eval_episodes
            course = prepare(config, exam, episodes=episodes, source=source)
            courses[structure] = (course, player(course, episodes), {})
        course, play, ways = courses[structure]
        own = course.program.experiment.resolve(config)
        program = dataclasses.replace(course.program, config=own)
        for step in steps:
            if (source.resolve(), step) not in seen:
                check_compatible(checkpoints.config(step), own, source=source)
                seen.add((source.resolve(), step))
                yield _Entry(source, step, checkpoints, program, course, play, ways)


def _structure(config: Config) -> Any:
    """The common part of runs that one compiled function evaluates: all but numbers and seeds."""
    env = json.dumps(config.env.model_dump(mode="json"), sort_keys=True)
    return jax.tree.structure(config.hyper()), env, config.trainer.num_envs, config.trainer.eval_episodes


def shortest_ways(course: Course, trials: Trials) -> np.ndarray | None:
    """Lengths, like `trials.path`, of the shortest ways from the starts until within reach of the goals (m).

    None where the map alone does not tell, see `envs.routes.distances`.
    """
    if course.env.arena is None:
        return None
    found = routes.distances(course.env.arena, *_ends(course, trials))
    if found is None:
        return None
    return np.maximum(found - course.spec.success_radius, 0.0).reshape(trials.path.shape)


def behind_walls(course: Course, trials: Trials) -> np.ndarray | None:
    """Episodes, like `trials.path`, in which a wall or a gap stands straight between the start and reach of the goal.

    None where there is no map.
    """
    if course.env.arena is None:
        return None
    starts, goals = _ends(course, trials)
    way = goals - starts
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    left = np.maximum(1 - course.spec.success_radius / np.maximum(length, 1e-9), 0.0)
    return routes.hidden(course.env.arena, starts, starts + left * way).reshape(trials.path.shape)


def _ends(course: Course, trials: Trials) -> tuple[np.ndarray, np.ndarray]:
    """Starts of all episodes, and their goals, both x and y [n, 2]."""
    start = np.asarray(trials.start)[..., _xy(course.spec.abstract_indices)]
    return start.reshape(-1, 2), np.asarray(trials.goal)[..., _xy(course.spec.goal_indices)].reshape(-1, 2)


def _row(entry: _Entry, exam: Exam, trials: Trials, shortest: np.ndarray | None) -> dict[str, Any]:
    course, dt, length = entry.course, entry.course.env.dt, entry.course.env.episode_length
    behind = behind_walls(course, trials)

    def summary(trials: Trials, shortest: np.ndarray | None, behind: np.ndarray | None) -> dict[str, Any]:
        found = summarise(trials.episode) | summarise_way(trials, shortest, dt=dt, length=length)
        return found | {"failures": failures(trials)} | success_behind(trials.episode, behind)

    per_seed = []
    for i, seed in enumerate(entry.program.seeds):
        one = jax.tree.map(lambda leaf, i=i: leaf[i], trials)
        failed = np.flatnonzero(one.episode.success_any == 0)[:FAILED].tolist()
        own = (None if found is None else found[i] for found in (shortest, behind))
        per_seed.append({"seed": seed} | summary(one, *own) | {"failed": failed})
    row = {
        "run": agents.told(entry.run_dir),
        "env": course.env.name,
        "options": course.options,
        "engine": course.env.engine,
        "env_steps": entry.step,
        "goals": exam.goals,
        "film": goal_env.has(course.env, *goal_env.DRAWN),
    }
    row |= summary(trials, shortest, behind)
    if len(per_seed) > 1:
        for measure in MEASURES:
            scores = [seed[measure] for seed in per_seed]
            _, low, high = statistics.over_seeds(np.asarray(scores), episodes=per_seed[0]["episodes"])
            row |= {
                f"{measure}_seeds_interval": [float(low), float(high)],
                f"{measure}_above": statistics.above(scores),
            }
    if course.cells is not None:
        row |= {"per_goal": per_goal(course.cells, trials), "walls": course.env.walls.tolist()}
    return row | {"seeds": per_seed}


def per_goal(cells: np.ndarray, trials: Trials) -> list[dict[str, Any]]:
    """Success for each of the goals [G] in `cells`, which the episodes of all seeds take in turn."""
    number = np.arange(trials.path.shape[-1]) % len(cells)
    return [
        {
            "cell": cell.tolist(),
            "episodes": int((number == i).sum() * len(trials.path)),
            **{name: float(getattr(trials.episode, name)[:, number == i].mean()) for name in MEASURES},
        }
        for i, cell in enumerate(cells)
    ]
