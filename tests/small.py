"""A run on a maze small enough to train in a second, and teachers who show it a few ways."""

import shutil
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from star.sgim.teachers import Demonstrations
from star.training.checkpoint import opened

EPOCH = 4 * 60  # env steps

RUN = {
    "env": {"name": "point_maze", "engine": "jax", "options": {"episode_length": 60}},
    "commander": {"period": 20},
    "tutor": {"unroll": 3, "ppo": {"hidden": [8], "passes": 1, "minibatches": 1}},
    "controller": {"ppo": {"hidden": [8], "passes": 1, "minibatches": 1}},
    "abstraction": {"max_regions": 8, "cuts": [[8.0], [8.0]]},
    "forward_model": {"hidden": [8], "buffer_size": 64, "batch_size": 8, "updates_per_epoch": 2},
    "refinement": {"min_transitions": 1, "min_visits": 1, "depth": 1, "pairs_per_epoch": 1},
    "trainer": {"num_envs": 4, "total_env_steps": 4 * EPOCH, "eval_every": 2, "eval_episodes": 3},
}

# The Controller alone: where any agent will do, it compiles in a fifth of the time.
ALONE = RUN | {"commander": {"enabled": False}, "tutor": {"enabled": False, "unroll": 1}}

GUIDE = {"name": "guide", "kind": "decomposition"}
ACTS = {"name": "acts", "kind": "action", "source": "demos.npz"}


def arrays(run, env_steps):
    """Those of a checkpoint, by their names."""
    with opened(Path(run)) as checkpoints:
        return checkpoints.arrays(env_steps)


def killed(run, copy, *, steps):
    """A copy of `run` as if it had been killed in a line of metrics, before the checkpoints at `steps`."""
    shutil.copytree(run, copy)
    for step in steps:
        shutil.rmtree(f"{copy}/checkpoints/{step}")
    with Path(copy, "metrics.jsonl").open("a") as file:
        file.write('{"seed": 0, "env_')


def assert_the_same(run, other, env_steps):
    """All arrays of two runs' checkpoints, bit for bit; returns their names."""
    found, expected = arrays(run, env_steps), arrays(other, env_steps)
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    return expected.keys()


def change(file, right, wrong):
    """Put `wrong` in the place of `right`, which the text of a file holds once."""
    text = file.read_text()
    assert text.count(right) == 1
    file.write_text(text.replace(right, wrong))


def unpacked(name, folder):
    """The run in `tests/data/<name>.zip`, in a new folder below `folder`."""
    shutil.unpack_archive(Path(__file__).parent / "data" / f"{name}.zip", folder / name)
    return folder / name


def demonstrations(seed=0, n=5, length=3):
    """What a teacher shows: `n` random episodes with `length` waypoints each."""
    rng = np.random.default_rng(seed)
    points = lambda *shape: jnp.asarray(rng.uniform(0, 4, (*shape, 2)), jnp.float32)  # noqa: E731
    lengths = jnp.asarray(rng.integers(1, 7, n))
    return Demonstrations(
        starts=points(n),
        outcomes=points(n),
        waypoints=points(n, length),
        states=jnp.asarray(rng.normal(size=(n, 8, 4)), jnp.float32),
        actions=jnp.asarray(rng.normal(size=(n, 8, 2)), jnp.float32),
        lengths=lengths,
    )
