"""The report of one run, served while it trains: `star watch`. Only this machine can open the page.

    Watched   what the page shows now, and its version, which changes when the run writes something
    serve     answers a browser until training ends

The page asks `/changes`, a stream of server-sent events, and loads itself again at each. Films are drawn by
`star render` in a process of its own, from the newest checkpoint, at a low priority.
"""

from __future__ import annotations

import contextlib
import html
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from envs.common.errors import UserError
from star.config import kinds
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.report import history, page
from star.training import lock
from star.training import program as programs
from star.training.checkpoint import opened
from star.training.journal import Journal

FILM = "latest.html"
"""The film in the figures of the run that is drawn again and again."""
_HOST = "127.0.0.1"
_NAMES = {_HOST, "localhost"}  # what a browser may call it: another name is a page of somebody else's that asks
_LOOK_S = 0.5
_LAST_S = 30.0  # how long open pages have at most to load the run's last state
_WAITING = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{name} · STAR</title>
<link rel="icon" href="data:,"></head>
<body style="font: 16px system-ui; margin: 3em"><h1>{name}</h1>
<p>The first epoch is compiled and trained. This page shows it as soon as it is complete.</p>
<script>new EventSource("changes?of={version}").onmessage = () => location.reload();</script></body></html>
"""


class Watched:
    """A run that trains. `ended` is set once it does not any more and nothing is to be drawn."""

    def __init__(self, run_dir: Path, config: RunConfig) -> None:
        self._path, self._config = run_dir, config
        self.ended = threading.Event()
        self.waiting: set[object] = set()
        """Pages that are open, and wait for something else to show."""
        self.shown = 0
        """Pages that have loaded the last state."""

    def version(self) -> str:
        """Another text whenever the page would show something else."""
        journal = Journal.of(self._path, tables=kinds.of(self._config).tables)
        files = [journal.metrics.path, journal.tables.path, self._path / "figures" / FILM]
        sizes = [stat.st_mtime_ns if (stat := _stat(path)) else 0 for path in files]
        return "-".join(map(str, [*sizes, int(self.ended.is_set())]))

    def html(self) -> str:
        """The page of this moment."""
        version = None if self.ended.is_set() else self.version()
        try:
            run = history.read(self._path, self._config, name=self._path.name)
        except history.NothingYet:
            return _WAITING.format(name=html.escape(self._path.name), version=version)
        return page.html(page.content([run]) | {"watched": version})


def serve(run_dir: Path, config: RunConfig, *, port: int, films: bool, say: Callable[[str], None]) -> None:
    """Serve the page of a run that is being trained until it ends; `say` is given lines for a person.

    Raises:
      UserError: in one line, if nobody trains the run, or the port (0: a free one) cannot be had.
    """
    programs.select_device("cpu")  # a GPU is busy with the run
    if not lock.held(run_dir):
        raise ConfigError(f"{run_dir}: nobody trains it; what it has done: star report {run_dir} --out report.html")
    watched = Watched(run_dir, config)
    with _server(watched, port) as server:
        say(f"{run_dir}: http://{_HOST}:{server.server_port}/ (Ctrl-C ends)")
        threading.Thread(target=server.serve_forever, name="star watch", daemon=True).start()
        films = films and "render" in kinds.of(config).commands
        drawn, told, trains = None, set(), True
        while trains:
            trains = lock.held(run_dir)
            newest = _newest(run_dir)
            if films and newest != drawn:
                drawn, fault = newest, _draw(run_dir)
                if fault and fault not in told:
                    told.add(fault)
                    say(f"no film of {newest} {kinds.of(config).unit}: {fault}")
            time.sleep(_LOOK_S)
        pages = len(watched.waiting)
        watched.ended.set()
        end = time.monotonic() + _LAST_S
        time.sleep(2 * _LOOK_S)  # for a page that has just been loaded, and does not wait yet
        while watched.shown < pages and time.monotonic() < end:
            time.sleep(_LOOK_S)
        server.shutdown()


def _newest(run_dir: Path) -> int | None:
    """The newest checkpoint, if there is one."""
    with opened(run_dir) as checkpoints:
        return max(checkpoints.steps(), default=None)


def _draw(run_dir: Path) -> str:
    """Draw a film of the newest checkpoint; returns what went wrong, if anything did."""
    (run_dir / "figures").mkdir(exist_ok=True)
    words = ["render", "--run", str(run_dir), "--out", str(run_dir / "figures" / FILM), "--force", "--quiet"]
    command = ["nice", "-n", "5", sys.executable, "-m", "star", *words, *page.SMALL_FILM]
    done = subprocess.run(command, env=os.environ | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True)
    return "".join(done.stderr.strip().splitlines()[-1:]).removeprefix("error: ") if done.returncode else ""


def _server(watched: Watched, port: int) -> ThreadingHTTPServer:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.0"  # the end of an answer is the end of its connection

        def do_GET(self) -> None:
            asked = urlsplit(self.path)
            if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in _NAMES:
                return self.send_error(HTTPStatus.FORBIDDEN)
            with contextlib.suppress(ConnectionError):  # the browser has closed the page
                if asked.path == "/":
                    last = watched.ended.is_set()
                    self._answer("text/html; charset=utf-8", _page(watched))
                    watched.shown += last
                    return None
                if asked.path == "/changes":
                    return self._changes(parse_qs(asked.query).get("of", [""])[0])
                self.send_error(HTTPStatus.NOT_FOUND)
            return None

        def _changes(self, version: str) -> None:
            """Tell once that the page of `version` is out of date."""
            self._answer("text/event-stream", "")
            watched.waiting.add(self)
            try:
                while watched.version() == version:
                    time.sleep(_LOOK_S)
                    self.wfile.write(b":\n\n")  # notices that nobody listens any more
                self.wfile.write(b"data: changed\n\n")
            finally:
                watched.waiting.discard(self)

        def _answer(self, kind: str, text: str) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *_: object) -> None:
            """Say nothing on the terminal."""

    try:
        return ThreadingHTTPServer((_HOST, port), Handler)
    except (OSError, OverflowError) as error:
        raise ConfigError(f"--port: {port} cannot be used: {getattr(error, 'strerror', error)}") from None


def _page(watched: Watched) -> str:
    """The page, or one that tells what is wrong with the run's files."""
    try:
        return watched.html()
    except UserError as error:
        return f"<!DOCTYPE html><title>STAR</title><p>{html.escape(str(error))}</p>"


def _stat(path: Path) -> os.stat_result | None:
    try:
        return path.stat()
    except OSError:
        return None
