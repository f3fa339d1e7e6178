"""OpenGL without a window: a context by EGL or, where that does not work, by OSMesa.

MuJoCo's own `Renderer` takes its kind of context from the environment at the moment mujoco is imported. Here it is
chosen when the first picture is drawn, so that nobody has to set anything; `MUJOCO_GL` still decides if it is set.
"""

from __future__ import annotations

import importlib
import os
import sys
from functools import cache
from typing import Any

from envs.options import EnvError

BACKENDS = ("egl", "osmesa")
UNDECIDED = ("", "1", "true", "on", "enable", "enabled")  # values of MUJOCO_GL that name no backend
HELP = "on Debian and Ubuntu install libosmesa6, or libegl1 and libgl1"


def new_context(width: int, height: int) -> Any:
    """A context that is current, for pictures of `width` x `height`; its owner calls `free`.

    Raises:
      EnvError: in one line that says what to install, if this machine has no OpenGL without a window.
    """
    context = backend()(width, height)
    context.make_current()
    return context


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
