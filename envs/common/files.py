"""Files that appear whole or not at all, and the one that was meant where there is none."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import itertools
import os
import tempfile
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

from envs.common.errors import UserError


def check_name(path: Path) -> None:
    """Raise `UserError` for a path that is not UTF-8: what is written below it could not name its place."""
    try:
        os.fspath(path.absolute()).encode()
    except UnicodeEncodeError:
        raise UserError(f"{path}: the name is not UTF-8") from None


def check(path: Path, endings: Sequence[str], *, force: bool = False) -> None:
    """Raise `UserError` in one line if `path` cannot be written, or would be replaced without `force`."""
    check_name(path)
    try:
        if path.is_dir():
            raise UserError(f"{path}: is a folder")
    except OSError as error:  # such as a name too long
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
    if path.suffix.lower() not in endings:
        raise UserError(f"{path}: cannot tell what to write; allowed endings: {', '.join(endings)}")
    if not path.parent.is_dir():
        raise UserError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise UserError(f"{path}: cannot be written: the folder {path.parent} is not writable")
    if path.exists() and not force:
        raise UserError(f"{path}: exists; replace it with --force")


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A partial file to write; once whole it becomes `path` and replaces an existing file.

    Raises:
      UserError: in one line, if it cannot be written.
    """
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}-") as folder:
            partial = Path(folder) / path.name
            yield partial
            sync(partial)
            os.replace(partial, path)
            sync(path.parent)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def new_place(folder: Path, name: str) -> Path:
    """A new place in `folder`, named after the time. It is made at once, so that no other command takes it."""
    first = folder / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    places = itertools.chain([first], (first.with_name(f"{first.name}-{number}") for number in itertools.count(2)))
    for place in places:
        try:
            check_name(place)
            place.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"{place}: cannot be written: {error.strerror}") from None
        return place
    raise AssertionError


@contextlib.contextmanager
def given_back(place: Path) -> Iterator[None]:
    """If what is done here is refused, remove the new `place` for it, and the folder around, as far as empty."""
    try:
        yield
    except UserError:
        with contextlib.suppress(OSError):
            place.rmdir()
            place.parent.rmdir()
        raise


def sha256(path: Path) -> str:
    """The checksum of a file, as `sha256sum` prints it; raises `OSError`."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: Path) -> None:
    """Have the system write a file, or the names in a folder, to the disk: what it holds survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def nearest_file(path: Path, endings: Sequence[str]) -> str:
    """` (did you mean ...?)` with the file beside `path` whose name is most like it, of those with these endings."""
    try:
        names = {entry.stem: entry for entry in path.parent.iterdir() if entry.suffix in endings}
    except (OSError, ValueError):  # no such folder, or not one of ours
        return ""
    matches = difflib.get_close_matches(path.stem, names, n=1)
    return f" (did you mean {names[matches[0]]}?)" if matches else ""
