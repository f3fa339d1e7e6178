"""Profiling: a trace of some epochs by JAX's profiler, for Perfetto and XProf, and a stopwatch."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self, TypeVar

import jax

from star.config.section import ConfigError

T = TypeVar("T")


class Profile:
    """Traces the epochs after `first` to `first + epochs` and says how to open the trace; ends with its context.

    A profiler that fails is warned of in one line; training goes on.
    """

    def __init__(
        self, folder: Path, *, first: int, epochs: int, say: Callable[[str], None], warn: Callable[[str], None]
    ) -> None:
        self._folder, self._say, self._warn = folder, say, warn
        self._first, self._last = first, first + epochs
        self._on = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def before(self, done: int) -> None:
        """Begin, if the next epoch is the first to be traced; `done` epochs are over."""
        if done == self._first < self._last:
            try:
                jax.profiler.start_trace(self._folder)
                self._on = True
            except Exception as error:  # of a profiler that is on already, or of the disk
                self._warn(_failed(error))

    def after(self, done: int) -> None:
        """End, if the last of them is over."""
        if done >= self._last:
            self._close()

    def _close(self) -> None:
        if not self._on:
            return
        self._on = False
        try:
            jax.profiler.stop_trace()
            newest = max(self._folder.rglob("*.trace.json.gz"), key=lambda path: path.stat().st_mtime)
        except Exception as error:
            self._warn(_failed(error))
            return
        self._say(f"profile: open {newest} in Perfetto (ui.perfetto.dev), or {self._folder} in XProf")


def timed(function: Callable[..., T], *arguments: Any) -> tuple[float, T]:
    """Seconds of a call, its result awaited, and what it returns."""
    began = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return time.perf_counter() - began, result


def plan(*, done: int, total: int, eval_every: int, epochs: int) -> int:
    """After how many epochs a trace of `epochs` epochs begins: nothing compiles while it lasts.

    `done` of `total` epochs are over; the next one compiles, and so does the first evaluation. Raises `UserError` if
    too few epochs are left.
    """
    first = done + 1
    evaluation = min(done + eval_every - done % eval_every, total)
    if first < evaluation < first + epochs:
        first = evaluation
    if first + epochs > total:
        raise ConfigError(
            f"--profile: {epochs} epochs cannot be traced after the {first - done} that compile: "
            f"{max(total - done, 0)} are left to train (see --total-env-steps)"
        )
    return first


def _failed(error: Exception) -> str:
    return f"--profile: {' '.join(str(error).split())[:200]}; training goes on without a trace"
