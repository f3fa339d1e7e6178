"""Measure the executions of a world in a second on this machine.

    python scripts/benchmarks/worlds.py [pen throw] [--batch 200 4096] [--repeats 20] [--out speed.json]

Random sequences of the full length, drawn in advance; the median over the repeats. `cpu_us` is the time of all cores
together for one execution: on a machine with other work it says more than the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path
from typing import Any

import jax

from envs import worlds
from star.training.profiling import timed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=worlds.names())
    parser.add_argument("--batch", nargs="+", type=int, default=[200, 4096], help="executions side by side")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.names:
        for batch in options.batch:
            rows.append(measure(name, batch, options.repeats))
            print(json.dumps(rows[-1]), flush=True)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def measure(name: str, batch: int, repeats: int) -> dict[str, Any]:
    """The row of one world and size of batch."""
    world = worlds.make(name)
    size = (batch, world.longest, world.primitive)
    sequences = jax.random.uniform(jax.random.key(0), size, minval=-1, maxval=1)
    first_s, _ = timed(world.execute, sequences, world.longest)
    walls, cpus = [], []
    for _ in range(repeats):
        before = time.process_time()
        walls.append(timed(world.execute, sequences, world.longest)[0])
        cpus.append(time.process_time() - before)
    return {
        "world": name,
        "batch": batch,
        "executions_per_s": round(batch / statistics.median(walls)),
        "us": round(statistics.median(walls) / batch * 1e6, 2),
        "cpu_us": round(statistics.median(cpus) / batch * 1e6, 2),
        "first_call_s": round(first_s, 1),
        "cores": os.cpu_count(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


if __name__ == "__main__":
    main()
