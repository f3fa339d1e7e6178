"""A process for each GPU: which ones, and what becomes of them; the processes here are stand-ins without a GPU."""

import os
import signal
import sys
import threading
import time

import pytest

from star import processes
from star.config import ConfigError
from star.loading import parse

STAND_IN = """
import os, pathlib, signal, sys, time
folder, behaviour = pathlib.Path(sys.argv[1]), sys.argv[2].split(",")
address, number, count = sys.argv[4].split(",")
assert sys.argv[3] == "--distributed" and address.startswith("localhost:")
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
(folder / number).write_text(os.environ["CUDA_VISIBLE_DEVICES"] + " of " + count)
print("out of", number, flush=True)
print("error of", number, file=sys.stderr, flush=True)
mine = behaviour[int(number)]
if mine == "waits":
    time.sleep(60)
sys.exit(int(mine))
"""


@pytest.fixture
def two_gpus(monkeypatch):
    """A machine with MJX-Warp and two GPUs."""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(processes.importlib.util, "find_spec", lambda name: name == "warp" or None)
    monkeypatch.setattr(processes, "look", lambda: ("warp", 2))


def test_what_is_here_is_seen_from_a_process_of_its_own():
    assert processes.look() == ("native", 1)


def config(**settings):
    return parse({"env": {"name": "ant_maze"}, "trainer": {"num_envs": 64, "devices": 2}}, settings)


def start(tmp_path, behaviour, gpus):
    return processes.run([sys.executable, "-c", STAND_IN, str(tmp_path), behaviour], gpus)


def test_several_gpus_with_warp_need_a_process_each(two_gpus, monkeypatch):
    assert processes.gpus(config()) == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,GPU-7")
    assert processes.gpus(config(**{"env.engine": "warp"})) == ["5", "GPU-7"]
    with pytest.raises(ConfigError, match=r"^trainer.devices: 4 are .* sees 2 \(gpu\); allowed: 1 to 2$"):
        processes.gpus(config(**{"trainer.devices": 4}))


@pytest.mark.parametrize(
    "settings",
    [
        {"trainer.devices": 1},
        {"trainer.device": "cpu"},
        {"env.engine": "jax"},
        {"env.name": "point_maze"},
        {"env.name": "unheard_of"},  # refused later
    ],
)
def test_all_else_is_done_by_one_process(two_gpus, settings):
    assert processes.gpus(config(**settings)) == []


def test_each_process_has_its_gpu_and_its_number_and_the_first_one_speaks(tmp_path, capfd):
    assert start(tmp_path, "0,0", ["5", "7"]) == 0
    assert [(tmp_path / number).read_text() for number in "01"] == ["5 of 2", "7 of 2"]
    assert capfd.readouterr() == ("out of 0\n", "error of 0\n")


def test_when_one_fails_it_is_heard_and_the_others_are_ended(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(processes, "GRACE_S", 0.2)
    began = time.monotonic()
    assert start(tmp_path, "waits,2", ["0", "1"]) == 2
    assert time.monotonic() - began < 30
    assert capfd.readouterr().err.endswith("out of 1\nerror of 1\n")


def test_a_refusal_by_all_is_said_once(tmp_path, capfd):
    assert start(tmp_path, "2,2", ["0", "1"]) == 2
    assert capfd.readouterr().err == "error of 0\n"


def test_sigterm_is_passed_on(tmp_path):
    def terminate():
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=terminate)
    thread.start()
    assert start(tmp_path, "waits,waits", ["0", "1"]) == 0
    thread.join()
