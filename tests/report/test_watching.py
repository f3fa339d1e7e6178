"""`star watch`, over runs that are written by hand while their lock is held, as training holds it."""

import http.client
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from envs.common.errors import UserError
from star.cli import command
from star.config.loading import load_run
from star.report import watching
from star.training import lock
from tests.report.by_hand import lines, metrics


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    monkeypatch.setattr(watching, "_LOOK_S", 0.02)


@contextmanager
def served(run_dir, *, films=False):
    """The page's port, what is said, and `end`, which ends the run's training."""
    said, over = [], threading.Event()

    def serve():
        watching.serve(run_dir, load_run(run_dir, {}), port=0, films=films, say=said.append)
        over.set()

    with lock.locked(run_dir, warn=pytest.fail):
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        while not said:
            time.sleep(0.01)
        port = int(said[0].split(":")[-1].split("/")[0])
        yield SimpleNamespace(port=port, said=said, over=over)
    assert over.wait(20)


def get(port, path, host="localhost"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers={"Host": f"{host}:{port}"})
    answer = connection.getresponse()
    return answer.status, answer.read().decode()


def version(text):
    return text.partition('"watched":"')[2].partition('"')[0]


def test_the_page_is_told_of_what_the_run_writes_and_of_its_end(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 3.0)
    run_dir = make(rows=[])
    with served(run_dir) as page:
        status, text = get(page.port, "/")
        assert status == 200 and "as soon as it is complete" in text
        lines(run_dir / "metrics.jsonl", metrics(2, (0, 1)))
        text = get(page.port, "/")[1]
        before = version(text)
        assert before and '"env_steps":200' in text
        heard = []
        listener = threading.Thread(target=lambda: heard.append(get(page.port, f"/changes?of={before}")))
        listener.start()
        time.sleep(0.2)
        assert not heard
        lines(run_dir / "metrics.jsonl", metrics(4, (0, 1)))
        listener.join(10)
        assert heard[0][1].endswith("data: changed\n\n")
        text = get(page.port, "/")[1]
        assert version(text) != before and '"env_steps":400' in text
        listener = threading.Thread(target=lambda: heard.append(get(page.port, f"/changes?of={version(text)}")))
        listener.start()
    listener.join(10)
    assert heard[1][1].endswith("data: changed\n\n")


def test_it_ends_with_the_run_and_leaves_a_page_that_asks_no_more(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 0.0)
    run_dir = make()
    watched = watching.Watched(run_dir, load_run(run_dir, {}))
    assert version(watched.html()) == watched.version()
    assert "connect-src 'self'" in watched.html()
    watched.ended.set()
    assert '"watched":null' in watched.html()
    assert "connect-src 'none'" in watched.html()
    with served(run_dir) as page:
        assert not page.over.is_set()
    with pytest.raises(OSError):
        get(page.port, "/")


def test_only_this_machine_is_answered_and_only_about_the_page(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 0.0)
    with served(make()) as page:
        assert get(page.port, "/", host="somebody.example")[0] == 403
        assert get(page.port, "/config.yaml")[0] == 404
        assert get(page.port, "/", host="127.0.0.1")[0] == 200


def test_a_damaged_file_is_told_on_the_page(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 0.0)
    run_dir = make()
    with served(run_dir) as page:
        (run_dir / "metrics.jsonl").write_text("<b>nothing</b>\n")
        status, text = get(page.port, "/")
        assert status == 200 and "metrics.jsonl" in text and "<b>" not in text


def test_a_port_that_is_taken_is_told(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 0.0)
    run_dir = make()
    with served(run_dir) as page, pytest.raises(UserError, match=f"^--port: {page.port} cannot be used: Address"):
        watching.serve(run_dir, load_run(run_dir, {}), port=page.port, films=False, say=print)


def test_each_checkpoint_is_drawn_once_and_what_goes_wrong_is_said_once(make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 0.0)
    drawn, run_dir = [], make()

    def draw(words, **_):
        options = command.parsers()[1]["render"].parse_args(words[words.index("render") + 1 :])
        drawn.append(options.run)
        assert options.out == run_dir / "figures" / watching.FILM and options.out.parent.is_dir()  # before the run ends
        return SimpleNamespace(returncode=2 * (len(drawn) > 1), stderr="note: x\nerror: pictures need OpenGL\n")

    monkeypatch.setattr(watching.subprocess, "run", draw)
    with served(run_dir, films=True) as page:
        for number in (1, 2, 3):
            (run_dir / "checkpoints" / f"{100 * number}").mkdir(parents=True)
            while len(drawn) < number:
                time.sleep(0.01)
    assert drawn == 3 * [run_dir] and page.said[1:] == ["no film of 200 env steps: pictures need OpenGL"]


def test_in_a_browser_it_renews_itself_and_keeps_what_was_chosen(browser, make, monkeypatch):
    monkeypatch.setattr(watching, "_LAST_S", 60.0)  # it ends once the page has loaded the last state
    run_dir = make(rows=[])
    row = "document.querySelector('table.runs').textContent"
    with served(run_dir) as page:
        browser.send("Emulation.setDeviceMetricsOverride", width=800, height=400, deviceScaleFactor=1, mobile=False)
        browser.send("Page.navigate", url=f"http://localhost:{page.port}/")
        browser.until("document.body?.textContent.includes('as soon as it is complete')")
        lines(run_dir / "metrics.jsonl", metrics(2, (0, 1)))
        browser.until("document.querySelector('#evaluations svg')")
        browser.run("document.querySelector('#evaluations input[value=wall_s]').click()")
        browser.run("document.querySelector('#provenance').scrollIntoView()")
        place = browser.run("scrollY")
        assert "200 of 400" in browser.run(row) and "renewed as it goes" in browser.run("document.body.textContent")
        for _ in range(25):  # so that it loads itself again before it stands where it was
            lines(run_dir / "metrics.jsonl", metrics(4, (0, 1)))
            time.sleep(0.04)
        last = version(get(page.port, "/")[1])
        browser.until(f"document.querySelector('table.runs') && watched === '{last}'")
        assert "200 of 400" not in browser.run(row)
        assert browser.run("document.querySelector('#evaluations input[value=wall_s]').checked")
        assert "wall-clock, s" in browser.run("document.querySelector('#evaluations svg').textContent")
        browser.until(f"Math.abs(scrollY - {place}) < 50")
        assert place > 100 and browser.problems == []
    browser.until("!document.querySelector('#live')")
    assert "400" in browser.run(row) and browser.problems == []
