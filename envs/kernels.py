"""MJX-Warp's kernels, compiled by another process while this one compiles its programs.

Warp compiles a kernel at its first launch, and keeps it in its cache folder. A thread of this process must not do so
while XLA compiles, because XLA tries kernels on the GPU while Warp records a graph there. A process shares nothing but
the folder. Kernels that it has not compiled in time are compiled here, so its failure costs no more than that time.
"""

from __future__ import annotations

import atexit
import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

import mujoco
import numpy as np

_started: dict[Path, subprocess.Popen[bytes]] = {}


def compile_beside(model: mujoco.MjModel, *, contacts: int, rows: int) -> None:
    """Let a process compile the kernels of `model`, unless they are in Warp's cache; buffers as of `mjx.make_data`."""
    import warp

    warp.init()
    compiled = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    words = [mujoco.__version__, str(contacts), str(rows)]
    digest = hashlib.sha256(compiled.tobytes() + " ".join(words).encode()).hexdigest()
    done = Path(warp.config.kernel_cache_dir) / f"mujoco-{digest[:16]}"
    if done in _started or done.exists():
        return
    with tempfile.TemporaryFile() as file:
        file.write(compiled.tobytes())
        file.seek(0)
        _started[done] = subprocess.Popen(
            [sys.executable, "-m", "envs.kernels", str(contacts), str(rows), str(done)],
            stdin=file,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )


@atexit.register
def _end() -> None:
    for process in _started.values():
        process.kill()
        process.wait()


def _compile(compiled: bytes, contacts: int, rows: int) -> None:
    """Step a saved model once, and once more while its kernels are recorded, as JAX has them."""
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": compiled})
    data = mujoco_warp.make_data(model, nworld=1, naconmax=contacts, njmax=rows)
    device_model = mujoco_warp.put_model(model)
    mujoco_warp.step(device_model, data)
    with warp.ScopedCapture():
        mujoco_warp.step(device_model, data)


if __name__ == "__main__":
    _compile(sys.stdin.buffer.read(), int(sys.argv[1]), int(sys.argv[2]))
    Path(sys.argv[3]).touch()
