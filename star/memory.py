"""The memory that a run needs at least: one that cannot fit is refused before anything is written."""

from __future__ import annotations

import math
import os
from typing import Any

import jax

from star.agent import levels
from star.config.section import ConfigError
from star.program import Program

_NUMBER = 4  # bytes


def check(program: Program, *, copies: int = 1) -> None:
    """Raise `UserError` if so many runs of `program` side by side cannot fit into the memory of the device."""
    found, room = needed(program), available(program.config.trainer.devices)
    total = copies * sum(found.values())
    if total > room:
        largest = max(found, key=lambda name: found[name])
        raise ConfigError(
            f"the run needs at least {_size(total)} of memory, {_size(copies * found[largest])} of it for {largest}; "
            f"there are {_size(room)}"
        )


def needed(program: Program) -> dict[str, int]:
    """Bytes for each part of the state, and for the largest of what comes and goes in an epoch; a lower bound."""
    found = {name: _bytes(part) for name, part in vars(program.example()).items() if name != "key"}
    passing = _passing(program)
    largest = max(passing, key=lambda name: passing[name])
    found[largest] = found.get(largest, 0) + passing[largest]
    return found


def available(devices: int = 1) -> int:
    """Bytes of the memory of so many devices like the first one here, or of the machines where it does not tell."""
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    if limit:
        return devices * limit
    return jax.process_count() * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _passing(program: Program) -> dict[str, int]:
    """Bytes of rollouts, and of what networks keep of a batch to learn from it."""
    config, seeds = program.config, len(program.seeds)
    tutor, model, near = config.tutor, config.forward_model, config.tutor.adjacency
    found = {}
    if config.commander.enabled:
        found["forward_model"] = seeds * _activations(model.batch_size, model.hidden)
    if tutor.off_policy_correction:  # the Controller's policy for each candidate
        hidden = getattr(config.controller.settings, "hidden", ())
        rows = tutor.correction_candidates * getattr(tutor.settings, "batch_size", 0) * tutor.period
        found["tutor.correction_candidates"] = seeds * _activations(rows, hidden[:1])
    if near.enabled:
        found["tutor.adjacency"] = seeds * _activations(near.batch_size, (*near.hidden, near.features))
    agent = levels.of(config.agent(), program.spec)
    for name, level, rollout in config.learners():
        example = getattr(agent, name).example(level, agent.task)
        found[f"{name}, trainer.num_envs"] = seeds * rollout.size * _bytes(example)
        found[f"{name}.{level.group}"] = seeds * level.settings.scratch_bytes(rollout)
    return found


def _activations(rows: int, hidden: tuple[int, ...]) -> int:
    return rows * sum(hidden) * _NUMBER


def _bytes(tree: Any) -> int:
    leaves = jax.tree.leaves(tree)
    return sum(math.prod(x.shape) * (x.dtype.itemsize if hasattr(x.dtype, "itemsize") else _NUMBER) for x in leaves)


def _size(count: int) -> str:
    return f"{count / 2**30:,.1f} GiB"
