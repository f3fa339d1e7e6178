"""Measure the speed of a task, and the cost of the environment on top of its engine, in one run on one machine.

    python scripts/benchmarks/physics.py ant_maze ant_fall --engine warp --envs 4096 16384 --out speed.json

For each task, engine and number of environments, by turns:

    bare    the engine's loop: env steps/s of physics alone, under random actions drawn in advance
    full    the environment's loop: action, physics, observation, reward, success, resets spread over all steps

`ratio` is full / bare, the median over `--repeats` pairs of loops that follow each other. `memory_per_env` is the
device memory that the loops needed, in bytes, where JAX can tell: it knows the peak of the process, so only a row that
raises the peak has it.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import envs
from envs.ant import MAX_TORQUE
from star.training.profiling import timed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="+")
    parser.add_argument("--engine", nargs="+", default=["auto"])
    parser.add_argument("--envs", nargs="+", type=int, default=[4096], help="for each engine alike, or one for each")
    parser.add_argument("--paired", action="store_true", help="the i-th number of environments is for the i-th engine")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--steps", type=int, default=100, help="env steps of a loop")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.paired:
        sizes = list(zip(options.engine, options.envs, strict=True))
    else:
        sizes = [(engine, size) for engine in options.engine for size in options.envs]
    rows = []
    for task in options.tasks:
        for engine, size in sizes:
            rows.append(measure(task, engine, size, options))
            print(json.dumps(rows[-1]), flush=True)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def measure(task: str, engine: str, size: int, options: argparse.Namespace) -> dict[str, Any]:
    """The row of one task, engine and number of environments."""
    before = peak_memory()
    env = envs.make(task, engine=engine, preset=options.preset)
    vector = envs.VectorEnv(env, size)
    state = jax.jit(vector.reset)(jax.random.key(0))
    elapsed = jax.random.randint(jax.random.key(1), (size,), 0, env.episode_length)  # so that some reset in every step
    state = state.replace(pipeline_state=state.pipeline_state.replace(steps=elapsed))
    data = jax.tree.map(jnp.copy, state.pipeline_state.data)
    actions = jax.random.uniform(jax.random.key(2), (options.steps, size, env.action_size), minval=-1.0)
    physics = jax.vmap(env.body.physics.step)

    bare = loop(lambda data, action: physics(data, MAX_TORQUE * action))
    full = loop(vector.step)
    compile_s, data = timed(bare, data, actions)
    more_s, state = timed(full, state, actions)
    pairs = []
    for _ in range(options.repeats):
        bare_s, data = timed(bare, data, actions)
        full_s, state = timed(full, state, actions)
        pairs.append((options.steps * size / bare_s, options.steps * size / full_s))
    memory = peak_memory()
    return {
        "task": task,
        "engine": env.engine,
        "preset": options.preset,
        "envs": size,
        "bare": round(statistics.median(bare for bare, _ in pairs)),
        "full": round(statistics.median(full for _, full in pairs)),
        "ratio": round(statistics.median(full / bare for bare, full in pairs), 3),
        "ratios": [round(full / bare, 3) for bare, full in pairs],
        "memory_per_env": round(memory / size) if memory > before else None,
        "first_call_s": round(compile_s + more_s, 1),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def peak_memory() -> int:
    """Bytes of device memory that the process has had at most; 0 where JAX cannot tell."""
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)


def loop(step: Callable[[Any, jax.Array], Any]) -> Callable[[Any, jax.Array], Any]:
    """A jitted loop of `step` over actions, its first argument donated."""
    return jax.jit(
        lambda carry, actions: jax.lax.scan(lambda c, a: (step(c, a), None), carry, actions)[0], donate_argnums=0
    )


if __name__ == "__main__":
    main()
