"""Many runs in one program, for sweeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from envs.common.batching import where
from star import evaluation, memory
from star import program as programs
from star.agent.sections import Config
from star.agent.state import TrainState
from star.metrics import of_epoch

_where = jax.jit(where)


class SideBySide:
    """Runs that share their `program.structure`, trained in one program. Each has a slot, and may come and go.

    What a run does depends on nothing but its own config, so it is what `train` would do.
    """

    def __init__(self, config: Config, slots: int) -> None:
        """Compile for `slots` runs like `config`; raises `UserError` if it cannot be trained."""
        program = programs.build(config)
        program.lessons()
        memory.check(program, copies=slots)
        self.slots = slots
        self.epochs = program.epochs
        self.env_steps_per_epoch = program.env_steps_per_epoch * config.trainer.num_seeds
        self._program = program
        self._configs = [program.config] * slots
        self._state: TrainState | None = None

    def put(self, runs: Mapping[int, Config]) -> None:
        """Begin new runs in these slots; what was there is gone."""
        for slot, config in runs.items():
            self._configs[slot] = programs.resolve(config, self._program.config.env.engine, self._program.spec)
        each = self._program.config.trainer.num_seeds
        agent = jax.tree.map(
            lambda *leaves: np.repeat(np.asarray(leaves, np.float32), each), *[one.agent() for one in self._configs]
        )
        self._program = replace(self._program, agent=agent)
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
            episodes = self._program.evaluate(self._state, keys)
            evaluation.add_to(table, episodes, where=due)
        for row, epochs in zip(table, done, strict=True):
            row["env_steps"] = int(epochs) * self._program.env_steps_per_epoch
        each = settings.num_seeds
        return [table[slot * each : (slot + 1) * each] for slot in range(self.slots)]

    def _seeds(self) -> list[int]:
        return [seed for config in self._configs for seed in programs.seeds_of(config)]
