"""Checks that a run can go on under other settings than those of its checkpoint."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from star.config import kinds
from star.config.loading import fields
from star.config.run import RunConfig
from star.config.section import ConfigError

_HARMLESS = (
    "trainer.total_env_steps",
    "trainer.device",
    "trainer.eval_",
    "trainer.checkpoint_",
    "trainer.keep_",
    "trainer.on_non_finite",
    "trainer.rollbacks",
    "trainer.sinks",
)


def check_compatible(saved: RunConfig, wanted: RunConfig, *, source: Path) -> None:
    """Raise ConfigError, naming the first key that differs, if a checkpoint of `saved` cannot go on under `wanted`.

    Numeric hyperparameters may change; the environment, shapes and algorithms may not.
    """
    for key, old, new in differences(saved, wanted):
        raise ConfigError(f"{source}: its checkpoint was made with {key} {old}, not {new}")


def differences(saved: RunConfig, wanted: RunConfig) -> Iterator[tuple[str, Any, Any]]:
    """(key, value in `saved`, value in `wanted`) of the settings that make them different runs."""
    if saved.experiment != wanted.experiment:
        yield "experiment", saved.experiment, wanted.experiment
        return
    before, after = saved.comparable(), wanted.comparable()
    harmless = (*_HARMLESS, *kinds.of(wanted).harmless)
    for key, default, _ in fields(type(wanted)):
        if isinstance(default, float) or key.startswith(harmless):
            continue
        old, new = _lookup(before, key), _lookup(after, key)
        if old != new:
            yield key, old, new


def _lookup(values: dict[str, Any], dotted: str) -> Any:
    for part in dotted.split("."):
        values = values[part]
    return values
