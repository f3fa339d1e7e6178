"""Output that may go away while a command works: a closed terminal, a pipe to `head`, a full disk."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any


class Unbroken:
    """A text stream that never fails: what cannot be written is lost, and `error` tells why."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write `text`, with escapes in place of what the stream has no letters for."""
        try:
            self._try(lambda: self._stream.write(text))
        except UnicodeEncodeError:
            letters = self._stream.encoding
            self._try(lambda: self._stream.write(text.encode(letters, "backslashreplace").decode(letters)))
        return len(text)

    def flush(self) -> None:
        """Send what waits in the buffer on its way."""
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, action: Callable[[], Any]) -> None:
        if self.error is not None:
            return
        try:
            action()
        except OSError as error:
            self.error = error
            with contextlib.suppress(OSError, ValueError, AttributeError):  # else Python fails at the buffer's rest
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextlib.contextmanager
def unbroken() -> Iterator[Unbroken | None]:
    """In this context no command ends because its output goes nowhere; yields standard output, if there is any."""
    before = sys.stdout, sys.stderr
    out, err = (None if stream is None else Unbroken(stream) for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        yield out
    finally:
        for stream in (out, err):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before
