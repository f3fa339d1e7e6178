import io
import re

import pytest
from rich.cells import cell_len
from rich.console import Console

from star.agent.experiment import Star
from star.agent.kind import STAR
from star.training.console import Display, Stopwatch, clock, memory, sparkline

ROW = {
    "env_steps_per_s": 45_210,
    "abstraction/regions": 14.0,
    "refinement/edges": 3.0,
    "eval/success_any": 0.75,
    "eval/success_final": 0.5,
    "commander/reward": 0.3,
    "commander/td_error": 0.125,
    "tutor/reward": 1.5,
    "tutor/actor_loss": -0.02,
    "tutor/critic_loss": 0.25,
    "controller/reward": 0.1,
    "controller/actor_loss": -0.01,
    "controller/critic_loss": 2.0,
    "forward_model/loss": 0.0625,
}
SGIM = {"sgim/share_autonomous": 0.75, "sgim/share_guide": 0.25}
WHAT = {"experiment": Star.__new__(Star), "kind": STAR}  # which shows no more than rows tell
FAULTY = {"env/non_finite": 2.0, "env/overflow": 3.0}


class Clock:
    def __init__(self):
        self.time = 0.0

    def __call__(self):
        return self.time

    def during(self, stopwatch, part, seconds):
        with stopwatch.measure(part):
            self.time += seconds


@pytest.fixture
def now():
    return Clock()


@pytest.fixture
def stopwatch(now):
    return Stopwatch(now=now)


def terminal(width=80, **options):
    return Console(file=io.StringIO(), force_terminal=True, color_system=None, width=width, height=40, **options)


def written(console):
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue())


def last_view(console, *rows, stopwatch=None, done=0, left_s=75.0):
    """What stays on the terminal after an update with these rows."""
    display = Display(console, stopwatch or Stopwatch(), title="point_maze", **WHAT, total=100, done=done)
    with display:
        if rows:
            display.update(50, rows, left_s=left_s)
    return written(console).rpartition("╭")[2]


def plain(*rows, quiet=False, left_s=5.0):
    console = Console(file=io.StringIO(), force_terminal=False, width=200)
    with Display(console, Stopwatch(), **WHAT, total=100, done=0, quiet=quiet) as display:
        display.update(50, rows, left_s=left_s)
    return console.file.getvalue()


def test_compilation_is_left_out_of_the_estimate_of_the_time_left(now, stopwatch):
    now.during(stopwatch, "epoch", 100.0)
    assert stopwatch.left({"epoch": 3}) is None
    now.during(stopwatch, "epoch", 2.0)
    assert stopwatch.left({"epoch": 3}) == 6.0
    now.during(stopwatch, "evaluation", 50.0)
    assert stopwatch.left({"epoch": 3, "evaluation": 2}) == 6.0
    now.during(stopwatch, "evaluation", 0.5)
    assert stopwatch.left({"epoch": 3, "evaluation": 2}) == 7.0


def test_the_estimate_follows_the_latest_epochs(now, stopwatch):
    for seconds in (100.0, 1.0, 1.0, 4.0, 4.0, 4.0, 4.0, 4.0):
        now.during(stopwatch, "epoch", seconds)
    assert stopwatch.left({"epoch": 10}) == 40.0


def test_the_time_of_compiling_is_shown_while_it_lasts(now, stopwatch):
    assert stopwatch.compiling() is None
    for part in ("epoch", "evaluation"):
        with stopwatch.measure(part):
            now.time += 83
            assert stopwatch.compiling() == 83
            view = last_view(terminal(), stopwatch=stopwatch)
            assert "compiling" in view and "1:23" in view and "left" not in view
    with stopwatch.measure("epoch"):
        assert stopwatch.compiling() is None


def test_a_part_that_ends_in_an_error_leaves_the_stopwatch_as_it_was(now, stopwatch):
    with pytest.raises(KeyboardInterrupt), stopwatch.measure("epoch"):
        raise KeyboardInterrupt
    assert stopwatch.compiling() is None and stopwatch.left({"epoch": 1}) is None


def test_the_view_shows_what_a_run_is_doing():
    view = last_view(terminal(), ROW | SGIM | FAULTY)
    for text in (
        "training", "50%", "1:15 left", "50 of 100, 45,210/s", "0.75 ▇", "0.50 ▅", "success any", "14, 3 pairs reach",
        "autonomous 0.75  guide 0.25", "simulator faults  5", "GiB", "-0.02", "0.125", "0.0625",
    ):  # fmt: skip
        assert text in view


def test_what_a_run_does_not_have_is_not_shown():
    flat = {key: value for key, value in ROW.items() if key.startswith(("env", "controller/"))}
    view = last_view(terminal(), flat, left_s=None)
    for text in ("commander", "tutor", "forward", "regions", "success", "strategies", "faults", "left"):
        assert text not in view
    assert "controller" in view


@pytest.mark.parametrize("width", [30, 60, 80, 200])
def test_no_line_is_wider_than_the_terminal(width):
    many = {f"sgim/share_teacher_{n}": 0.1 for n in range(9)}
    lines = last_view(terminal(width), ROW | many | FAULTY).splitlines()
    assert max(cell_len("╭" * (i == 0) + line) for i, line in enumerate(lines)) == min(width, 90)
    assert len(lines) < 20


def test_a_terminal_that_is_interrupted_gets_its_cursor_back():
    console = terminal()
    with pytest.raises(KeyboardInterrupt), Display(console, Stopwatch(), **WHAT, total=9, done=0):
        raise KeyboardInterrupt
    hidden, shown = (console.file.getvalue().rindex(f"\x1b[?25{end}") for end in "lh")
    assert hidden < shown


def test_an_interrupted_run_says_that_it_stops():
    console = terminal()
    with Display(console, Stopwatch(), **WHAT, total=9, done=0) as display:
        display.stop()
    assert "stopping" in written(console) and "after this epoch" in written(console)


def test_without_a_terminal_there_is_one_plain_line_for_each_evaluation():
    facts = "success_final 0.50  success_any 0.75  regions 14, 3 pairs reach"
    begins = "compiling; then a line for each evaluation\n"
    assert plain(ROW) == f"{begins}50 / 100 env steps  45,210 env steps/s  {facts}  5 s left\n"
    assert plain({"env_steps_per_s": 1}) == begins
    assert "left" not in plain(ROW, left_s=None)


def test_quiet_is_quiet_but_warnings_are_shown():
    console = terminal()
    with Display(console, Stopwatch(), **WHAT, total=9, done=0, quiet=True) as display:
        display.update(5, [ROW], left_s=None)
        assert console.file.getvalue() == ""
        display.warn("disk [/full]")
    assert written(console) == "warning: disk [/full]\n"
    assert plain(ROW, quiet=True) == ""


def test_faults_of_the_simulator_are_shown_where_there_are_any():
    assert "simulator faults 5" in plain(ROW | FAULTY)
    assert "simulator faults 1" in plain(ROW | {"env/overflow": 1.0}, ROW, ROW)
    assert "faults" not in plain(ROW | {"env/non_finite": 0.0, "env/overflow": 0.0})


@pytest.mark.parametrize(
    ("shares", "bars"),
    [([0.0], "▁"), ([1.0], "█"), ([0.0, 0.5, 1.0], "▁▅█"), ([0, 0, 1, 1] * 6, "▁█▁█▁█▁█▁█▁█"), ([float("nan")], "▁")],
)
def test_a_sparkline_is_short_whatever_it_shows(shares, bars):
    assert sparkline(shares) == bars


@pytest.mark.parametrize(("seconds", "shown"), [(0.4, "0:00"), (59.6, "1:00"), (754, "12:34"), (7325, "2:02:05")])
def test_times_are_shown_as_on_a_clock(seconds, shown):
    assert clock(seconds) == shown


def test_memory_is_that_of_the_host_where_the_device_does_not_tell():
    used, peak = map(float, re.fullmatch(r"host ([0-9.]+) GiB, peak ([0-9.]+)", memory()).groups())
    assert 0.05 < used <= peak + 0.1


def test_memory_is_that_of_the_device_where_it_tells(monkeypatch):
    class Device:
        def memory_stats(self):
            return {"bytes_in_use": 2**30, "peak_bytes_in_use": 3 * 2**29, "bytes_limit": 80 * 2**30}

    monkeypatch.setattr("jax.local_devices", lambda: [Device()])
    assert memory() == "device 1.0 of 80.0 GiB, peak 1.5"
