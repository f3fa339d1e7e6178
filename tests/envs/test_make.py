import os
import subprocess
import sys

import jax
import pytest

import envs


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("point_mase", {}, ["point_mase", "point_maze", "ant_maze"]),
        ("point_maze", {"goal": "test"}, ["goal", "test", "goals"]),
        ("point_maze", {"goals": "tests"}, ["goals", "tests", "train, test"]),
        ("point_maze", {"episode_length": 0}, ["episode_length", "0", "from 1 to"]),
        ("point_maze", {"episode_length": True}, ["episode_length", "true", "whole number"]),
        ("point_maze", {"engine": "native"}, ["native", "auto, jax"]),
        ("ant_maze", {"engine": "wrap"}, ["wrap", 'did you mean "warp"']),
        ("ant_maze", {"integrator": "RK4"}, ["integrator", "RK4", "rk4"]),
        ("ant_maze", {"timestep": -0.1}, ["timestep", "-0.1", "seconds"]),
    ],
)
def test_a_wrong_name_or_value_is_told_in_one_line(name, options, words):
    with pytest.raises(envs.EnvError) as caught:
        envs.make(name, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words)


@pytest.mark.skipif(os.path.exists("/proc/driver/nvidia"), reason="needs a machine without an NVIDIA GPU")
def test_an_engine_that_cannot_run_here_says_what_it_needs():
    with pytest.raises(envs.EnvError, match="NVIDIA GPU") as caught:
        envs.make("ant_maze", engine="warp")
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="needs a machine without a GPU")
def test_auto_takes_native_physics_on_a_cpu():
    assert envs.make("ant_maze").engine == "native"
    assert envs.make("point_maze").engine == "jax"


@pytest.mark.parametrize("name", envs.names())
def test_every_task_can_be_made_and_names_itself(name):
    assert envs.make(name).name == name


def test_an_error_is_a_value_error():
    assert issubclass(envs.EnvError, ValueError)


SILENT = """
import sys, envs
assert len(envs.names()) > 15 and not {"jax", "mujoco", "brax"} & set(sys.modules), "names cost no JAX"
import star
for name in envs.names():
    envs.make(name)
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized(), "no device is taken by an import, nor by making"
"""


def test_import_and_make_are_silent_and_quick():
    before = os.times()
    done = subprocess.run([sys.executable, "-c", SILENT], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
    after = os.times()
    assert after.children_user + after.children_system - before.children_user - before.children_system < 15  # s of CPU
