"""The host's side of a run: epochs, evaluation, checkpoints, metrics and the figure, around one jitted function."""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

import envs
from envs import arena
from envs.vector import VectorEnv
from star import episode, evaluation, hierarchy, profiling, provenance, report, sinks
from star import state as states
from star.checkpoint import Checkpoints, check_compatible
from star.config import AgentConfig, Config, ConfigError, TeacherConfig
from star.display import Display, Stopwatch
from star.episode import Episode
from star.loading import parse
from star.metrics import Journal, mean
from star.profiling import Profile
from star.sgim import teachers
from star.sgim.teachers import Demonstrations
from star.sinks import Sinks
from star.spec import Spec
from star.state import TrainState

# Streams of random keys that no seed of training uses.
_DURING_TRAINING = 2**32 - 1
AFTERWARDS = 2**32 - 2


@dataclass(frozen=True)
class Functions:
    """The jitted functions of a `Program`. The agent comes first: another one of the same structure needs no compiling.

    States and keys have a leading axis. The floats of the agent are scalars or have that axis too.
    """

    init: Callable[[AgentConfig, jax.Array], TrainState]
    epoch: Callable[[AgentConfig, tuple[Demonstrations, ...], TrainState], tuple[TrainState, dict[str, jax.Array]]]
    evaluate: Callable[[AgentConfig, TrainState, jax.Array], Episode]


@dataclass(frozen=True)
class Program:
    """The compiled parts of a run. States and keys carry a leading axis of seeds."""

    config: Config
    spec: Spec
    walls: np.ndarray
    goal: np.ndarray
    """A test goal as an abstract point [d]: the one of the task, or one of several."""
    agent: AgentConfig
    """What is traced: the floats of `config`, or arrays of them with the leading axis of states and keys."""
    lessons: Callable[[], tuple[Demonstrations, ...]]
    """What the teachers show, read when it is first needed; raises `ConfigError`."""
    functions: Functions

    def init(self, keys: jax.Array) -> TrainState:
        """Fresh runs, one from each key."""
        return self.functions.init(self.agent, keys)

    def epoch(self, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        """Train for an epoch; `state` is used up."""
        return self.functions.epoch(self.agent, self.lessons(), state)

    def evaluate(self, state: TrainState, keys: jax.Array) -> Episode:
        """Greedy episodes on test goals, `trainer.eval_episodes` of each state."""
        return self.functions.evaluate(self.agent, state, keys)

    @property
    def env_steps_per_epoch(self) -> int:
        """Env steps of all environments of one seed in one epoch."""
        return self.config.trainer.num_envs * self.spec.episode_length

    @property
    def epochs(self) -> int:
        """Epochs that make up at least `total_env_steps`."""
        return -(-self.config.trainer.total_env_steps // self.env_steps_per_epoch)

    @property
    def seeds(self) -> list[int]:
        """The seeds trained side by side."""
        return _seeds_of(self.config)


@dataclass(frozen=True)
class Result:
    """How a call of `train` ended."""

    run_dir: Path
    env_steps: int
    interrupted: bool
    success_final: float | None


def build(config: Config) -> Program:
    """Make the environments and the jitted functions of `config`; raises `ConfigError` if they cannot be made."""
    select_device(config.trainer.device)
    env = make_env(config, "train")
    spec = Spec.of(env, heading=config.tutor.heading if config.tutor.enabled else None)
    config = resolve(config, env.engine, spec)
    try:
        states.check(config, spec)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    test_env = make_env(config, "test")
    trained = VectorEnv(env, config.trainer.num_envs, auto_reset=False)
    tested = VectorEnv(test_env, config.trainer.eval_episodes, auto_reset=False)

    @cache
    def lessons() -> tuple[Demonstrations, ...]:
        return tuple(_demonstrations(config, teacher, env, test_env, spec) for teacher in config.sgim.teachers)

    def init(agent: AgentConfig, keys: jax.Array) -> Any:
        return jax.vmap(lambda one, key: states.init(one, spec, key=key), in_axes=(_axis(agent), 0))(agent, keys)

    def epoch(agent: AgentConfig, lessons: Any, state: TrainState) -> Any:
        def one_epoch(one: AgentConfig, state: TrainState) -> Any:
            return hierarchy.epoch(one, spec, trained, state, teachers=lessons)

        return jax.vmap(one_epoch, in_axes=(_axis(agent), 0))(agent, state)

    def evaluate(agent: AgentConfig, state: TrainState, keys: jax.Array) -> Any:
        def one_evaluation(one: AgentConfig, state: TrainState, key: jax.Array) -> Any:
            return episode.evaluate(one, spec, tested, state, key=key)

        return jax.vmap(one_evaluation, in_axes=(_axis(agent), 0, 0))(agent, state, keys)

    return Program(
        config=config,
        spec=spec,
        walls=np.asarray(env.arena.walls()),
        goal=_a_goal(spec, test_env),
        agent=config.agent(),
        lessons=lessons,
        functions=Functions(jax.jit(init), jax.jit(epoch, donate_argnums=2), jax.jit(evaluate)),
    )


def train(
    config: Config,
    run_dir: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    profile: int = 0,
    console: Console | None = None,
) -> Result:
    """Train to the end, or go on with the run in `run_dir`. Ctrl-C writes a checkpoint and returns.

    `profile` is the number of epochs that JAX's profiler traces, to `run_dir/profile`.
    """
    console = console or Console(stderr=True)
    sinks.check(config)
    program = build(config)
    program.lessons()  # refused before anything is written
    checkpoints = Checkpoints(run_dir, keep=config.trainer.keep_checkpoints)
    traced = _traced(program, checkpoints, profile) if profile else 0
    journal = Journal.of(run_dir)
    if resume:
        state = _restore(program, checkpoints, journal)
    else:
        _prepare(run_dir, program.config)
        state = jax.device_put(program.init(seed_keys(program)), jax.devices()[0])  # as a restored one is
    began = int(state.epoch[0]) * program.env_steps_per_epoch
    journal.provenance.write({"env_steps": began} | provenance.here())
    try:
        return _loop(
            program, state, run_dir, checkpoints, journal, quiet=quiet, console=console, profile=(traced, profile)
        )
    finally:
        checkpoints.close()


def load_checkpoint(program: Program, run_dir: Path, wanted: str) -> tuple[int, TrainState]:
    """(env steps, state of all seeds) of a checkpoint of `run_dir`: "last", "best" or its env steps."""
    with opened(run_dir) as checkpoints:
        step = choose(checkpoints, run_dir, wanted)
        return step, restore(program, checkpoints, step, source=run_dir)


@contextlib.contextmanager
def opened(run_dir: Path) -> Iterator[Checkpoints]:
    """The checkpoints of a run, closed again at the end."""
    checkpoints = Checkpoints(run_dir)
    try:
        yield checkpoints
    finally:
        checkpoints.close()


def choose(checkpoints: Checkpoints, run_dir: Path, wanted: str) -> int:
    """Env steps of the checkpoint of `run_dir` that a user wants: "last", "best" or its env steps."""
    steps = checkpoints.steps()
    if not steps:
        raise ConfigError(f"{run_dir}: holds no checkpoint")
    if wanted == "last":
        return steps[-1]
    if wanted == "best":
        return checkpoints.best()
    if wanted.isdecimal() and int(wanted) in steps:
        return int(wanted)
    raise ConfigError(f"--checkpoint: {wanted!r} is not among last, best, {', '.join(map(str, steps))}")


def restore(program: Program, checkpoints: Checkpoints, step: int, *, source: Path) -> TrainState:
    """The state of all seeds in the checkpoint at `step`; raises `ConfigError` if it is none of `program`."""
    check_compatible(checkpoints.config(step), program.config, source=source)
    return checkpoints.restore(step, jax.eval_shape(program.init, seed_keys(program)))


def load_agent(
    config: Config, run_dir: Path, *, checkpoint: str, agent: int | None, seed: int
) -> tuple[Program, TrainState, jax.Array]:
    """The agent of seed `agent` (None: the first) in a checkpoint of `run_dir`, and the key of its episodes.

    `seed` is the one that a user chose for the evaluation.
    """
    program = build(config)
    number = agent_number(program, run_dir, agent)
    _, states = load_checkpoint(program, run_dir, checkpoint)
    key = evaluation_keys(program, seed, stream=AFTERWARDS)[number]
    return program, jax.tree.map(lambda leaf: leaf[number], states), key


def agent_number(program: Program, run_dir: Path, agent: int | None) -> int:
    """Which of the agents of `run_dir` has the seed `agent` (None: the first)."""
    if agent is None:
        return 0
    if agent not in program.seeds:
        raise ConfigError(f"--seed: {agent} is not among those of {run_dir}: {', '.join(map(str, program.seeds))}")
    return program.seeds.index(agent)


class SideBySide:
    """Runs that share their `structure`, trained side by side in one program. Each has a slot, and may come and go.

    What a run does depends on nothing but its own config, so it is what `train` would do.
    """

    def __init__(self, config: Config, slots: int) -> None:
        """Compile for `slots` runs like `config`; raises `ConfigError` if it cannot be trained."""
        program = build(config)
        program.lessons()
        self.slots = slots
        self.epochs = program.epochs
        self.env_steps_per_epoch = program.env_steps_per_epoch * config.trainer.num_seeds
        self._program = program
        self._configs = [program.config] * slots
        self._state: TrainState | None = None

    def put(self, runs: Mapping[int, Config]) -> None:
        """Begin new runs in these slots; what was there is gone."""
        for slot, config in runs.items():
            self._configs[slot] = resolve(config, self._program.config.env.engine, self._program.spec)
        each = self._program.config.trainer.num_seeds
        agent = jax.tree.map(
            lambda *leaves: np.repeat(np.asarray(leaves, np.float32), each), *[one.agent() for one in self._configs]
        )
        self._program = replace(self._program, agent=agent)
        fresh = self._program.init(_seed_keys(self._seeds()))
        if self._state is None:
            self._state = fresh
        else:
            new = np.repeat([slot in runs for slot in range(self.slots)], each)
            self._state = _replace_where(new, fresh, self._state)

    def advance(self) -> list[list[dict[str, Any]]]:
        """Train all slots for an epoch: the metrics of each seed, for each slot, with `eval/` where it is time."""
        assert self._state is not None
        settings, seeds = self._program.config.trainer, self._seeds()
        self._state, metrics = self._program.epoch(self._state)
        table = _rows(metrics, seeds)
        done = np.asarray(self._state.epoch)
        due = (done % settings.eval_every == 0) | (done == self.epochs)
        if due.any():
            episodes = self._program.evaluate(self._state, _evaluation_keys(seeds, done, stream=_DURING_TRAINING))
            _add_evaluation(table, episodes, where=due)
        for row, epochs in zip(table, done, strict=True):
            row["env_steps"] = int(epochs) * self._program.env_steps_per_epoch
        each = settings.num_seeds
        return [table[slot * each : (slot + 1) * each] for slot in range(self.slots)]

    def _seeds(self) -> list[int]:
        return [seed for config in self._configs for seed in _seeds_of(config)]


def structure(config: Config) -> str:
    """What runs must share to be trained `SideBySide`: everything but the agent's floats and the first seed."""
    values = config.model_dump(mode="json", exclude={"trainer": {"seed"}})
    same = jax.tree.map(lambda _: 0.0, config.agent())
    return json.dumps(values | same.model_dump(mode="json"), sort_keys=True)


def evaluation_keys(program: Program, number: int, *, stream: int = _DURING_TRAINING) -> jax.Array:
    """Keys of one evaluation, one per seed, apart from all keys of training.

    `number` is the epoch in the stream of evaluations during training, or the seed that a user chose afterwards.
    """
    return _evaluation_keys(program.seeds, [number] * len(program.seeds), stream=stream)


def seed_keys(program: Program) -> jax.Array:
    """Keys that the states of all seeds start from."""
    return _seed_keys(program.seeds)


def select_device(device: str) -> None:
    """Make JAX use the device that `trainer.device` asks for; raises `ConfigError` if there is none."""
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    if device == "gpu" and jax.default_backend() != "gpu":
        raise ConfigError(
            f"trainer.device: 'gpu' is not available, JAX sees only {jax.default_backend()}; "
            'install with pip install "star-rl[cuda,warp]" on a machine with an NVIDIA GPU, or use auto or cpu'
        )


def _loop(
    program: Program,
    state: TrainState,
    run_dir: Path,
    checkpoints: Checkpoints,
    journal: Journal,
    *,
    quiet: bool,
    console: Console,
    profile: tuple[int, int],
) -> Result:
    config, seeds = program.config.trainer, program.seeds
    rows, regions = journal.metrics.read(), journal.regions.read()
    done = int(state.epoch[0])
    env_steps = done * program.env_steps_per_epoch
    began = time.monotonic() - (rows[-1]["wall_s"] if rows else 0.0)
    success = _latest_success(rows)
    saved = done if checkpoints.steps() else -1
    stopwatch = Stopwatch()
    display = Display(
        console,
        stopwatch,
        title=f"{program.config.env.name} on {jax.default_backend()}, {_named(seeds)}",
        total_env_steps=program.epochs * program.env_steps_per_epoch,
        done_env_steps=env_steps,
        quiet=quiet,
    )
    trace = Profile(run_dir / "profile", first=profile[0], epochs=profile[1], say=display.say, warn=display.warn)
    with Sinks(run_dir, program.config, rows, warn=display.warn) as others:
        with display, trace, interruptible(display.stop) as interrupted:
            while done < program.epochs and not interrupted():
                trace.before(done)
                with stopwatch.measure("epoch"):
                    state, metrics = program.epoch(state)
                    table = _rows(metrics, seeds)
                speed = program.env_steps_per_epoch * len(seeds) / stopwatch.last("epoch")
                done += 1
                trace.after(done)
                env_steps = done * program.env_steps_per_epoch
                if done % config.eval_every == 0 or done == program.epochs:
                    with stopwatch.measure("evaluation"):
                        _add_evaluation(table, program.evaluate(state, evaluation_keys(program, done)))
                    success = mean(table, "eval/success_final")
                    if program.config.commander.enabled:
                        regions.extend(_region_rows(program, state, env_steps=env_steps))
                        for region_row in regions[-len(seeds) :]:
                            journal.regions.write(region_row)
                for row in table:
                    row |= {"env_steps": env_steps, "wall_s": round(time.monotonic() - began, 3)}
                    row |= {"env_steps_per_s": round(speed)}
                    journal.metrics.write(row)
                rows.extend(table)
                others.write(table)
                display.update(env_steps, table, left_s=stopwatch.left(_left(program, done)))
                if done % config.checkpoint_every == 0 or done == program.epochs:
                    with stopwatch.measure("checkpoint"):
                        checkpoints.save(env_steps, state, program.config, success=_or_zero(success))
                    saved = done
            stopped = done < program.epochs
            if saved != done:
                checkpoints.save(env_steps, state, program.config, success=_or_zero(success))
        if program.config.commander.enabled and not (regions and regions[-1]["env_steps"] == env_steps):
            # stopped between evaluations
            regions.extend(_region_rows(program, state, env_steps=env_steps))
        _draw(run_dir / "figures", program, rows, regions)
        others.figures(run_dir / "figures")
    return Result(run_dir, env_steps, stopped, success)


def _region_rows(program: Program, state: TrainState, *, env_steps: int) -> list[dict[str, Any]]:
    return report.region_rows(
        program.config.agent(), state, seeds=program.seeds, env_steps=env_steps, goal=program.goal
    )


def _draw(folder: Path, program: Program, rows: list[dict[str, Any]], regions: list[dict[str, Any]]) -> None:
    report.summary_figure(folder / "summary.png", regions=regions, rows=rows, walls=program.walls)
    if regions:
        report.growth_figure(folder / "growth.png", regions=regions, walls=program.walls)
    if rows and program.config.sgim.enabled:
        report.sgim_figure(folder / "sgim.png", regions=regions, rows=rows, walls=program.walls)


def _named(seeds: list[int]) -> str:
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"


def _left(program: Program, done: int) -> dict[str, int]:
    """How many epochs, evaluations and checkpoints follow after `done` epochs; the last epoch has both."""

    def count(every: int) -> int:
        return -(-program.epochs // every) - done // every if done < program.epochs else 0

    config = program.config.trainer
    return {
        "epoch": program.epochs - done,
        "evaluation": count(config.eval_every),
        "checkpoint": count(config.checkpoint_every),
    }


def _traced(program: Program, checkpoints: Checkpoints, epochs: int) -> int:
    """After how many epochs the profiler begins to trace; raises `ConfigError` if the run is too short for it."""
    return profiling.plan(
        done=(checkpoints.steps() or [0])[-1] // program.env_steps_per_epoch,
        total=program.epochs,
        eval_every=program.config.trainer.eval_every,
        epochs=epochs,
    )


def _rows(metrics: dict[str, jax.Array], seeds: list[int]) -> list[dict[str, Any]]:
    """One row per seed of the metrics of an epoch."""
    host = jax.device_get(metrics)
    return [{"seed": seed} | {k: v[i].item() for k, v in host.items()} for i, seed in enumerate(seeds)]


def _add_evaluation(table: list[dict[str, Any]], episodes: Episode, *, where: np.ndarray | None = None) -> None:
    """Add the statistics of `episodes` to the rows of `table`, or to those where the mask says so."""
    host = jax.device_get(episodes)
    for i, row in enumerate(table):
        if where is not None and not where[i]:
            continue
        summary = evaluation.summarise(jax.tree.map(lambda x, i=i: x[i], host))
        row |= {f"eval/{name}": summary[name] for name in ("success_any", "success_final", "distance", "return")}


def _axis(agent: AgentConfig) -> int | None:
    """The axis of `agent` under a vmap over states: none if its floats are scalars."""
    return 0 if np.ndim(jax.tree.leaves(agent)[0]) else None


@jax.jit
def _replace_where(mask: jax.Array, new: TrainState, old: TrainState) -> TrainState:
    """`new` where `mask` [n] is set, else `old`, along the leading axis."""
    return jax.vmap(lambda pick, a, b: jax.tree.map(partial(jnp.where, pick), a, b))(mask, new, old)


def _seeds_of(config: Config) -> list[int]:
    first = config.trainer.seed
    return list(range(first, first + config.trainer.num_seeds))


def _seed_keys(seeds: Sequence[int]) -> jax.Array:
    return jax.vmap(jax.random.key)(np.asarray(seeds, np.uint32))


def _evaluation_keys(seeds: Sequence[int], numbers: Sequence[int] | np.ndarray, *, stream: int) -> jax.Array:
    base, fold = jax.random.key(stream), jax.random.fold_in
    return jax.vmap(lambda number, seed: fold(fold(base, number), seed))(
        np.asarray(numbers, np.uint32), np.asarray(seeds, np.uint32)
    )


def _latest_success(rows: list[dict[str, Any]]) -> float | None:
    steps = [row["env_steps"] for row in rows if "eval/success_final" in row]
    return mean([row for row in rows if row["env_steps"] == steps[-1]], "eval/success_final") if steps else None


def _or_zero(success: float | None) -> float:
    return 0.0 if success is None else success


def _restore(program: Program, checkpoints: Checkpoints, journal: Journal) -> TrainState:
    steps, run_dir = checkpoints.steps(), journal.metrics.path.parent
    if not steps:
        raise ConfigError(f"{run_dir}: holds no checkpoint to resume from")
    state = restore(program, checkpoints, steps[-1], source=run_dir)
    for lines in (journal.metrics, journal.regions):
        lines.keep_until(steps[-1])
    return state


def _prepare(run_dir: Path, config: Config) -> None:
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        raise ConfigError(
            f"{run_dir}: is not empty; choose another --run-dir, or go on with it: star train --resume {run_dir}"
        )
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        (run_dir / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be written: {error.strerror}") from None


def resolve(config: Config, engine: str, spec: Spec) -> Config:
    """`config` with the engine, the map and the initial cuts that are really used."""
    values = config.model_dump(mode="json")
    values["env"]["engine"] = engine
    if "map" in values["env"]["options"]:  # the run must not change with the file
        values["env"]["options"]["map"] = arena.load(values["env"]["options"]["map"])
    if values["abstraction"]["cuts"] is None and values["abstraction"]["grid"] is None:
        values["abstraction"]["cuts"] = spec.region_cuts
    return parse(values)


def _demonstrations(config: Config, teacher: TeacherConfig, env: Any, tested: Any, spec: Spec) -> Demonstrations:
    """What a teacher shows; raises `ConfigError` if that is not what it should be."""
    if teacher.source == "map":
        demos = teachers.shortest_paths(env)
    else:
        demos = teachers.load(Path(teacher.source), env=config.env.name, spec=spec)
    if teacher.kind == "action" and demos.actions is None:
        raise ConfigError(f"sgim.teachers: {teacher.source} shows no actions; {teacher.name} cannot be of kind action")
    if teacher.flaw == "repetitive":
        return teachers.repetitive(demos)
    if teacher.flaw == "other_body":
        return teachers.other_body(demos)
    if teacher.flaw == "wrong_half":
        return teachers.wrong_half(demos, spec.goal_point(tested.reset(jax.random.key(0)).obs))
    return demos


def _a_goal(spec: Spec, env: Any) -> np.ndarray:
    """A goal that `env` draws, as an abstract point [d]; dimensions that goals leave open are 0."""
    goal = env.draw_goal(jax.random.key(0))
    return np.asarray(spec.goal_point(jax.numpy.concatenate([jax.numpy.zeros(spec.state_dim), goal])))


def make_env(config: Config, goals: str, **others: Any) -> Any:
    """The task of `config`: on its test goals with "test", as for training with "train"; `others` are options too."""
    if goals == "train":
        options = {"goals": goals} | config.env.options | config.env.training | others
    else:
        options = config.env.options | {"goals": goals} | others
    try:
        return envs.make(config.env.name, engine=config.env.engine, **options)
    except envs.EnvError as error:
        raise ConfigError(f"env: {error}") from None


@contextlib.contextmanager
def interruptible(on_first: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether Ctrl-C was pressed, upon which it calls `on_first`; a second one stops."""
    pressed = False

    def on_interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True
        on_first()

    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
