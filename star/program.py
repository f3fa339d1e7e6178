"""What is compiled of a run: its environments and jitted functions, and the random keys that these start from."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

import envs
from envs import arena
from envs.common import files, modes, reading
from envs.options import normal
from envs.vector import VectorEnv
from star import devices, faults, learners
from star.agent import checks, levels, play
from star.agent import epoch as learning
from star.agent.play import Episode
from star.agent.sections import AgentConfig, Config
from star.agent.state import TrainState
from star.config.section import ConfigError
from star.loading import parse
from star.sgim import teachers
from star.sgim.sections import TeacherConfig
from star.sgim.teachers import Demonstrations
from star.spec import Spec

# Streams of random keys that no seed of training uses.
DURING_TRAINING = 2**32 - 1
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
    """What the teachers show, read when it is first needed; raises `UserError`."""
    functions: Functions

    def init(self, keys: jax.Array) -> TrainState:
        """Fresh runs, one from each key."""
        return self.functions.init(self.agent, keys)

    def example(self) -> TrainState:
        """The shapes of `init`, and where its arrays lie."""
        return jax.eval_shape(self.functions.init, self.agent, self.seed_keys())

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
        return seeds_of(self.config)

    def seed_keys(self) -> jax.Array:
        """Keys that the states of all seeds start from."""
        return seed_keys(self.seeds)

    def evaluation_keys(self, number: int, *, stream: int = DURING_TRAINING) -> jax.Array:
        """Keys of one evaluation, one per seed, apart from all keys of training.

        `number` is the epoch in the stream of evaluations during training, or the seed that a user chose afterwards.
        """
        return evaluation_keys(self.seeds, [number] * len(self.seeds), stream=stream)


def build(config: Config) -> Program:
    """Make the environments and the jitted functions of `config`; raises `UserError` if they cannot be made."""
    select_device(config.trainer.device)
    modes.check_training()
    env, test_env = (make_env(config, goals) for goals in ("train", "test"))
    spec = Spec.of(env, heading=config.tutor.heading if config.tutor.enabled else None)
    config = resolve(config, env.engine, spec)
    try:
        checks.check(config, spec)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    mesh = devices.mesh(config.trainer.devices)
    trained = VectorEnv(env, config.trainer.num_envs, auto_reset=False)
    episodes = config.trainer.eval_episodes
    surplus = -episodes % config.trainer.devices  # each device plays as many
    tested = VectorEnv(test_env, episodes + surplus, auto_reset=False)
    on_test = spec.within(test_env)
    if on_test.episode_length % config.tutor.period:
        raise ConfigError(
            f"tutor.period: {config.tutor.period} does not divide the test episode of {on_test.episode_length}"
        )

    @cache
    def lessons() -> tuple[Demonstrations, ...]:
        return tuple(_demonstrations(config, teacher, env, test_env, spec) for teacher in config.sgim.teachers)

    def init(agent: AgentConfig, keys: jax.Array) -> Any:
        return jax.vmap(lambda one, key: levels.init(one, spec, key=key), in_axes=(_axis(agent), 0))(agent, keys)

    def epoch(agent: AgentConfig, lessons: Any, state: TrainState) -> Any:
        def one_epoch(one: AgentConfig, state: TrainState) -> Any:
            state, metrics = learning.epoch(one, spec, trained, state, teachers=lessons)
            return state, metrics | faults.count(state)

        state, metrics = jax.vmap(one_epoch, in_axes=(_axis(agent), 0))(agent, state)
        return _as_on_first(state, placement), metrics

    def evaluate(agent: AgentConfig, state: TrainState, keys: jax.Array) -> Any:
        def one_evaluation(one: AgentConfig, state: TrainState, key: jax.Array) -> Any:
            played = play.evaluate(one, on_test, tested, state, key=key)
            return jax.tree.map(lambda x: x[:episodes], devices.whole(played))

        return jax.vmap(one_evaluation, in_axes=(_axis(agent), 0, 0))(agent, state, keys)

    placement = _placement(config, mesh, jax.eval_shape(init, config.agent(), seed_keys([0])))
    everywhere = devices.everywhere(mesh)
    functions = Functions(
        init=jax.jit(init, out_shardings=placement),
        epoch=jax.jit(devices.on(mesh, epoch), donate_argnums=2, out_shardings=(placement, everywhere)),
        evaluate=jax.jit(devices.on(mesh, evaluate), out_shardings=everywhere),
    )
    return Program(
        config=config,
        spec=spec,
        walls=np.asarray(env.arena.walls()),
        goal=_a_goal(spec, test_env),
        agent=config.agent(),
        lessons=lessons,
        functions=functions,
    )


def select_device(device: str) -> None:
    """Make JAX use the device that `trainer.device` asks for; raises `UserError` if there is none."""
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    if device == "gpu" and jax.default_backend() != "gpu":
        raise ConfigError(
            f"trainer.device: 'gpu' is not available, JAX sees only {jax.default_backend()}; "
            'install with pip install "star-rl[cuda,warp]" on a machine with an NVIDIA GPU, or use auto or cpu'
        )


def resolve(config: Config, engine: str, spec: Spec) -> Config:
    """`config` with the engine, the map, the initial cuts and the teachers' files that are really used."""
    values = config.model_dump(mode="json")
    values["env"]["engine"] = engine
    for key in ("options", "training"):
        options = values["env"][key] = normal(values["env"][key])
        if "map" in options:  # the run must not change with the file
            options["map"] = arena.load(options["map"])
    for teacher in values["sgim"]["teachers"]:
        teacher["sha256"] = teacher["sha256"] or _checksum(teacher["source"])
    if values["abstraction"]["cuts"] is None and values["abstraction"]["grid"] is None:
        values["abstraction"]["cuts"] = spec.region_cuts
    return parse(values)


def _checksum(source: str) -> str | None:
    """That of a teacher's file; None if there is none to read, which is told when its lessons are needed."""
    try:
        reading.check_regular(Path(source))
        return files.sha256(Path(source))
    except (OSError, ValueError):
        return None


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


def structure(config: Config) -> str:
    """What runs must share to be trained `SideBySide`: everything but the agent's floats and the first seed."""
    values = config.model_dump(mode="json", exclude={"trainer": {"seed"}})
    same = jax.tree.map(lambda _: 0.0, config.agent())
    return json.dumps(values | same.model_dump(mode="json"), sort_keys=True)


def seeds_of(config: Config) -> list[int]:
    """The seeds of a run."""
    first = config.trainer.seed
    return list(range(first, first + config.trainer.num_seeds))


def seed_keys(seeds: Sequence[int]) -> jax.Array:
    """Keys that the states of these seeds start from."""
    return jax.vmap(modes.key)(np.asarray(seeds, np.uint32))


def evaluation_keys(seeds: Sequence[int], numbers: Sequence[int] | np.ndarray, *, stream: int) -> jax.Array:
    """Keys of one evaluation of each seed; `numbers` are those of `Program.evaluation_keys`."""
    base, fold = modes.key(stream), jax.random.fold_in
    return jax.vmap(lambda number, seed: fold(fold(base, number), seed))(
        np.asarray(numbers, np.uint32), np.asarray(seeds, np.uint32)
    )


def _placement(config: Config, mesh: Mesh | None, state: TrainState) -> TrainState:
    """Where the leaves of `state` lie between epochs: what the learners of levels cut in shares, all else whole."""
    places = jax.tree.map(lambda _: devices.everywhere(mesh), state)

    def of(axis: int) -> Any:
        return devices.everywhere(mesh) if axis == learners.WHOLE else devices.in_shares(mesh, axis=1 + axis)

    levels = {
        name: jax.tree.map(of, learners.find(level.learner).shards(getattr(state, name)))
        for name, level, _ in config.learners()
    }
    return places.replace(**levels)


def _as_on_first(state: TrainState, placement: TrainState) -> TrainState:
    """`state` with the first device's values in all that is whole on each."""
    leaves, structure = jax.tree.flatten(state)
    copies = [place.is_fully_replicated for place in jax.tree.leaves(placement)]
    same = iter(devices.as_on_first([leaf for leaf, copy in zip(leaves, copies, strict=True) if copy]))
    return jax.tree.unflatten(
        structure, [next(same) if copy else leaf for leaf, copy in zip(leaves, copies, strict=True)]
    )


def _axis(agent: AgentConfig) -> int | None:
    """The axis of `agent` under a vmap over states: none if its floats are scalars."""
    return 0 if np.ndim(jax.tree.leaves(agent)[0]) else None


def _demonstrations(config: Config, teacher: TeacherConfig, env: Any, tested: Any, spec: Spec) -> Demonstrations:
    """What a teacher shows; raises `UserError` if that is not what it should be."""
    if teacher.source == "map":
        demos = teachers.shortest_paths(env)
    else:
        demos = teachers.load(Path(teacher.source), env=config.env.name, spec=spec, sha256=teacher.sha256)
    if teacher.kind == "action" and demos.actions is None:
        raise ConfigError(f"sgim.teachers: {teacher.source} shows no actions; {teacher.name} cannot be of kind action")
    if teacher.flaw == "repetitive":
        return teachers.repetitive(demos)
    if teacher.flaw == "other_body":
        return teachers.other_body(demos)
    if teacher.flaw == "wrong_half":
        return teachers.wrong_half(demos, spec.goal_point(tested.reset(modes.key(0)).obs))
    return demos


def _a_goal(spec: Spec, env: Any) -> np.ndarray:
    """A goal that `env` draws, as an abstract point [d]; dimensions that goals leave open are 0."""
    goal = env.draw_goal(modes.key(0))
    return np.asarray(spec.goal_point(jax.numpy.concatenate([jax.numpy.zeros(spec.state_dim), goal])))
