"""Measure the speed of training on more devices, each with as many environments, in one run on one machine.

    python scripts/benchmarks/devices.py configs/ant_maze.yaml --devices 1 2 4 [--epochs 3] [--per-device-envs 4096]

Prints a JSON object for each number of devices as soon as it is measured. Speeds are env steps/s of all environments
and seeds:

    physics    the environments alone, under random actions drawn in advance
    acting     greedy episodes: environments, Commander, Tutor and Controller
    epoch      all of an epoch, which also learns and refines

`ratio` holds these speeds over those of one device, if 1 comes first. Learning keeps `epoch` below `acting`: its
messages between devices, and what every device does for itself. Each number of devices is measured in a process of its
own.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax

from envs.vector import VectorEnv
from star import devices
from star.agent import environment
from star.cli.words import split_settings
from star.config.loading import load
from star.training import program as programs
from star.training.profiling import timed
from star.training.program import Program

_STEPS = 200  # env steps of a loop of physics alone


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--per-device-envs", type=int, default=4096)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)  # a process that measures writes its row there
    words, settings = split_settings(sys.argv[1:])
    options = parser.parse_args(words)
    if options.out is not None:
        row = measure(options.config, options.devices[0], options.epochs, options.per_device_envs, settings)
        options.out.write_text(json.dumps(row), encoding="utf-8")
        return
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for count in options.devices:
            out = Path(folder) / f"{count}.json"
            command = [sys.executable, __file__, *sys.argv[1:], "--devices", str(count), "--out", str(out)]
            code = subprocess.run(command, check=False).returncode
            if code != 0:
                sys.exit(code)
            rows.append(json.loads(out.read_text(encoding="utf-8")))
            rows[-1]["ratio"] = ratio(rows[-1], rows[0])
            print(json.dumps(rows[-1]), flush=True)


def measure(path: Path, count: int, epochs: int, per_device: int, settings: dict[str, Any]) -> dict[str, Any]:
    """The row of `count` devices: medians of `epochs` epochs, episodes and loops after one that compiles."""
    num_envs = count * per_device
    sizes = {"trainer.devices": count, "trainer.num_envs": num_envs, "trainer.eval_episodes": num_envs}
    program = programs.build(load(path, settings | sizes))
    steps = program.steps_per_epoch * len(program.seeds)
    state = program.init(program.seed_keys())
    first_s, (state, _) = timed(program.epoch, state)
    times = []
    for _ in range(epochs):
        seconds, (state, _) = timed(program.epoch, state)
        times.append(seconds)
    keys = program.evaluation_keys(0)
    acting = [timed(program.evaluate, state, keys)[0] for _ in range(epochs + 1)][1:]
    del state
    epoch_s, loops = statistics.median(times), physics(program, epochs)
    return {
        "devices": count,
        "task": program.config.env.name,
        "engine": program.config.env.engine,
        "num_envs": num_envs,
        "seeds": len(program.seeds),
        "physics": round(_STEPS * num_envs * len(program.seeds) / statistics.median(loops)),
        "acting": round(steps / statistics.median(acting)),
        "epoch": round(steps / epoch_s),
        "epoch_s": [round(seconds, 3) for seconds in times],
        "first_epoch_s": round(first_s, 1),
        "peak_bytes": (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use"),
        "device": jax.devices()[0].device_kind,
        "versions": {"python": platform.python_version(), "jax": jax.__version__},
    }


def ratio(row: dict[str, Any], one: dict[str, Any]) -> dict[str, float] | None:
    """The speeds of `row` over those of `one`, if that is of one device."""
    if one["devices"] != 1:
        return None
    return {part: round(row[part] / one[part], 3) for part in ("physics", "acting", "epoch")}


def physics(program: Program, repeats: int) -> list[float]:
    """Seconds of loops of the environments alone, as they are shared out in `program`."""
    config = program.config.trainer
    mesh = devices.mesh(config.devices)
    env = environment.make(program.config, "train")
    batch = VectorEnv(env, config.num_envs * config.num_seeds, auto_reset=False)

    def begin(key: jax.Array) -> Any:
        actions = jax.random.uniform(jax.random.fold_in(key, 1), (batch.num_envs, env.action_size), minval=-1.0)
        return batch.reset(key), actions

    def run(state: Any, actions: jax.Array) -> Any:
        return jax.lax.scan(lambda state, _: (batch.step(state, actions), None), state, length=_STEPS)[0]

    state, actions = jax.jit(devices.on(mesh, begin), out_shardings=devices.in_shares(mesh))(jax.random.key(0))
    loop = jax.jit(devices.on(mesh, run), donate_argnums=0)
    times = []
    for _ in range(repeats + 1):
        seconds, state = timed(loop, state, actions)
        times.append(seconds)
    return times[1:]


if __name__ == "__main__":
    main()
