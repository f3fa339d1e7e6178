"""The provenance of a run: its place and tools."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jax

_ROOT = Path(__file__).parents[2]
_PACKAGES = ("star-rl", "jax", "mujoco", "mujoco-mjx", "brax")


def here(*, devices: int = 1) -> dict[str, Any]:
    """`time` (UTC), `commit`, `device`, `python` and the `versions` of packages, of this process.

    `device` is the kind of the first one, and how many are used if there are several, `devices`. `commit` is that of
    the checkout which the code lies in, with a + if it was changed; empty where there is none.
    """
    return {"time": datetime.now(UTC).isoformat(timespec="seconds")} | _process(devices)


@cache  # the code that runs is that of the first call, whatever becomes of the checkout
def _process(devices: int) -> dict[str, Any]:
    device = jax.devices()[0]
    cores = len(os.sched_getaffinity(0))
    kind = device.device_kind if device.platform == "gpu" else f"CPU, {cores} core{'s' * (cores > 1)}"
    return {
        "commit": _commit(),
        "device": f"{devices} x {kind}" if devices > 1 else kind,
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
    }


def _version(package: str) -> str | None:
    """None for a package that is there but not installed, as in a checkout that runs as it is."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _commit() -> str:
    if not (_ROOT / ".git").exists():  # installed: a repository around it is another one
        return ""
    try:
        commit = _git("rev-parse", "--short", "HEAD")
        return commit + "+" * bool(commit and _git("status", "--porcelain", "star", "envs", "configs"))
    except OSError:  # there is no git
        return ""


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(_ROOT), *words], capture_output=True, text=True).stdout.strip()
