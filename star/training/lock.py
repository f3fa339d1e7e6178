"""One process at a time writes into a run directory."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from envs.common.errors import UserError
from star.config.section import ConfigError

NAME = ".lock"


def held(run_dir: Path) -> bool:
    """True if a process writes into `run_dir`, as far as the file system can tell."""
    try:
        with (run_dir / NAME).open(encoding="utf-8") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@contextlib.contextmanager
def locked(run_dir: Path, *, warn: Callable[[str], None]) -> Iterator[None]:
    """Hold `run_dir` alone; raises `UserError` if another process does, or if the folder cannot be written.

    The system releases the lock when the process ends, however it does; the file stays, unless it is new and what was
    to be done is refused with `UserError`. Where the file system cannot lock, that is said, and nothing is held.
    """
    path = run_dir / NAME
    new = not path.exists()
    try:
        file = path.open("a+", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be written: {error.strerror}") from None
    with file:
        try:
            _lock(file)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(200).strip() or "another process"
            raise ConfigError(f"{run_dir}: is in use by {holder}; wait for its end, or stop it") from None
        except OSError as error:
            warn(f"{run_dir}: its file system cannot lock ({error.strerror}); see that no other process trains in it")
        else:
            with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
                file.truncate(0)
                file.write(f"process {os.getpid()} on {platform.node()}")
                file.flush()
        try:
            yield
        except UserError:
            if new:
                path.unlink(missing_ok=True)
            raise


def _lock(file: TextIO) -> None:
    """Lock `file`, at a second try if need be: `held` of another process has it for a moment."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        time.sleep(0.1)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
