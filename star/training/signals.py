"""Ctrl-C and SIGTERM end a command: at its next good moment, and at once if they come again."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from types import FrameType
from typing import NoReturn, TypeVar

T = TypeVar("T")

GRACE_S = 5.0  # how long after SIGTERM the computation under way may take; the rest of 10 s is for the checkpoint
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last: its terminal was closed
_POLL_S = 0.2  # a signal that another thread receives does not wake this one
_THREAD = "star compute"


class Overdue(Exception):
    """Not done within `GRACE_S` of SIGTERM."""


class Stop:
    """The requests of signals.

    Called, it tells whether the command is to stop; `terminated` whether nobody waits for it: SIGTERM, as of a
    cluster, or SIGHUP came.
    While `patient` is set nothing is overdue.
    """

    def __init__(self) -> None:
        self.on_first: Callable[[], None] = lambda: None
        self.terminated = False
        self.patient = False
        self._since: float | None = None

    def __call__(self) -> bool:
        """True if a signal came."""
        return self._since is not None

    def hear(self, number: int, frame: FrameType | None) -> None:
        """Take a signal; the second one raises `KeyboardInterrupt`."""
        if self():
            raise KeyboardInterrupt
        self._since, self.terminated = time.monotonic(), number != signal.SIGINT
        self.on_first()

    def during(self, compute: Callable[[], T]) -> T:
        """The value of `compute`, while signals are heard: Python hears none as long as JAX compiles or waits.

        It works in a thread, which is abandoned if this raises `Overdue`, or `KeyboardInterrupt` upon a second signal.
        """
        found: Future[T] = Future()

        def work() -> None:
            try:
                found.set_result(compute())
            except BaseException as error:
                found.set_exception(error)

        thread = threading.Thread(target=work, name=_THREAD, daemon=True)
        thread.start()
        while not wait([found], timeout=_POLL_S).done:
            if self.terminated and not self.patient and self._waited() > GRACE_S:
                raise Overdue
        thread.join()
        return found.result()

    def _waited(self) -> float:
        """Seconds since the signal."""
        return 0.0 if self._since is None else time.monotonic() - self._since


@contextlib.contextmanager
def interruptible() -> Iterator[Stop]:
    """Yields what tells whether Ctrl-C was pressed, SIGTERM or SIGHUP came; the first of them calls its `on_first`.

    A SIGHUP that the process ignores, as under `nohup`, stays ignored. Outside of the main thread, where Python lets
    nobody hear signals, they are the caller's.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    nohup = signal.getsignal(signal.SIGHUP) in (signal.SIG_IGN, None)
    heard = [number for number in _SIGNALS if not (nohup and number == signal.SIGHUP)]
    before = {number: signal.signal(number, stop.hear) for number in heard}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def computing() -> list[threading.Thread]:
    """The threads that compute still, after they were abandoned."""
    return [thread for thread in threading.enumerate() if thread.name == _THREAD]


def at_once(number: int, frame: FrameType | None) -> None:
    """Ctrl-C before anything is at stake: `KeyboardInterrupt`, or the end where an import might swallow that."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            os._exit(128 + number)
        frame = frame.f_back
    raise KeyboardInterrupt


def leave(code: int) -> int:
    """`code`, unless a computation was abandoned: then the process ends here, for Python would crash or wait for it."""
    if computing():
        end(code)
    return code


def end(code: int) -> NoReturn:
    """End the process, whatever JAX computes still."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
