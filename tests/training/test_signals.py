import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from star.training import signals
from star.training.signals import Overdue, interruptible


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_stops_at_once(number):
    told = []
    before = signal.getsignal(number)
    with interruptible() as stop:
        stop.on_first = lambda: told.append(1)
        assert not stop()
        signal.raise_signal(number)
        assert stop() and stop.terminated == (number == signal.SIGTERM) and told == [1]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(number) is before


def test_what_is_computed_is_returned_and_its_errors_are_raised():
    with interruptible() as stop:
        assert stop.during(lambda: 7) == 7
        with pytest.raises(ZeroDivisionError):
            stop.during(lambda: 1 / 0)
    assert signals.leave(3) == 3


@pytest.fixture
def endless():
    """Something that computes until the test is over."""
    over = threading.Event()
    yield over.wait
    over.set()
    for thread in signals.computing():
        thread.join()


@pytest.mark.parametrize(("numbers", "raised"), [([signal.SIGTERM], Overdue), ([signal.SIGINT] * 2, KeyboardInterrupt)])
def test_a_long_computation_is_abandoned_and_the_process_leaves_it(monkeypatch, endless, numbers, raised):
    monkeypatch.setattr(signals, "GRACE_S", 0.0)
    left = []
    monkeypatch.setattr(os, "_exit", left.append)
    with interruptible() as stop:

        def compute():
            for number in numbers:
                os.kill(os.getpid(), number)
                while not stop():
                    pass
            endless()

        with pytest.raises(raised):
            stop.during(compute)
    signals.leave(5)
    assert left == [5]


def test_ctrl_c_waits_for_what_is_computed(monkeypatch):
    monkeypatch.setattr(signals, "GRACE_S", 0.0)
    with interruptible() as stop:
        assert stop.during(lambda: signal.raise_signal(signal.SIGINT) or 7) == 7
        assert stop()


def ended(script, tmp_path):
    """Code and output of a process that runs `script`, with a module `swallows` that hears Ctrl-C while imported."""
    (tmp_path / "swallows.py").write_text(
        "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGINT)\nexcept BaseException:\n    pass\n"
    )
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{Path(__file__).parents[2]}"}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_ctrl_c_ends_a_command_that_imports_still(tmp_path):
    script = "from star.cli import command; command._run = lambda _: __import__('swallows') and 0; command.main()"
    assert ended(script, tmp_path) == (130, "")


def test_an_interrupted_command_ends_without_taking_python_down_under_what_computes(tmp_path):
    script = """
import atexit, os, signal
from star.cli import command
atexit.register(print, "Python was taken down")
command._run = lambda _: os.kill(os.getpid(), signal.SIGINT)
command.main()
"""
    assert ended(script, tmp_path) == (130, "")
