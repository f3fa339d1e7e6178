"""An experiment, as training sees it: pure functions over the states of several seeds, and views for people.

    class Bandit(Experiment):                    # in a file of the user's own
        steps_per_epoch = 100

        @over_seeds
        def init(self, hyper, key): ...          # a state with `epoch`, for one seed

        @over_seeds
        def epoch(self, hyper, data, state): ... # the next state and scalars

        @over_seeds
        def evaluate(self, hyper, state, key): ...

        def rows(self, evaluated): ...           # on the host: a mapping of numbers for each seed

Training jits `init`, `epoch` and `evaluate`, and asks for the rest on the host.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial, wraps
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from star.training.figures import measures_figure

Row = Mapping[str, Any]
PARTS = ("steps_per_epoch", "init", "epoch", "evaluate", "rows")
"""The parts that every experiment must have; all others have defaults."""


def over_seeds(function: Callable[..., Any]) -> Callable[..., Any]:
    """A method for one seed, for all of them: its arguments have a leading axis of seeds, `data` has none.

    The floats of `hyper` are scalars, or have that axis too.
    """
    _, _, *names = inspect.signature(function).parameters

    @wraps(function)
    def lifted(self: Any, hyper: Any, *args: Any) -> Any:
        axes = (_axis(hyper), *(None if name == "data" else 0 for name in names))
        return _mapped(partial(function, self), axes, (hyper, *args))

    return lifted


def _mapped(function: Callable[..., Any], axes: tuple[int | None, ...], args: tuple[Any, ...]) -> Any:
    """`function` over the first axis of the `args` where `axes` says 0. vmap traces loops twice: one seed has none."""
    mapped = [arg for arg, axis in zip(args, axes, strict=True) if axis is not None]
    if {leaf.shape[0] for leaf in jax.tree.leaves(mapped)} != {1}:
        return jax.vmap(function, in_axes=axes)(*args)
    firsts = [
        arg if axis is None else jax.tree.map(lambda leaf: leaf[0], arg) for arg, axis in zip(args, axes, strict=True)
    ]
    return jax.tree.map(lambda leaf: leaf[None], function(*firsts))


def numbers(evaluated: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """The evaluation, [S] by its name, as plain numbers by their names for each seed."""
    return [dict(zip(evaluated, map(float, row), strict=True)) for row in zip(*evaluated.values(), strict=True)]


def _axis(hyper: Any) -> int | None:
    """The axis of `hyper` under a vmap over seeds: none if its floats are scalars."""
    leaves = jax.tree.leaves(hyper)
    return 0 if leaves and np.ndim(leaves[0]) else None


class Experiment:
    """A learning experiment. Subclasses have at least the `PARTS`; states are pytrees with axis [S] of seeds first."""

    steps_per_epoch: int
    """Env steps, or iterations, of one seed in one epoch."""
    init: Callable[..., Any]
    """(hyper, keys [S]) -> states; they hold `epoch` [S], whole numbers from 0 on."""
    epoch: Callable[..., Any]
    """(hyper, data, states) -> (states, scalars [S] by their names); the states given are used up."""
    evaluate: Callable[..., Any]
    """(hyper, states, keys [S]) -> what `rows` takes."""
    rows: Callable[..., list[dict[str, Any]]]
    """The evaluation, on the host -> for each seed its measures and other numbers by their names."""

    def __init__(self, config: Any) -> None:
        """Make the experiment of `config`; raises `UserError` if that is not possible on this machine."""
        self.config = config
        """The settings, with what this machine makes of them."""

    def resolve(self, config: Any) -> Any:
        """Other settings of this structure, with what this machine makes of them."""
        return config

    def data(self) -> Any:
        """The data of an epoch besides the state; raises `UserError` before anything is written."""
        return ()

    def tables(self, hyper: Any, state: Any, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """Rows to write down at an evaluation besides metrics, one a seed, or none."""
        return []

    def figures(self, rows: Sequence[Row], tables: Sequence[Row]) -> Mapping[str, Any]:
        """Matplotlib figures by their names, from all rows of metrics and of `tables`."""
        return {"summary": measures_figure(rows, self.config)}

    def notes(self) -> list[str]:
        """Lines that a run says before it starts."""
        return []

    def facts(self, rows: Sequence[Row]) -> Mapping[str, str]:
        """Facts of the latest epoch for the console, besides measures."""
        return {}

    def placement(self, state: Any, mesh: Mesh | None, whole: Any) -> Any:
        """Sharding of the leaves of `state` (shapes) between epochs; `whole` has each of them whole on every device."""
        return whole

    def scratch(self, seeds: int) -> Mapping[str, int]:
        """Bytes of what comes and goes in an epoch, by the names of settings that make it large."""
        return {}
