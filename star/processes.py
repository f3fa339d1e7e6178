"""A process for each GPU of this machine, where one process must not serve several of them.

MJX-Warp starts its kernels from Python, one after another for all GPUs of a process. So a command that is to use
several GPUs becomes the parent of one process for each, which work in step (`star.devices.join`).
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from envs.tasks import TASKS
from star import devices
from star.config import Config

GRACE_S = 10.0  # how long the others may go on when one has failed
_GOOD = (0, 3, 130)  # ends that all processes come to together
_LOOK = "import jax, envs.physics; print(envs.physics.resolve_engine('auto'), len(jax.devices()))"


def gpus(config: Config) -> list[str]:
    """The GPUs that need a process each, as `CUDA_VISIBLE_DEVICES` names them; none if this process will do.

    Raises `ConfigError` if there are fewer than `trainer.devices`.
    """
    count, task = config.trainer.devices, TASKS.get(config.env.name)
    warp = config.env.engine in ("auto", "warp") and task is not None and "warp" in task.engines
    if count == 1 or config.trainer.device == "cpu" or not warp or importlib.util.find_spec("warp") is None:
        return []
    engine, there = look()
    if engine != "warp":
        return []
    names = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name.strip()]
    names = names or [str(number) for number in range(there)]
    devices.check_count(count, len(names), "gpu")
    return names[:count]


def look() -> tuple[str, int]:
    """The engine that `auto` is here, and the number of devices, by a process of its own.

    For one that has looked at the GPUs takes memory of all of them.
    """
    seen = subprocess.run([sys.executable, "-c", _LOOK], capture_output=True, text=True, check=False).stdout.split()
    return (seen[0], int(seen[1])) if seen else ("", 0)


def run(command: Sequence[str], gpus: Sequence[str]) -> int:
    """Run `command` with `--distributed` once for each of `gpus`, and return the exit code.

    The first process has this one's output; what another says is shown if it fails first. Ctrl-C and SIGTERM are
    passed on. When a process fails, the others are ended.
    """
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as open_files:
        logs = [Path(folder) / str(number) for number in range(len(gpus))]
        started: list[subprocess.Popen] = []

        def forward(number: int, _: object) -> None:
            for process in started:
                process.send_signal(number)

        before = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            for number, gpu in enumerate(gpus):
                log = open_files.enter_context(logs[number].open("w"))
                started.append(
                    subprocess.Popen(
                        [*command, "--distributed", f"{address},{number},{len(gpus)}"],
                        env=os.environ | {"CUDA_VISIBLE_DEVICES": gpu},
                        stdout=log if number else None,
                        stderr=log if number else None,
                        start_new_session=True,  # a terminal's Ctrl-C comes here alone, and is passed on once
                    )
                )
            _wait(started)
            failed = next(iter(_failed(started)), 0)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            for process in started:
                process.kill()
                process.wait()
        print(logs[failed].read_text(errors="replace"), end="", file=sys.stderr)
        code = started[failed].returncode
        return code if code >= 0 else 128 - code


def _wait(processes: Sequence[subprocess.Popen]) -> None:
    """Until all have ended, or one has failed and `GRACE_S` are over."""
    until = math.inf
    while any(process.poll() is None for process in processes) and time.monotonic() < until:
        if until == math.inf and _failed(processes):
            until = time.monotonic() + GRACE_S
        time.sleep(0.1)


def _failed(processes: Sequence[subprocess.Popen]) -> list[int]:
    """The numbers of those that have ended badly."""
    return [number for number, process in enumerate(processes) if process.poll() not in (None, *_GOOD)]
