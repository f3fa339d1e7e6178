"""Checkpoints: whole runs on disk, written by orbax under `checkpoints/<env_steps>/` with their configuration inside.

The latest few are kept and, besides, the one with the best evaluation.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies

from star import program as programs
from star.config import Config, ConfigError
from star.loading import fields, parse
from star.program import Program
from star.state import TrainState

FORMAT = 2  # since `refinement.neighbours` and `refinement.parts`
_HARMLESS = (
    "env.engine",
    "trainer.total_env_steps",
    "trainer.device",
    "trainer.eval_",
    "trainer.checkpoint_",
    "trainer.keep_",
    "trainer.on_non_finite",
    "trainer.rollbacks",
    "trainer.sinks",
)


class Checkpoints:
    """The checkpoints of one run directory."""

    def __init__(self, run_dir: Path, *, keep: int = 3) -> None:
        self._path = (run_dir / "checkpoints").absolute()
        self._keep = keep
        self._manager: ocp.CheckpointManager | None = None

    def save(self, env_steps: int, state: TrainState, config: Config, *, success: float) -> None:
        """Write `state` as `checkpoints/<env_steps>`; `success` is the latest evaluation's, which decides the best."""
        self._open().save(
            env_steps,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(_plain(state)),
                config=ocp.args.JsonSave({"format": FORMAT, "config": config.model_dump(mode="json")}),
            ),
            metrics={"success_final": success},
            force=True,
        )

    def steps(self) -> list[int]:
        """Env steps of the checkpoints on disk, oldest first."""
        if not self._path.is_dir():
            return []
        return sorted(int(entry.name) for entry in self._path.iterdir() if entry.name.isdigit())

    def best(self) -> int:
        """Env steps of the checkpoint with the best evaluation, the latest of equals."""
        step = self._open().best_step()
        return self.steps()[-1] if step is None else int(step)

    def config(self, step: int) -> Config:
        """The configuration inside a checkpoint."""
        path = self._path / str(step)
        try:
            saved = self._open().restore(step, args=ocp.args.Composite(config=ocp.args.JsonRestore()))["config"]
            number = saved["format"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: is damaged, its config cannot be read: {_reason(error)}") from None
        if isinstance(number, int) and number > FORMAT:
            raise ConfigError(f"{path}: checkpoint format {number} is newer than {FORMAT}, which this version reads")
        if number != FORMAT:
            raise ConfigError(f"{path}: checkpoint format {number} is not {FORMAT}")
        return parse(saved["config"], source=str(path))

    def restore(self, step: int, example: TrainState) -> TrainState:
        """The state saved at `step`, whatever devices it was saved on.

        `example` (arrays or their shapes) gives the structure it must have, and the devices: else the first one here.
        """
        here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
        shapes = jax.eval_shape(_plain, example)
        template = jax.tree.map(
            lambda x, like: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=getattr(like, "sharding", None) or here),
            shapes,
            example,
        )
        args = ocp.args.Composite(state=ocp.args.StandardRestore(template))
        hook, sys.unraisablehook = sys.unraisablehook, partial(_report, sys.unraisablehook)
        try:
            saved = self._open().restore(step, args=args)["state"]
        except (OSError, ValueError, KeyError, TypeError) as error:  # the hook stays, for reads that end after this
            raise ConfigError(
                f"{self._path / str(step)}: is damaged, or not a checkpoint of this configuration: {_reason(error)}"
            ) from None
        sys.unraisablehook = hook
        return _with_keys(saved, example)

    def close(self) -> None:
        """Release orbax's threads."""
        if self._manager is not None:
            self._manager.close()
            self._manager = None

    def _open(self) -> ocp.CheckpointManager:
        if self._manager is None:
            keep = policies.AnyPreservationPolicy(
                [
                    policies.LatestN(self._keep),
                    policies.BestN(get_metric_fn=_success, n=1, keep_checkpoints_without_metrics=False),
                ]
            )
            self._manager = ocp.CheckpointManager(
                self._path,
                options=ocp.CheckpointManagerOptions(
                    preservation_policy=keep,
                    best_fn=_success,
                    enable_async_checkpointing=False,
                ),
                item_names=("state", "config"),
            )
        return self._manager


def load_state(program: Program, run_dir: Path, wanted: str) -> tuple[int, TrainState]:
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
    return checkpoints.restore(step, program.example())


def load_agent(
    config: Config, run_dir: Path, *, checkpoint: str, agent: int | None, seed: int
) -> tuple[Program, TrainState, jax.Array]:
    """The agent of seed `agent` (None: the first) in a checkpoint of `run_dir`, and the key of its episodes.

    `seed` is the one that a user chose for the evaluation.
    """
    program = programs.build(config)
    number = agent_number(program, run_dir, agent)
    _, states = load_state(program, run_dir, checkpoint)
    key = program.evaluation_keys(seed, stream=programs.AFTERWARDS)[number]
    return program, jax.tree.map(lambda leaf: leaf[number], states), key


def agent_number(program: Program, run_dir: Path, agent: int | None) -> int:
    """Which of the agents of `run_dir` has the seed `agent` (None: the first)."""
    if agent is None:
        return 0
    if agent not in program.seeds:
        raise ConfigError(f"--seed: {agent} is not among those of {run_dir}: {', '.join(map(str, program.seeds))}")
    return program.seeds.index(agent)


def check_compatible(saved: Config, wanted: Config, *, source: Path) -> None:
    """Raise ConfigError, naming the first key that differs, if a checkpoint of `saved` cannot go on under `wanted`.

    Numeric hyperparameters may change; the environment, shapes and algorithms may not.
    """
    before, after = (config.model_dump(mode="json") for config in (saved, wanted))
    for key, default, _ in fields():
        if isinstance(default, float) or key.startswith(_HARMLESS):
            continue
        old, new = _lookup(before, key), _lookup(after, key)
        if old != new:
            raise ConfigError(f"{source}: its checkpoint was made with {key} {old}, not {new}")


def _lookup(values: dict[str, Any], dotted: str) -> Any:
    for part in dotted.split("."):
        values = values[part]
    return values


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


def _report(hook: Callable[[Any], Any], failure: Any) -> None:
    """Tell `hook` of a failure in the background, unless it is that of a read that outlived a failed restore."""
    if "Event loop is closed" not in str(failure.exc_value):
        hook(failure)


def _success(metrics: Any) -> float:
    return metrics["success_final"]


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(state: TrainState) -> TrainState:
    """Random keys as the integers they are made of, which is what can be written."""
    return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else x, state)


def _with_keys(saved: Any, example: TrainState) -> TrainState:
    return jax.tree.map(lambda x, like: jax.random.wrap_key_data(x) if _is_key(like) else x, saved, example)
