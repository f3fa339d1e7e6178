"""Pictures of episodes: of a trained agent, or of random actions.

record    an episode of N environments in one compiled program: where everything is before every env step
settle    of a film, leave out the part in which all stand at their goals
draw      on the host, the wanted ones of these moments
write     .png, .jpg, .mp4, .gif or .html
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import struct
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from envs import goal_env, video
from envs.common import modes
from envs.render import FINE_SHADOWS, SHADOWS, Marks, Painter, Stage, aspect_of
from envs.topdown import Sheet, tiled
from envs.vector import VectorEnv
from star.abstraction.regions import Box
from star.agent import environment, exams
from star.agent.exams import Exam
from star.agent.play import greedy
from star.agent.sections import Config
from star.config.section import ConfigError
from star.training import program as programs
from star.training.checkpoint import agent_number, load_state, of_one
from star.training.console import Elapsed

MAX_ENVS = 25
HEIGHTS = ((1, 480), (4, 320), (9, 240), (MAX_ENVS, 180))  # pixels of a tile, by the number of environments
_TEST = Exam()
WIDE = 16 / 9  # the shape that several tiles together come near to
REST = 2.0  # s that a film goes on after the last arrival


@dataclass(frozen=True)
class Show:
    """The picture to draw: `envs` environments for `steps` env steps, every `every`th of them.

    `steps` None is the episode, but in a still without an agent 0; a film then ends early where `until_settled` says.
    `camera` None is `overview` in a still and `follow` in a film; `height` None goes by the number of environments.
    """

    out: Path
    envs: int = 1
    steps: int | None = None
    every: int = 2
    fps: float = 20.0
    camera: str | None = None
    height: int | None = None


class Moments(struct.PyTreeNode):
    """N environments at T moments, one env step apart; all arrays have the leading axes [T, N].

    `qpos` and `mocap_pos` are what `env.pose` says. `subgoal`, absolute, and the target box `lower`, `upper` are None
    where nobody chose any.
    """

    qpos: Any
    mocap_pos: Any
    obs: Any
    distance: Any
    success: Any
    done: Any
    subgoal: Any = None
    lower: Any = None
    upper: Any = None


@dataclass(frozen=True)
class Recording:
    """An episode of `env`, as NumPy arrays. `regions` are those of the agent, (lower, upper), both [n, d], or None."""

    env: Any
    moments: Moments
    regions: tuple[np.ndarray, np.ndarray] | None = None


def render(
    config: Config,
    show: Show,
    *,
    run_dir: Path | None = None,
    checkpoint: str = "last",
    agent: int | None = None,
    exam: Exam = _TEST,
    episode: int | None = None,
    quiet: bool = False,
) -> str:
    """Record and draw an episode; returns a line that says what was written.

    With `run_dir` it is a greedy episode of its agent of seed `agent` (None: the first) in `exam`, and with `episode`
    the one of that number in its evaluation, without it one of random actions. `exam.seed` chooses starts, goals and
    random actions.

    Raises:
      UserError: in one line, for whatever cannot be had; nothing is written then.
    """
    with _progress(Console(stderr=True), quiet) as progress:
        task = progress.add_task("recording", total=None, since=time.monotonic())
        if run_dir is None:
            steps = 0 if show.steps is None and video.is_still(show.out) else show.steps
            recording = record_random(config, envs=show.envs, steps=steps, seed=exam.seed)
        else:
            recording = record_run(
                config,
                run_dir,
                checkpoint=checkpoint,
                agent=agent,
                envs=show.envs,
                steps=show.steps,
                exam=exam,
                number=episode,
            )
        if show.steps is None and not video.is_still(show.out):
            recording = until_settled(recording)
        times = video.moments(show.out, len(recording.moments.obs), every=show.every)
        progress.update(task, description="drawing", total=len(times), since=None)
        pictures = _ticking(draw(recording, show, times), progress, task)
        written = video.write(show.out, pictures, fps=show.fps)
    return video.told(show.out, written) + _outcome(recording)


def record_random(config: Config, *, envs: int, steps: int | None, seed: int) -> Recording:
    """Actions drawn uniformly from all possible ones, on test goals unless `env.options.goals` says otherwise."""
    programs.select_device(config.trainer.device)
    env = environment.make(config, "train" if "goals" in config.env.options else "test")
    goal_env.need(env, "star render", *goal_env.DRAWN)
    vector = VectorEnv(env, envs, auto_reset=False)
    length = _length(env.episode_length, steps)

    def step(state: Any, key: jax.Array) -> tuple[Any, Moments]:
        action = jax.random.uniform(key, (envs, env.action_size), minval=-1.0, maxval=1.0)
        return vector.step(state, action), _look(env, state)

    def play(key: jax.Array) -> tuple[Moments, Moments]:
        reset_key, step_key = jax.random.split(key)
        last, moments = jax.lax.scan(step, vector.reset(reset_key), jax.random.split(step_key, length))
        return moments, _look(env, last)

    return Recording(env, _joined(*jax.device_get(jax.jit(play)(modes.key(seed)))))


def record_run(
    config: Config,
    run_dir: Path,
    *,
    checkpoint: str,
    agent: int | None,
    envs: int,
    steps: int | None,
    exam: Exam = _TEST,
    number: int | None = None,
) -> Recording:
    """Greedy episodes of the agent with seed `agent` in a checkpoint of `run_dir`: the first `envs` of `exam`.

    With `number` it is this one of the episodes that `star.agent.exams` evaluates. All of them and all seeds are then
    played along with it, so that every number is the same.
    """
    episodes = envs if number is None else config.trainer.eval_episodes
    if number is not None and number >= episodes:
        raise ConfigError(f"--episode: {number} is not among 0 to {episodes - 1}; see --episodes")
    course = exams.prepare(config, exam, episodes=episodes, source=run_dir)
    program, env, spec = course.program, course.env, course.spec
    goal_env.need(env, "star render", *goal_env.DRAWN)
    length = _length(spec.episode_length, steps)
    index = agent_number(program.seeds, run_dir, agent)
    _, states = load_state(program, run_dir, checkpoint)
    keys = program.evaluation_keys(exam.seed, stream=programs.AFTERWARDS)
    shown = slice(0, envs) if number is None else slice(number, number + 1)
    if number is None:
        states, keys = jax.tree.map(lambda leaf: leaf[index : index + 1], (states, keys))
        index = 0
    vector = VectorEnv(env, episodes, auto_reset=False)

    def look(env_state: Any) -> Moments:
        return _look(env, jax.tree.map(lambda leaf: leaf[shown], env_state))

    def record(env_state: Any, subgoal: jax.Array, box: Box, action: jax.Array) -> Moments:
        aim = subgoal[..., : box.lower.shape[-1]] + spec.abstract(env_state.obs)
        if not program.config.tutor.enabled:
            aim = box.centre
        return look(env_state).replace(subgoal=aim[shown], lower=box.lower[shown], upper=box.upper[shown])

    def play(agent: Any, state: Any, key: jax.Array) -> tuple[Moments, Moments]:
        streams, moments = greedy(agent, spec, vector, state, goals=course.goals, record=record, key=key)
        end = look(streams.env)
        return moments, end.replace(subgoal=moments.subgoal[-1], lower=moments.lower[-1], upper=moments.upper[-1])

    def play_all(agent: Any, states: Any, keys: jax.Array) -> tuple[Moments, Moments]:
        played = jax.vmap(lambda state, key: play(agent, state, key))(states, keys)
        return jax.tree.map(lambda leaf: leaf[index], played)

    played = jax.device_get(jax.jit(play_all)(program.config.hyper(), states, keys))
    moments = jax.tree.map(lambda leaf: leaf[: length + 1], _joined(*played))
    abstraction = jax.device_get(of_one(states.abstraction, index))
    regions = abstraction.lower[: abstraction.count], abstraction.upper[: abstraction.count]
    return Recording(env, moments, regions if config.commander.enabled else None)


def until_settled(recording: Recording) -> Recording:
    """The recording until `REST` after all environments are at their goals to stay; the whole one if any is not."""
    success = recording.moments.success > 0
    if not success[-1].all():
        return recording
    away = np.flatnonzero(~success.all(axis=1))
    arrival = away[-1] + 1 if len(away) else 0
    end = arrival + round(REST / recording.env.dt) + 1
    return replace(recording, moments=jax.tree.map(lambda leaf: leaf[:end], recording.moments))


def draw(recording: Recording, show: Show, times: list[int]) -> Iterator[np.ndarray]:
    """The pictures (uint8 [h, w, 3]) of the moments `times`, the environments side by side."""
    moments = recording.moments
    count = moments.obs.shape[1]
    height = show.height or next(height for most, height in HEIGHTS if count <= most)
    camera = show.camera or ("overview" if video.is_still(show.out) else "follow")
    stage = Stage(recording.env)
    width = height if camera == "follow" else round(height * aspect_of(recording.env.arena))
    sheet = Sheet(
        stage, height=height, view_width=width, regions=recording.regions, subgoals=moments.subgoal is not None
    )
    columns = min(count, max(1, round((count * WIDE * sheet.height / sheet.width) ** 0.5)))
    shadows = FINE_SHADOWS if video.is_still(show.out) else SHADOWS * (count == 1)
    with Painter(stage, width=width, height=height, shadows=shadows) as painter:
        for t in times:
            yield tiled([_tile(recording, stage, painter, sheet, camera, t, n) for n in range(count)], columns)


def _tile(
    recording: Recording, stage: Stage, painter: Painter, sheet: Sheet, camera: str, t: int, n: int
) -> np.ndarray:
    env, moments = recording.env, recording.moments
    chosen = moments.subgoal is not None
    stage.place(moments.qpos[t, n], moments.mocap_pos[t, n])
    marks = Marks(
        goal=moments.obs[t, n, env.state_dim :],
        subgoal=moments.subgoal[t, n] if chosen else None,
        target=(moments.lower[t, n], moments.upper[t, n]) if chosen else None,
        trail=moments.obs[: t + 1, n, :2],
    )
    alone = moments.obs.shape[1] == 1
    reached = "   reached" if moments.success[t, n] > 0 else ""
    return sheet.draw(
        marks,
        left=f"{env.name}   {t * env.dt:.1f} s" if alone else f"{t * env.dt:.1f} s",
        right=f"distance {moments.distance[t, n]:.1f} m{reached}",
        view=painter.paint(marks, camera=camera),
    )


def _look(env: Any, state: Any) -> Moments:
    """The kept part of the environments [N] of `state`."""
    qpos, mocap_pos = jax.vmap(env.pose)(state.pipeline_state.data)
    return Moments(
        qpos=qpos,
        mocap_pos=mocap_pos,
        obs=state.obs,
        distance=state.metrics["distance"],
        success=state.metrics["success"],
        done=state.done,
    )


def _joined(moments: Moments, end: Moments) -> Moments:
    """All of `moments`, then `end`. An environment stays as it was when its episode ended or the simulation broke."""
    whole = jax.tree.map(lambda many, one: np.concatenate([many, one[None]]), moments, end)
    over = np.cumsum(whole.done, axis=0) - whole.done > 0
    good = ~over & np.isfinite(whole.qpos).all(axis=-1)
    last_good = np.maximum.accumulate(np.where(good, np.arange(len(good))[:, None], 0), axis=0)
    return jax.tree.map(lambda leaf: leaf[last_good, np.arange(good.shape[1])], whole)


def _length(episode_length: int, steps: int | None) -> int:
    if steps is not None and steps > episode_length:
        raise ConfigError(f"--steps: {steps} is more than the {episode_length} env steps of an episode")
    return episode_length if steps is None else steps


def _outcome(recording: Recording) -> str:
    success = recording.moments.success.max(axis=0) > 0
    if len(recording.moments.obs) == 1:
        return ""
    if len(success) > 1:
        return f"; {success.sum()} of {len(success)} reach the goal"
    return f"; the goal is {'reached' if success[0] else 'not reached'}"


def _progress(console: Console, quiet: bool) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        Elapsed(),
        TimeRemainingColumn(compact=True),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )


def _ticking(pictures: Iterator[np.ndarray], progress: Progress, task: Any) -> Iterator[np.ndarray]:
    for picture in pictures:
        yield picture
        progress.advance(task)
