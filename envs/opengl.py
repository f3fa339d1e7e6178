"""OpenGL without a window: a context by EGL or, where that does not work, by OSMesa.

MuJoCo's own `Renderer` takes its kind of context from the environment at the moment mujoco is imported. Here it is
chosen when the first picture is drawn, so that nobody has to set anything; `MUJOCO_GL` still decides if it is set.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
import threading
from collections.abc import Iterator
from functools import cache
from typing import Any

from envs.options import EnvError

BACKENDS = ("egl", "osmesa")
UNDECIDED = ("", "1", "true", "on", "enable", "enabled")  # values of MUJOCO_GL that name no backend
_DRAWING = threading.RLock()
HELP = "on Debian and Ubuntu install libosmesa6, or libegl1 and libgl1"


def new_context(width: int, height: int) -> Any:
    """A context for pictures of `width` x `height`, to be used as `current`; its owner calls `free`.

    Raises:
      EnvError: in one line that says what to install, if this machine has no OpenGL without a window.
    """
    with _DRAWING:
        return backend()(width, height)


@contextlib.contextmanager
def current(context: Any) -> Iterator[None]:
    """Draw with `context`, in any thread: OpenGL lets one thread at a time have it, and keep it until it lets go."""
    with _DRAWING:
        context.make_current()
        try:
            yield
        finally:
            _let_go(context)


def _let_go(context: Any) -> None:
    """Have the thread's current context be none."""
    module = sys.modules[type(context).__module__]
    if module.__name__.endswith("egl"):
        egl = module.EGL
        egl.eglBindAPI(egl.EGL_OPENGL_API)  # of this thread; else it lets go of nothing
        egl.eglMakeCurrent(module.EGL_DISPLAY, egl.EGL_NO_SURFACE, egl.EGL_NO_SURFACE, egl.EGL_NO_CONTEXT)
    else:
        module.osmesa.OSMesaMakeCurrent(None, None, module.GL.GL_FLOAT, 0, 0)


@cache
def backend() -> Any:
    """MuJoCo's class of contexts for the first backend that works here; raises `EnvError` if none does."""
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted not in (*UNDECIDED, *BACKENDS):
        raise EnvError(
            f"pictures are drawn without a window, and MUJOCO_GL is {wanted}; unset it, or choose egl or osmesa"
        )
    names = BACKENDS if wanted in UNDECIDED else (wanted,)
    for name in names:
        try:
            contexts = importlib.import_module(f"mujoco.{name}").GLContext
            contexts(1, 1).free()
        except Exception:  # whatever a missing library or a broken driver raises
            _forget(name)
            continue
        os.environ["MUJOCO_GL"] = name  # MuJoCo's C library reads it too
        return contexts
    tried = "neither EGL nor OSMesa works here" if len(names) > 1 else f"MUJOCO_GL={wanted} does not work here"
    raise EnvError(f"pictures need OpenGL, and {tried}; {HELP}")


def _forget(name: str) -> None:
    """Undo the import of a backend that failed: PyOpenGL settles on a platform when it is first imported."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    for module in list(sys.modules):
        if module.split(".")[0] == "OpenGL" or module.startswith(f"mujoco.{name}"):
            del sys.modules[module]
