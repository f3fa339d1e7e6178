"""The compiled part of a run: the jitted functions of its experiment, and the random keys that these start from."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from numbers import Integral
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.common import extras, modes, plugins
from envs.common.errors import UserError
from star import devices
from star.config import kinds
from star.config.kinds import Kind
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.training import faults, own

# Streams of random keys that no seed of training uses.
DURING_TRAINING = 2**32 - 1
AFTERWARDS = 2**32 - 2


@dataclass(frozen=True)
class Functions:
    """The jitted functions of a `Program`. Hyperparameters come first: others of one structure need no compiling.

    States and keys have a leading axis. The floats of the hyperparameters are scalars or have that axis too.
    """

    init: jax.stages.Wrapped
    """(hyper, keys) -> states."""
    epoch: jax.stages.Wrapped
    """(hyper, data, states) -> (states, metrics); the states given are used up."""
    evaluate: jax.stages.Wrapped
    """(hyper, states, keys) -> what `Experiment.rows` takes."""


@dataclass(frozen=True)
class Program:
    """The compiled parts of a run. States and keys carry a leading axis of seeds."""

    kind: Kind
    experiment: Any
    config: Any
    """The settings of the run: those of `experiment`, or others of their structure."""
    hyper: Any
    """The traced part: the floats of `config`, or arrays of them with the leading axis of states and keys."""
    data: Callable[[], Any]
    """The data of an epoch besides the state, made at its first use; raises `UserError`."""
    functions: Functions

    def init(self, keys: jax.Array) -> Any:
        """Fresh runs, one from each key."""
        return self.functions.init(self.hyper, keys)

    def example(self) -> Any:
        """The shapes of `init`, and where its arrays lie."""
        return jax.eval_shape(self.functions.init, self.hyper, self.seed_keys())

    def epoch(self, state: Any) -> tuple[Any, dict[str, jax.Array]]:
        """Train for an epoch; `state` is used up."""
        return self.functions.epoch(self.hyper, self.data(), state)

    def evaluate(self, state: Any, keys: jax.Array) -> Any:
        """The experiment's evaluation of each state, such as greedy episodes on test goals."""
        return self.functions.evaluate(self.hyper, state, keys)

    def check(self) -> None:
        """Trace an epoch and the evaluation, as before they are compiled; raises `UserError` for a user's mistake."""
        state = self.example()
        jax.eval_shape(self.functions.epoch, self.hyper, self.data(), state)
        jax.eval_shape(self.functions.evaluate, self.hyper, state, self.evaluation_keys(0))

    def prepare(self) -> None:
        """Compile an epoch and the evaluation side by side; errors are left to each one's first use.

        Nothing may compile while an epoch runs: XLA tries kernels on the GPU, which breaks the CUDA graph that MJX-Warp
        records at its first step ("capturing stream has unjoined work").
        """
        with ThreadPoolExecutor() as pool:
            wait([pool.submit(self._compile, pool)])

    def _compile(self, pool: ThreadPoolExecutor) -> None:
        """Compile an epoch, and in other threads what is needed after it."""
        epoch, evaluate, state = self.functions.epoch, self.functions.evaluate, self.example()
        traced = epoch.lower(self.hyper, self.data(), state)  # first of all: Python traces one at a time
        pool.submit(lambda: evaluate.lower(self.hyper, state, self.evaluation_keys(0)).compile())
        pool.submit(import_module, "matplotlib.figure")
        traced.compile()

    def rows(self, evaluated: Any) -> list[dict[str, Any]]:
        """The evaluation of each seed, as plain numbers with the keys of rows of metrics."""
        return [
            {f"eval/{name}": value for name, value in row.items()}
            for row in self.experiment.rows(jax.device_get(evaluated))
        ]

    @property
    def steps_per_epoch(self) -> int:
        """Env steps, or iterations, of one seed in one epoch."""
        return self.experiment.steps_per_epoch

    @property
    def epochs(self) -> int:
        """Epochs that make up at least `total_env_steps`."""
        return -(-self.config.trainer.total_env_steps // self.steps_per_epoch)

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
        Raises `UserError` if it is no whole number from 0 to 2^31 - 1.
        """
        if not (isinstance(number, Integral) and 0 <= number < 2**31):
            raise UserError(f"seed of an evaluation: {number!r} is not a whole number from 0 to 2^31 - 1")
        return evaluation_keys(self.seeds, [number] * len(self.seeds), stream=stream)


def build(config: RunConfig) -> Program:
    """Make the experiment of `config` and its jitted functions; raises `UserError` if they cannot be made."""
    select_device(config.trainer.device)
    modes.check_training()
    kind = kinds.of(config)
    experiment = own.build(kind, config) if plugins.is_plugin(config.experiment) else kind.build(config)
    hyper = experiment.config.hyper()
    mesh = devices.mesh(config.trainer.devices)
    everywhere = devices.everywhere(mesh)
    shapes = jax.eval_shape(experiment.init, hyper, seed_keys([0]))
    placement = experiment.placement(shapes, mesh, jax.tree.map(lambda _: everywhere, shapes))

    def epoch(hyper: Any, data: Any, state: Any) -> Any:
        state, metrics = experiment.epoch(hyper, data, state)
        counts = jax.vmap(lambda one: faults.count(one, may_be_nan=kind.may_be_nan))(state)
        return _as_on_first(state, placement), metrics | counts

    functions = Functions(
        init=jax.jit(experiment.init, out_shardings=placement),
        epoch=jax.jit(devices.on(mesh, epoch), donate_argnums=2, out_shardings=(placement, everywhere)),
        evaluate=jax.jit(devices.on(mesh, experiment.evaluate), out_shardings=everywhere),
    )
    return Program(kind, experiment, experiment.config, hyper, cache(experiment.data), functions)


def select_device(device: str) -> None:
    """Make JAX use the device that `trainer.device` asks for, and keep what it compiles for a GPU.

    Raises `UserError` if there is none.
    """
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    if device == "gpu" and jax.default_backend() != "gpu":
        raise ConfigError(
            f"trainer.device: 'gpu' is not available, JAX sees only {jax.default_backend()}; "
            f"on a machine with an NVIDIA GPU {extras.install('cuda', 'warp')}, or use auto or cpu"
        )
    _keep_compiled()


def _keep_compiled() -> None:
    """For a GPU keep programs in the user's cache, for later runs, unless JAX is told where."""
    if jax.default_backend() == "gpu" and jax.config.values["jax_compilation_cache_dir"] is None:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(home / "star" / "jax"))


def structure(config: RunConfig) -> str:
    """The part that runs must share to be trained `SideBySide`: everything but traced floats and the first seed."""
    values = config.model_dump(mode="json", exclude={"trainer": {"seed"}})
    same = jax.tree.map(lambda _: 0.0, config.hyper())
    return json.dumps(values | same.model_dump(mode="json"), sort_keys=True)


def seeds_of(config: RunConfig) -> list[int]:
    """The seeds of a run."""
    first = config.trainer.seed
    return list(range(first, first + config.trainer.num_seeds))


def seed_keys(seeds: Sequence[int]) -> jax.Array:
    """Keys that the states of these seeds start from."""
    return jax.vmap(modes.key)(np.asarray(seeds, np.uint32))


def evaluation_keys(seeds: Sequence[int], numbers: Sequence[int] | np.ndarray, *, stream: int) -> jax.Array:
    """Keys of one evaluation of each seed; `numbers` are those of `Program.evaluation_keys`."""
    return _folded(np.asarray(numbers, np.uint32), np.asarray(seeds, np.uint32), stream)


@partial(jax.jit, static_argnums=2)
def _folded(numbers: jax.Array, seeds: jax.Array, stream: int) -> jax.Array:
    base, fold = modes.key(stream), jax.random.fold_in
    return jax.vmap(lambda number, seed: fold(fold(base, number), seed))(numbers, seeds)


def _as_on_first(state: Any, placement: Any) -> Any:
    """`state` with the first device's values in all that is whole on each."""
    leaves, structure = jax.tree.flatten(state)
    copies = [place.is_fully_replicated for place in jax.tree.leaves(placement)]
    same = iter(devices.as_on_first([leaf for leaf, copy in zip(leaves, copies, strict=True) if copy]))
    return jax.tree.unflatten(
        structure, [next(same) if copy else leaf for leaf, copy in zip(leaves, copies, strict=True)]
    )
