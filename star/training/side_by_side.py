"""Many runs in one program, for sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from envs.common.batching import where
from star.config.run import RunConfig
from star.training import memory_budget
from star.training import program as programs
from star.training.journal import of_epoch

_where = jax.jit(where)


class SideBySide:
    """Runs that share their `program.structure`, trained in one program. Each has a slot, and may come and go.

    What a run does depends on nothing but its own config, so it is what `train` would do.
    """

    def __init__(self, config: RunConfig, slots: int) -> None:
        """Compile for `slots` runs like `config`; raises `UserError` if it cannot be trained."""
        program = programs.build(config)
        program.data()
        memory_budget.check(program, copies=slots)
        self.slots = slots
        self.epochs = program.epochs
        self.steps_per_epoch = program.steps_per_epoch * config.trainer.num_seeds
        self._program = program
        self._configs = [program.config] * slots
        self._state: Any = None

    def put(self, runs: Mapping[int, RunConfig]) -> None:
        """Begin new runs in these slots; what was there is gone."""
        for slot, config in runs.items():
            self._configs[slot] = self._program.experiment.resolve(config)
        each = self._program.config.trainer.num_seeds
        hyper = jax.tree.map(
            lambda *leaves: np.repeat(np.asarray(leaves, np.float32), each), *[one.hyper() for one in self._configs]
        )
        self._program = replace(self._program, hyper=hyper)
        fresh = self._program.init(programs.seed_keys(self._seeds()))
        if self._state is None:
            self._state = fresh
        else:
            new = np.repeat([slot in runs for slot in range(self.slots)], each)
            self._state = _where(new, fresh, self._state)

    def advance(self) -> list[list[dict[str, Any]]]:
        """Train all slots for an epoch: the metrics of each seed, for each slot, with `eval/` where it is time."""
        assert self._state is not None
        settings, seeds = self._program.config.trainer, self._seeds()
        self._state, metrics = self._program.epoch(self._state)
        table = of_epoch(metrics, seeds)
        done = np.asarray(self._state.epoch)
        due = (done % settings.eval_every == 0) | (done == self.epochs)
        if due.any():
            keys = programs.evaluation_keys(seeds, done, stream=programs.DURING_TRAINING)
            found = self._program.rows(self._program.evaluate(self._state, keys))
            for row, measured, now in zip(table, found, due, strict=True):
                row |= measured if now else {}
        for row, epochs in zip(table, done, strict=True):
            row["env_steps"] = int(epochs) * self._program.steps_per_epoch
        each = settings.num_seeds
        return [table[slot * each : (slot + 1) * each] for slot in range(self.slots)]

    def _seeds(self) -> list[int]:
        return [seed for config in self._configs for seed in programs.seeds_of(config)]
