"""A headless Chromium, driven over its DevTools protocol."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request

from websockets.sync.client import connect

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def program():
    """The browser that is installed, or None."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


@contextlib.contextmanager
def started(folder):
    """A `Browser` that keeps its files in `folder`."""
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"]
    quiet = ["--disable-extensions", "--disable-background-networking", "--mute-audio"]
    where = [f"--user-data-dir={folder}", "--remote-debugging-port=0", "about:blank"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([program(), *options, *quiet, *where], **silent) as process:
        try:
            port = _wait(lambda: (folder / "DevToolsActivePort").read_text().split()[0])
            address = _wait(lambda: next(tab for tab in _tabs(port) if tab["type"] == "page"))["webSocketDebuggerUrl"]
            with connect(address, max_size=None, ping_interval=None) as socket:
                browser = Browser(socket)
                yield browser
                browser.send("Browser.close")
        finally:
            process.terminate()


class Browser:
    """One tab. `problems` are the errors that pages have logged or thrown, `requests` the addresses they asked for."""

    def __init__(self, socket):
        self._socket, self._count = socket, 0
        self.problems, self.requests = [], []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method, **parameters):
        """The result of one command."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=30))
            if message.get("id") == self._count:
                assert "error" not in message, message["error"]
                return message["result"]
            self._note(message)

    def open(self, page, *, width=1280, height=900, dark=False):
        """Open a file or an address, and wait until it is drawn."""
        self.send("Page.navigate", url="about:blank")  # so that no page before it asks for anything more
        self.until("location.href === 'about:blank'", seconds=20.0)
        self.problems, self.requests = [], []
        phone = width < 600
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", features=scheme)
        self.send("Page.navigate", url=page if isinstance(page, str) else page.absolute().as_uri())
        self.until("document.readyState === 'complete' && document.querySelector('svg')", seconds=20.0)
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def run(self, script):
        """The value of a JavaScript expression; awaits promises."""
        found = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def until(self, condition, *, seconds=60.0):
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + seconds
        while not self.run(f"!!({condition})"):
            assert time.monotonic() < end, condition
            time.sleep(0.05)

    def screenshot(self, path):
        """The whole page as a picture."""
        shot = self.send("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))

    def _note(self, message):
        method, said = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(said["exceptionDetails"].get("exception", {}).get("description", "exception"))
        if method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.problems.append(str(said["args"]))
        if method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.problems.append(said["entry"]["text"])
        if method == "Network.requestWillBeSent":
            self.requests.append(said["request"]["url"])


def _wait(look, seconds=20.0):
    """What `look` gives once it no longer raises."""
    end = time.monotonic() + seconds
    while True:
        try:
            return look()
        except (OSError, LookupError, StopIteration):
            if time.monotonic() > end:
                raise
            time.sleep(0.05)


def _tabs(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=5) as answer:
        return json.load(answer)
