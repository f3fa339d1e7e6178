import importlib
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from envs import EnvError, opengl

BROKEN = "import os, mujoco; from envs import opengl; opengl.backend(); print(os.environ['MUJOCO_GL'])"


@pytest.fixture(autouse=True)
def undecided(monkeypatch):
    """A process that has not drawn anything yet, and forgets again what these tests made it choose."""
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(opengl, "_forget", lambda name: None)
    opengl.backend.cache_clear()
    yield
    opengl.backend.cache_clear()


def only(monkeypatch, *working):
    """A machine on which just these backends work."""

    class Context:
        def __init__(self, width, height):
            pass

        def free(self):
            pass

    def load(name):
        if name.removeprefix("mujoco.") not in working:
            raise ImportError(name)
        return SimpleNamespace(GLContext=Context)

    monkeypatch.setattr(importlib, "import_module", load)


@pytest.mark.parametrize(("working", "chosen"), [(["egl", "osmesa"], "egl"), (["osmesa"], "osmesa")])
def test_egl_is_taken_where_it_works_else_osmesa(monkeypatch, working, chosen):
    only(monkeypatch, *working)
    opengl.backend()
    assert os.environ["MUJOCO_GL"] == chosen


def test_the_environment_decides_if_it_names_a_backend(monkeypatch):
    only(monkeypatch, "egl", "osmesa")
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    opengl.backend()
    assert os.environ["MUJOCO_GL"] == "osmesa"


@pytest.mark.parametrize(
    ("wanted", "said"),
    [("", "neither EGL nor OSMesa"), ("egl", "MUJOCO_GL=egl does not work"), ("off", "MUJOCO_GL is off; unset it")],
)
def test_without_opengl_one_line_says_what_to_do(monkeypatch, wanted, said):
    only(monkeypatch)
    monkeypatch.setenv("MUJOCO_GL", wanted)
    with pytest.raises(EnvError) as error:
        opengl.backend()
    assert said in str(error.value) and "\n" not in str(error.value)
    assert "libosmesa6" in str(error.value) or wanted == "off"


def test_a_driver_without_devices_is_passed_over_after_mujoco_was_imported():
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    environment["__EGL_VENDOR_LIBRARY_FILENAMES"] = "/nowhere"
    done = subprocess.run([sys.executable, "-c", BROKEN], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "osmesa" or "EnvError: pictures need OpenGL" in done.stderr.splitlines()[-1]
