"""Measure the parts of an epoch: bare physics, whole epoch, refinement, in one run on one machine.

    python scripts/benchmarks/epoch.py configs/ant_maze.yaml [--epochs 3] [--section.key VALUE ...]

Prints one JSON object. Speeds are env steps/s of all environments and seeds. `refinement_share` is the time that the
refinement alone takes over that of the epoch that contains it; `forward_model_share` likewise for its training, and
`planning_share` for the Commander's plans, of which there is one a period.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from star.abstraction import forward_model as models
from star.abstraction import refinement
from star.agent import levels
from star.agent.decisions import Roadmap
from star.agent.state import TrainState
from star.cli.words import split_settings
from star.config.loading import load
from star.training import program as programs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("--epochs", type=int, default=3)
    words, settings = split_settings(sys.argv[1:])
    options = parser.parse_args(words)
    print(json.dumps(benchmark(options.config, options.epochs, settings)))


def benchmark(path: Path, epochs: int, overrides: dict[str, Any]) -> dict[str, Any]:
    """Time the parts of `epochs` epochs after one that warms up."""
    program = programs.build(load(path, overrides))
    config, agent = program.config, program.config.hyper()
    state = program.init(program.seed_keys())
    steps = program.steps_per_epoch * len(program.seeds)

    compile_began = time.perf_counter()
    state, _ = jax.block_until_ready(program.epoch(state))
    compile_s = time.perf_counter() - compile_began
    began = time.perf_counter()
    for _ in range(epochs):
        state, _ = program.epoch(state)
    jax.block_until_ready(state)
    epoch_s = (time.perf_counter() - began) / epochs

    fresh = jax.tree.map(
        lambda x: x[:, 0, : min(x.shape[2], program.config.trainer.num_envs * 16)], state.forward_model.ring.experience
    )
    keys = jax.random.split(jax.random.key(0), len(program.seeds))

    @jax.jit
    @jax.vmap
    def refine(state: TrainState, goals: models.Outcome, key: jax.Array) -> Any:
        tables = state.abstraction, state.graph, state.forward_model
        return refinement.refine(agent, *tables, goals, cube=program.experiment.spec.cube, key=key)

    train = jax.jit(jax.vmap(lambda s, f, k: models.train(agent.forward_model, s, f, key=k)))
    commander = levels.of(agent, program.experiment.spec).commander
    roadmaps = jax.jit(jax.vmap(lambda s: Roadmap.of(agent.commander, s.abstraction, s.graph)))(state)
    plan = jax.jit(jax.vmap(lambda s, r: commander.plan(agent.commander, s.commander, r)))
    periods = program.experiment.spec.episode_length // agent.commander.period
    return {
        "task": config.env.name,
        "engine": config.env.engine,
        "num_envs": config.trainer.num_envs,
        "seeds": len(program.seeds),
        "device": jax.devices()[0].device_kind,
        "versions": {"python": platform.python_version(), "jax": jax.__version__},
        "epoch_s": epoch_s,
        "first_epoch_s": compile_s,
        "env_steps_per_s": steps / epoch_s,
        "physics_env_steps_per_s": _physics_speed(program, len(program.seeds)),
        "refinement_share": _seconds(refine, state, fresh, keys) / epoch_s,
        "forward_model_share": _seconds(train, state.forward_model, fresh, keys) / epoch_s,
        "planning_share": _seconds(plan, state, roadmaps) * periods / epoch_s,
    }


def _physics_speed(program: programs.Program, seeds: int, steps: int = 200) -> float:
    """Env steps/s of the environment alone under random actions drawn in advance."""
    config = program.config
    env = envs.make(config.env.name, engine=config.env.engine, **config.env.options)
    batch = envs.VectorEnv(env, config.trainer.num_envs * seeds, auto_reset=False)
    actions = jax.random.uniform(jax.random.key(1), (batch.num_envs, env.action_size), minval=-1.0)

    @jax.jit
    def run(state: Any) -> Any:
        return jax.lax.scan(lambda s, _: (batch.step(s, actions), None), state, None, length=steps)[0]

    state = jax.jit(batch.reset)(jax.random.key(0))
    return steps * batch.num_envs / _seconds(run, state)


def _seconds(function: Callable[..., Any], *arguments: Any, repeats: int = 5) -> float:
    """Median wall-clock of a call after one that compiles."""
    jax.block_until_ready(function(*arguments))
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        times.append(time.perf_counter() - began)
    return float(jnp.median(jnp.asarray(times)))


if __name__ == "__main__":
    main()
