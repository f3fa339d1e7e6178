"""Measure the time of a sweep side by side, and of as many of its trials one after another.

    python scripts/benchmarks/sweep.py configs/sweeps/point_maze.yaml [--alone 4] [--section.key VALUE ...]

Runs `star sweep`, and `star train` with trials drawn from the same search space: half of `--alone` before the sweep and
half after it, because a machine may be shared. Prints one JSON object. Seconds are wall-clock of whole commands,
compilation included; `cpu_s` is what they used of all cores, and hardly depends on what else runs.
`ratio` is the sweep over as many trials one after another, from the mean of those that were run.
`warm` is the same without compilation: seconds per trial and epoch in a program of one slot, and of all slots.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optuna

from star.cli.words import split_settings
from star.sweeps.plan import Plan, plan
from star.training.side_by_side import SideBySide

STAR = (sys.executable, "-m", "star")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--alone", type=int, default=4, help="trials that are run one after another")
    words, settings = split_settings(sys.argv[1:])
    options = parser.parse_args(words)
    print(json.dumps(benchmark(options.file, options.alone, settings), indent=2))


def benchmark(path: Path, alone: int, settings: dict[str, Any]) -> dict[str, Any]:
    """Time the commands, then the programs."""
    found = plan(path, settings=settings)
    given = [word for key, value in settings.items() for word in (f"--{key}", json.dumps(value))]
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        drawn = [_drawn(found, number, Path(folder)) for number in range(alone)]
        single = [_seconds("train", config, "--run-dir", config.with_suffix("")) for config in drawn[: alone // 2]]
        batch = _seconds("sweep", path, "--out", Path(folder) / "sweep", *given)
        single += [_seconds("train", config, "--run-dir", config.with_suffix("")) for config in drawn[alone // 2 :]]
    wall, cpu = np.mean(single, axis=0) * found.trials
    return {
        "file": str(path),
        "trials": found.trials,
        "env_steps_per_trial": found.base.trainer.total_env_steps,
        "alone_run": alone,
        "one_after_another_s": round(wall, 1),
        "side_by_side_s": round(batch[0], 1),
        "ratio": round(batch[0] / wall, 3),
        "cpu_s": {"one_after_another": round(cpu, 1), "side_by_side": round(batch[1], 1)},
        "cpu_ratio": round(batch[1] / cpu, 3),
        "warm": _warm(found),
        "cores": len(os.sched_getaffinity(0)),
        "load_before": round(load, 1),
        "versions": {"python": platform.python_version(), "jax": jax.__version__},
    }


def _drawn(found: Plan, number: int, folder: Path) -> Path:
    """The config file of a random trial."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=number))
    path = folder / f"{number}.yaml"
    path.write_text(found.config(study.ask(dict(found.distributions)).params).to_yaml())
    return path


def _seconds(*arguments: Any) -> tuple[float, float]:
    """Wall-clock and processor seconds of a command of `star`."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([*STAR, *map(str, arguments), "--quiet"], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - began, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _warm(found: Plan, epochs: int = 3) -> dict[str, float]:
    """Seconds per trial and epoch of a program with one slot and of one with all, in turns; the fastest of each."""
    benches = {slots: SideBySide(found.base, slots) for slots in (1, found.trials)}
    times: dict[int, list[float]] = {slots: [] for slots in benches}
    for slots, bench in benches.items():
        bench.put(dict.fromkeys(range(slots), found.base))
        for _ in range(found.base.trainer.eval_every):  # so that the evaluation is compiled too
            bench.advance()
    for _ in range(epochs):
        for slots, bench in benches.items():
            began = time.perf_counter()
            bench.advance()
            times[slots].append((time.perf_counter() - began) / slots)
    one, many = (min(times[slots]) for slots in benches)
    return {"alone_s": round(one, 4), "side_by_side_s": round(many, 4), "ratio": round(many / one, 3)}


if __name__ == "__main__":
    main()
