"""Tell whether an agent learns today as it did when a row of results was measured: its learning digest.

    python scripts/results/digest.py CONFIG [--with LAYER ...] [-- SETTINGS]

Prints the digest of what `star train` would train with the same words, as one line of JSON. The config is made small,
and trained for three epochs on the CPU. The digest holds

    settings  a hash of the config's settings that are no defaults, and of those that were made small
    moved     how far each part of the state is from its beginning, as a logarithm

A hash of all numbers would tell machines apart, for rounding depends on the processor. So `same` compares `moved` to
within .001. Another instruction set of the processor (SSE 4.2) or more optimisation makes 0, on Point and Ant Maze and
on Ant Fall, since episodes have 20 env steps only; with 60 it makes up to .008. A discount of the Tutor of .92 instead
of .9 makes .008 on the Point Maze. A change of code that moves less goes unseen.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scripts.processes import importing

ROOT = Path(__file__).parents[2]
EPOCHS = 3
CLOSE = 0.001  # of `moved`
HASTY = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"  # it compiles longer than it runs
SEED = 0  # of the tiny run, whatever seeds the row has
Digest = Mapping[str, Any]


def of(command: str) -> dict[str, Any]:
    """The digest of a `star train ...` command, computed in a process of its own without an accelerator.

    Seeds of the command do not matter. Raises `subprocess.CalledProcessError` if this code no longer takes it.
    """
    words = shlex.split(command)[2:]
    here = importing(ROOT) | {"JAX_PLATFORMS": "cpu", "MUJOCO_GL": "disable", "XLA_FLAGS": HASTY}
    script = [sys.executable, str(Path(__file__)), *words]
    done = subprocess.run(script, cwd=ROOT, env=os.environ | here, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def same(one: Digest | None, other: Digest | None) -> bool:
    """True if both are digests of one way of learning."""
    if not one or not other or one["settings"] != other["settings"] or one["moved"].keys() != other["moved"].keys():
        return False
    return all(abs(one["moved"][part] - other["moved"][part]) <= CLOSE for part in one["moved"])


def compute(config: Any) -> dict[str, Any]:
    """The digest of a resolved config of STAR."""
    import jax

    from star.training import program as programs

    values = config.model_dump(mode="json")
    large = {key: _find(values, key) for key in SMALL} | config.model_dump(mode="json", exclude_defaults=True)
    large.pop("trainer", None)  # seeds, budget and evaluations: the row itself tells them
    program = programs.build(made_small(config))
    state = program.init(program.seed_keys())
    begun = jax.device_get(jax.tree.map(lambda leaf: leaf.copy(), state))  # an epoch uses it up
    for _ in range(EPOCHS):
        state, _ = program.epoch(state)
    begun, ended = (one.renewed().replace(upcoming=None) for one in (begun, jax.device_get(state)))
    return {"settings": _hash(large), "moved": moved(begun, ended)}


def made_small(config: Any) -> Any:
    """A resolved `config` with the numbers of `SMALL`, and of `FUTURES` if its Controller learns so."""
    from star.config.loading import parse

    values = config.model_dump(mode="json")
    small = {key: value for key, value in SMALL.items() if key.startswith("env.") or _find(values, key) is not None}
    small["tutor.unroll"] = min(small["tutor.unroll"], config.tutor.unroll)
    if (learner := config.controller.learner) in WITH_FUTURES:
        networks = WITH_FUTURES[learner]
        small |= {f"controller.{learner}.{key}": x for key, x in (networks | FUTURES).items()} | {"tutor.period": 10}
    return parse(values, small | {"trainer.seed": SEED, "trainer.num_seeds": 1})


def moved(begun: Any, ended: Any) -> dict[str, float]:
    """Distance of each part of a state from its beginning: mean over its arrays of ln(1 + sum of |end - begin|).

    Random keys and numbers that are not finite count for nothing.
    """
    import jax
    import numpy as np

    found = {}
    for name in sorted(vars(begun)):
        logs = []
        for pair in zip(*(jax.tree.leaves(getattr(state, name)) for state in (begun, ended)), strict=True):
            if not jax.dtypes.issubdtype(pair[0].dtype, jax.dtypes.prng_key):
                a, b = (np.where(np.isfinite(x), x, 0.0).astype(float) for x in pair)
                logs.append(np.log1p(np.abs(b - a).sum()))
        if logs:
            found[name] = round(float(np.mean(logs)), 6)
    return found


def _find(values: Any, key: str) -> Any:
    """The value in nested `values` below a dotted key; None if there is no such place."""
    for name in key.split("."):
        if not isinstance(values, dict) or name not in values:
            return None
        values = values[name]
    return values


def _hash(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:12]


_LEVEL = {"ppo.hidden": [8], "ppo.passes": 2, "ppo.minibatches": 2, "td3.hidden": [8], "td3.batch_size": 16}
_LEVEL |= {"td3.buffer_size": 512, "td3.min_transitions": 16, "td3.updates_per_rollout": 2}
# Of the agent, with which regions are cut within three epochs.
SMALL: dict[str, Any] = {
    **{f"{level}.{key}": value for level in ("tutor", "controller") for key, value in _LEVEL.items()},
    "tutor.unroll": 2,
    "tutor.adjacency.hidden": [8],
    "tutor.adjacency.batch_size": 16,
    "tutor.adjacency.updates_per_epoch": 4,
    "commander.period": 20,
    "abstraction.max_regions": 48,
    "abstraction.min_width": 0.01,
    "forward_model.hidden": [8],
    "forward_model.buffer_size": 64,
    "forward_model.batch_size": 8,
    "forward_model.updates_per_epoch": 4,
    "refinement.min_transitions": 1,
    "refinement.min_visits": 1,
    "refinement.depth": 5,
    "refinement.parts": 8,
    "refinement.pairs_per_epoch": 16,
    "refinement.error_tolerance": 0.9,
    "refinement.reach_share": 0.2,
    "sgim.imitation_batch": 16,
    "env.options.episode_length": 20,  # in longer ones rounding makes other falls of an ant
    "trainer.num_envs": 32,
    "trainer.eval_episodes": 4,
    "trainer.devices": 1,
}
# Of learners whose goals are what came later in an episode.
WITH_FUTURES: dict[str, dict[str, Any]] = {"crl": {"hidden": [8]}, "chronosrl": {"width": 8, "blocks": 1}}
FUTURES: dict[str, Any] = {"batch_size": 16, "buffer_size": 1280, "min_transitions": 640, "updates_per_rollout": 2}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the digest of the words of a command."""
    from star.cli.words import split_settings
    from star.config.loading import load

    words, settings = split_settings([word for word in (arguments or sys.argv[1:]) if word != "--"])
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("config")
    parser.add_argument("--with", dest="layers", action="append", default=[])
    parser.add_argument("--total-env-steps", type=float)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--seeds", type=int)
    options = parser.parse_args(words)
    print(json.dumps(compute(load(options.config, settings, layers=options.layers))))


if __name__ == "__main__":
    main()
