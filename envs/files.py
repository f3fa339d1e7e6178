"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from envs.options import EnvError


def check(path: Path, endings: Sequence[str], *, force: bool = False) -> None:
    """Raise `EnvError` in one line if `path` cannot be written, or would be replaced without `force`."""
    try:
        if path.is_dir():
            raise EnvError(f"{path}: is a folder")
    except OSError as error:  # such as a name too long
        raise EnvError(f"{path}: cannot be written: {error.strerror}") from None
    if path.suffix.lower() not in endings:
        raise EnvError(f"{path}: cannot tell what to write; allowed endings: {', '.join(endings)}")
    if not path.parent.is_dir():
        raise EnvError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise EnvError(f"{path}: cannot be written: the folder {path.parent} is not writable")
    if path.exists() and not force:
        raise EnvError(f"{path}: exists; replace it with --force")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Where to write what becomes `path`, replacing an existing file, once all has been written.

    Raises:
      EnvError: in one line, if it cannot be written.
    """
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
            partial = Path(folder) / path.name
            yield partial
            sync(partial)
            os.replace(partial, path)
            sync(path.parent)
    except OSError as error:
        raise EnvError(f"{path}: cannot be written: {error.strerror or error}") from None


def sync(path: Path) -> None:
    """Have the system write a file, or the names in a folder, to the disk: what it holds survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
