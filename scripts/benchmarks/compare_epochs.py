"""Measure the time of an epoch in two checkouts, in turn on one machine.

    python scripts/benchmarks/compare_epochs.py OLD NEW configs/ant_maze.yaml [--epochs 10] [--section.key VALUE ...]

Both load the config from NEW and stay in memory side by side. After two epochs that warm up, first one and then the
other trains an epoch, and the next time the other way round. Prints one JSON object: the seconds of all epochs, the
ratio of the medians, OLD over NEW (above 1 NEW is faster), and what was compiled after the first epoch, which has to be
nothing. Exit code: 0 if the ratio is at least `--least` and nothing was compiled, else 1.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from scripts.processes import importing

WORKER = """
import json, sys, time
import jax
from star.config.loading import load
from star.training import program as programs

compiled = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, *_, **__: compiled.append(name) if name.endswith("backend_compile_duration") else None
)
program = programs.build(load(sys.argv[1], json.loads(sys.argv[2])))
state = program.init(program.seed_keys())

def epoch():
    global state
    began = time.perf_counter()
    state, metrics = jax.block_until_ready(program.epoch(state))
    return time.perf_counter() - began

first = epoch()
compiled.clear()
epoch()
device = jax.devices()[0].device_kind
print(json.dumps({"first_epoch_s": first, "device": device, "env_steps": program.steps_per_epoch}), flush=True)
for _ in sys.stdin:
    seconds = epoch()
    print(json.dumps({"s": seconds, "compiled": len(compiled)}), flush=True)
"""


def main() -> int:
    """Measure, print, return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, metavar="OLD", help="checkout")
    parser.add_argument("new", type=Path, metavar="NEW", help="checkout")
    parser.add_argument("config", type=Path, help="YAML file")
    parser.add_argument("--epochs", type=int, default=10, help="of each (default: 10)")
    parser.add_argument("--least", type=float, default=0.97, help="ratio that NEW has to reach (default: 0.97)")
    options, others = parser.parse_known_args()
    overrides = {key.removeprefix("--"): _value(value) for key, value in zip(others[::2], others[1::2], strict=True)}
    workers = [Worker(checkout, options.config.resolve(), overrides) for checkout in (options.old, options.new)]
    told = [worker.told() for worker in workers]
    seconds: list[list[float]] = [[], []]
    compiled = [0, 0]
    for number in range(options.epochs):
        for which in (0, 1) if number % 2 == 0 else (1, 0):
            row = workers[which].epoch()
            seconds[which].append(row["s"])
            compiled[which] = row["compiled"]
    for worker in workers:
        worker.end()
    middle = [statistics.median(each) for each in seconds]
    ratio = middle[0] / middle[1]
    names = ("old", "new")
    print(
        json.dumps(
            {
                "config": options.config.stem,
                "device": told[0]["device"],
                "steps_per_epoch": told[0]["env_steps"],
                "median_s": dict(zip(names, middle, strict=True)),
                "ratio": ratio,
                "first_epoch_s": dict(zip(names, (row["first_epoch_s"] for row in told), strict=True)),
                "compiled_after_the_first": dict(zip(names, compiled, strict=True)),
                "seconds": dict(zip(names, seconds, strict=True)),
            }
        )
    )
    return int(ratio < options.least or compiled[1] > 0)


class Worker:
    """A process with the program of one checkout."""

    def __init__(self, checkout: Path, config: Path, overrides: dict[str, Any]) -> None:
        """Start it; both share the memory of a GPU."""
        here = importing(checkout)
        here["XLA_PYTHON_CLIENT_MEM_FRACTION"] = os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.42")
        command = [sys.executable, "-c", WORKER, str(config), json.dumps(overrides)]
        self._process = subprocess.Popen(
            command, env=os.environ | here, cwd=checkout, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def told(self) -> dict[str, Any]:
        """Its next line; MJX and Warp may say things in between."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                return json.loads(line)
        raise RuntimeError(f"the process ended with {self._process.wait()}")

    def epoch(self) -> dict[str, Any]:
        """Train an epoch."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return self.told()

    def end(self) -> None:
        """Let it end."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


if __name__ == "__main__":
    sys.exit(main())
