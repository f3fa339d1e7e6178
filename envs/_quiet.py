"""MJX and brax, imported without MJX's notice about the optional package warp.

`mujoco.mjx` prints that warp is missing, and brax imports `mujoco.mjx`. The user of a point maze on a laptop
has no use for the notice; whoever asks for the Warp engine gets an `EnvError` that says what to install.
"""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from brax.envs.base import Env, State
    from mujoco import mjx

__all__ = ["Env", "State", "mjx"]
