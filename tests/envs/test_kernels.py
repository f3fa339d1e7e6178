"""The process that compiles MJX-Warp's kernels, with a Warp that only notes what is asked of it."""

import contextlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import mujoco.mjx.third_party
import numpy as np
import pytest

from envs import kernels

MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache folder of a Warp without a GPU."""
    config = SimpleNamespace(kernel_cache_dir=None)
    fake = SimpleNamespace(config=config, init=lambda: setattr(config, "kernel_cache_dir", str(tmp_path)))
    monkeypatch.setitem(sys.modules, "warp", fake)  # type: ignore[arg-type]
    monkeypatch.setattr(kernels, "_started", {})
    return tmp_path


def test_the_process_steps_the_model_that_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    capture = contextlib.nullcontext
    fake = SimpleNamespace(
        put_model=lambda model: model,
        make_data=lambda model, **sizes: sizes,
        step=lambda model, data: seen.append((model.nq, data)),
    )
    monkeypatch.setitem(sys.modules, "warp", SimpleNamespace(ScopedCapture=capture))  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "mujoco.mjx.third_party.mujoco_warp", fake)  # type: ignore[arg-type]
    monkeypatch.setattr(mujoco.mjx.third_party, "mujoco_warp", fake, raising=False)
    saved = np.empty(mujoco.mj_sizeModel(MODEL), np.uint8)
    mujoco.mj_saveModel(MODEL, None, saved)
    kernels._compile(saved.tobytes(), 512, 96)
    assert seen == [(7, {"nworld": 1, "naconmax": 512, "njmax": 96})] * 2


def test_a_model_has_one_process_and_none_once_its_kernels_are_there(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "true")
    kernels.compile_beside(MODEL, contacts=512, rows=96)
    (first,) = kernels._started
    kernels.compile_beside(MODEL, contacts=512, rows=96)
    assert list(kernels._started) == [first] and first.parent == cache
    kernels.compile_beside(MODEL, contacts=512, rows=97)
    assert len(kernels._started) == 2
    kernels._end()
    kernels._started.clear()
    first.touch()
    kernels.compile_beside(MODEL, contacts=512, rows=96)
    assert not kernels._started


def test_a_process_that_fails_leaves_no_note(
    cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "warp.py").write_text("raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    kernels.compile_beside(MODEL, contacts=512, rows=96)
    ((done, process),) = kernels._started.items()
    assert process.wait(120) != 0
    assert not done.exists() and capfd.readouterr() == ("", "")


def test_a_process_ends_with_this_one(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endless = tmp_path / "endless"
    endless.write_text("#!/bin/sh\nexec sleep 600\n")
    endless.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(endless))
    kernels.compile_beside(MODEL, contacts=512, rows=96)
    (process,) = kernels._started.values()
    kernels._end()
    assert process.returncode == -9
