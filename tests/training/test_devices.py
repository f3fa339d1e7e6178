"""Several devices and processes, in processes of their own: how many devices JAX has is settled at its start."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from envs.common.errors import UserError
from star import cli, devices
from star.config.loading import parse
from star.training.checkpoint import opened
from tests.small import RUN

ROOT = Path(__file__).parents[2]

REPLAY = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp, numpy as np
from envs.common.batching import flattened, shared_out
from star import devices
from star.agent.sections import Config
from star.learners import td3
from star.learners.replay import Transition
from star.learners.sections import TD3Config
from star.training.checkpoint import Checkpoints

config = TD3Config(hidden=(8,), batch_size=16, buffer_size=64, updates_per_rollout=2, min_transitions=16)
zero, number = jnp.zeros(()), lambda *shape: jax.random.normal(jax.random.key(len(shape)), shape)
example = Transition(obs=jnp.zeros(3), action=jnp.zeros(2), reward=zero, next_obs=jnp.zeros(3), terminated=zero,
                     cut=zero, weight=zero)
rollout = Transition(obs=number(5, 8, 3), action=number(5, 8, 2), reward=number(5, 8), next_obs=number(5, 8, 3),
                     terminated=jnp.zeros((5, 8)), cut=jnp.zeros((5, 8)), weight=jnp.ones((5, 8)))
state = td3.init(jax.random.key(0), config, example=example)

def learn(mesh):
    places = jax.tree.map(lambda _: devices.everywhere(mesh), state)
    slots = jax.tree.map(lambda _: devices.in_shares(mesh, axis=1), state.ring.experience)
    places = places.replace(ring=places.ring.replace(experience=slots))
    update = lambda state, rollout, key: td3.update(config, state, rollout, key=key)[0]
    update = jax.jit(devices.on(mesh, update), out_shardings=places)
    learnt, ours = jax.device_put(state, places), jax.device_put(rollout, devices.in_shares(mesh, axis=1))
    for number in range(2):  # the second one goes beyond the end of the ring
        learnt = update(learnt, ours, jax.random.key(number))
    assert update._cache_size() == 1
    return learnt

one, four = learn(None), learn(devices.mesh(4))
assert four.ring.experience.obs.addressable_shards[0].data.shape == (1, 16, 3)
jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), one, jax.device_get(four))

@flattened
def walk(state):
    at, none = state
    assert at.shape == (2, 1) and none.shape == (2, 0), "a share of each"
    return at + 1, none

mesh = devices.mesh(4)
steps = jax.jit(devices.on(mesh, jax.vmap(shared_out(walk))), out_shardings=devices.everywhere(mesh))
at, none = steps((jnp.zeros((1, 8, 1)), jnp.zeros((1, 8, 0))))
assert (at == 1).all() and none.shape == (1, 8, 0)

drifted = jax.make_array_from_single_device_arrays(
    (2,), devices.everywhere(devices.mesh(4)), [jax.device_put(jnp.full(2, float(i)), d) for i, d in
    enumerate(jax.devices())])
same = jax.jit(devices.on(devices.mesh(4), devices.as_on_first))(drifted + 1)
assert [float(shard.data[0]) for shard in same.addressable_shards] == [1.0] * 4

checkpoints = Checkpoints(Path(sys.argv[1]))
checkpoints.save(7, {"x": jax.device_put(jnp.arange(3.0), jax.devices()[3])}, Config(), score=0.0)
checkpoints.close()
"""

PROCESS = """
import sys
from pathlib import Path
import jax, jax.numpy as jnp, mujoco, numpy as np
from envs import VectorEnv, make
from envs.physics import Physics
from star import devices
from star.training.checkpoint import Checkpoints
from star.agent.sections import Config
from star.training.journal import Journal

address, number, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
devices.join(f"{address},{number},2")
assert devices.first() == (number == 0)
mesh = devices.mesh(2)
batch = VectorEnv(make("point_maze"), 4, auto_reset=False)
falling = '<mujoco><worldbody><body><joint type="slide" axis="0 0 1"/><geom size="1"/></body></worldbody></mujoco>'
physics = Physics(mujoco.MjModel.from_xml_string(falling), engine="jax", frames=1)

def fall(height):
    return physics.step(physics.init(height, jnp.zeros(1)), jnp.zeros(0)).qpos

def walk(key):
    state = devices.share(batch.reset(key))
    state = batch.step(state, jnp.ones((4, 2)))
    return {"far": devices.whole(state.obs), "fallen": jax.vmap(fall)(jnp.ones((4, 1)))}

state = jax.jit(devices.on(mesh, walk), out_shardings=devices.everywhere(mesh))(jax.random.key(3))
Journal.of(folder, tables="regions", muted=not devices.first()).metrics.write({"process": number})
assert devices.anywhere(number == 1) and not devices.anywhere(False)
checkpoints = Checkpoints(folder)
checkpoints.save(1, state, Config(), score=0.0)
checkpoints.close()
devices.wait("the end")
assert (folder / "metrics.jsonl").read_text() == '{"process": 0}\\n'
np.save(folder / f"{number}.npy", jax.device_get(state)["far"])
assert (0.99 < state["fallen"]).all() and (state["fallen"] < 1).all()
"""


def start(script, *arguments, count):
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XLA_FLAGS": flags}
    return subprocess.Popen(
        [sys.executable, "-c", script, *map(str, arguments)], env=environment, stderr=subprocess.PIPE, text=True
    )


def end(process):
    error = process.communicate(timeout=240)[1]
    assert process.returncode == 0, error


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """How a process with four devices ended, and the folder of the checkpoint that it saved on the last one."""
    folder = tmp_path_factory.mktemp("four")
    process = start(REPLAY, folder, count=4)
    error = process.communicate(timeout=240)[1]
    return process.returncode, error, folder


def test_replay_is_cut_among_devices_and_learns_the_same_and_copies_follow_the_first(four):
    code, error, _ = four
    assert code == 0, error


def test_a_checkpoint_loads_on_a_machine_without_the_device_it_was_saved_on(four):
    with opened(four[-1]) as checkpoints:
        assert checkpoints.restore(7, {"x": np.zeros(3, np.float32)})["x"].tolist() == [0, 1, 2]


def test_two_processes_step_one_batch_and_the_first_alone_writes(tmp_path):
    import jax
    import jax.numpy as jnp

    from envs import VectorEnv, make
    from star.training.checkpoint import Checkpoints

    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    for process in [start(PROCESS, address, number, tmp_path, count=1) for number in range(2)]:
        end(process)
    batch = VectorEnv(make("point_maze"), 4, auto_reset=False)
    alone = jax.jit(lambda key: batch.step(batch.reset(key), jnp.ones((4, 2))).obs)(jax.random.key(3))
    for number in range(2):
        np.testing.assert_allclose(np.load(tmp_path / f"{number}.npy"), alone, rtol=1e-6)
    checkpoints = Checkpoints(tmp_path)
    restored = checkpoints.restore(1, {"far": alone, "fallen": jnp.zeros((4, 1))})
    np.testing.assert_allclose(restored["far"], alone, rtol=1e-6)
    checkpoints.close()


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"trainer.devices": 3}, "trainer.num_envs: 4 cannot be shared evenly by trainer.devices 3"),
        (
            {"trainer.devices": 4, "tutor.ppo.minibatches": 2},
            "tutor.ppo.minibatches: 2 makes minibatches of 6, which cannot be shared evenly by trainer.devices 4",
        ),
        (
            {"trainer.devices": 4, "controller.learner": "td3", "controller.td3.buffer_size": 4002},
            "controller.td3.buffer_size: 4002 cannot be shared evenly by trainer.devices 4",
        ),
        ({"trainer.devices": 0}, "trainer.devices: 0 is not allowed: should be greater than 0"),
    ],
)
def test_devices_must_share_evenly(settings, line):
    with pytest.raises(UserError) as error:
        parse(RUN, settings)
    assert str(error.value).endswith(line)


def test_devices_that_are_not_there_are_refused_in_one_line():
    with pytest.raises(UserError, match=r"^trainer.devices: 4 are not available, JAX sees 1 \(cpu\); allowed: 1$"):
        devices.mesh(4)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--distributed", "auto"], "--distributed: needs --run-dir, the same for all processes"),
        (
            ["--run-dir", "new", "--distributed", "here"],
            "--distributed: 'here' is neither auto nor of the form HOST:PORT,NUMBER,COUNT",
        ),
        (
            ["--run-dir", "new", "--distributed", "here:1,2,2"],
            "--distributed: process 2 is not among those of 2: 0 to 1",
        ),
    ],
)
def test_processes_that_cannot_meet_are_refused_in_one_line(arguments, line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", str(ROOT / "configs" / "point_maze.yaml"), *arguments]) == 2
    assert capsys.readouterr().err == f"error: {line}\n"
    assert not list(tmp_path.iterdir())
