"""What all tests share: JAX on the CPU, compiled quickly, and a tiny hierarchy, recorded step by step."""

import os
from pathlib import Path

os.environ["JAX_PLATFORMS"] = "cpu"
# Compilation is most of what tests cost: it is done in haste, and kept for other processes and the next time. XLA's
# older emitter of fusions compiles an epoch in two thirds of the time.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")

from dataclasses import replace  # noqa: E402
from types import SimpleNamespace  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

import envs  # noqa: E402
from envs import opengl  # noqa: E402
from envs.maze import MazeEnv  # noqa: E402
from envs.tasks import TASKS  # noqa: E402
from star import loading  # noqa: E402
from star import program as programs  # noqa: E402
from star.agent import epoch as hierarchy
from star.agent import play as episode  # noqa: E402
from star.agent import state as states  # noqa: E402
from star.checkpoint import Checkpoints  # noqa: E402
from star.spec import Spec  # noqa: E402
from tests.browser import program, started

settings.register_profile("star", deadline=None, derandomize=os.environ.get("CI") == "true")
settings.load_profile("star")

EPISODE = 30
NUM_ENVS = 8

TINY = {
    "commander": {"period": 6},
    "tutor": {"period": 3, "unroll": 2, "ppo": {"hidden": [8], "passes": 1, "minibatches": 2}},
    "controller": {"ppo": {"hidden": [8], "passes": 1, "minibatches": 2}},
    # Cuts this close to the start let the agent cross regions in a few steps.
    "abstraction": {"max_regions": 18, "cuts": [[-0.2, 0.0, 0.2], [-0.2, 0.0, 0.2]], "min_width": 0.01},
    "forward_model": {"hidden": [8], "batch_size": 8, "buffer_size": 64, "updates_per_epoch": 2},
    "refinement": {"depth": 2, "pairs_per_epoch": 1, "min_transitions": 1, "min_visits": 1},
    "trainer": {"num_envs": NUM_ENVS},
}

# Of agents that have learnt nothing.
UNTRAINED = {
    "env": {"name": "point_maze", "engine": "jax", "options": {"episode_length": 40}},
    "commander": {"period": 20},
    "tutor": {"unroll": 2, "ppo": {"hidden": [8], "minibatches": 1}},
    "controller": {"ppo": {"hidden": [8], "minibatches": 1}},
    "abstraction": {"max_regions": 8},
    "forward_model": {"hidden": [8], "buffer_size": 64, "batch_size": 8},
    "trainer": {"num_envs": 4, "eval_episodes": 3, "num_seeds": 2, "seed": 5},
}


class Fused:
    """A body that flips (which terminates) or breaks (turns NaN, which truncates) early in most episodes.

    With l = 3 and k = 6, 2, 4 and 6 steps are within the first segment, within the second, and at the very end of a
    period. A negative fuse flips, a positive one breaks.
    """

    def __init__(self, body):
        self._body = body
        self.state_dim, self.action_size, self.dt, self.engine = body.state_dim, body.action_size, body.dt, body.engine
        self.orientation, self.velocity = body.orientation, body.velocity

    def init(self, rng, position):
        fuses = jnp.array([2.0, 6.0, -2.0, -4.0, -6.0, 1e6, 1e6, 1e6])
        return self._body.init(rng, position), jax.random.choice(jax.random.fold_in(rng, 1), fuses)

    def step(self, data, action):
        point, fuse = data
        point = self._body.step(point, action)
        fuse -= jnp.sign(fuse)
        return point.replace(position=jnp.where((fuse == 0) & (data[1] > 0), jnp.nan, point.position)), fuse

    def observe(self, data, steps):
        return self._body.observe(data[0], steps)

    def flipped(self, data):
        return data[1] == 0

    def fallen(self, data):
        return jnp.zeros((), bool)

    def dropped(self, data):
        return jnp.zeros((), bool)


LONGEST = ("test_trainer.py", "test_hierarchy.py", "test_strategies.py")


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that both workers end at the same time."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="session")
def can_draw():
    """Skips the test where no OpenGL loads."""
    try:
        opengl.backend()
    except envs.EnvError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A headless Chromium; skips the test where none is installed."""
    if program() is None:
        pytest.skip("no Chromium is installed")
    with started(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A run directory with one checkpoint of agents that have learnt nothing but move, of the seeds 5 and 6."""
    run_dir = tmp_path_factory.mktemp("runs") / "new"
    run_dir.mkdir()
    program = programs.build(loading.parse(UNTRAINED))
    state = program.init(program.seed_keys())
    strong = jax.tree.map(lambda x: 30 * x, state.controller.params)
    state = state.replace(controller=state.controller.replace(params=strong))
    (run_dir / "config.yaml").write_text(program.config.to_yaml())
    checkpoints = Checkpoints(run_dir)
    checkpoints.save(160, state, program.config, success=0.0)
    checkpoints.close()
    return run_dir


@pytest.fixture(scope="session")
def tiny():
    """Values of the tiny hierarchy's configuration: k = 6, l = 3."""
    return TINY


@pytest.fixture(scope="session")
def breaking_env():
    """Point Maze whose episodes end early in more than half of all cases, some terminated, some truncated."""
    env = MazeEnv(
        "breaking",
        TASKS["point_maze"],
        Fused(envs.make("point_maze").body),
        goals="train",
        start="task",
        episode_length=EPISODE,
        reward="distance",
        success_radius=5.0,
        flip="terminate",
    )
    return envs.VectorEnv(env, NUM_ENVS, auto_reset=False)


@pytest.fixture(scope="session")
def turning(breaking_env):
    """What the levels know of it if its whole state is read as a quaternion and subgoals set a heading."""
    return replace(Spec.of(breaking_env.env, heading=2.0), orientation=(0, 1, 2, 3))


def record(agent, spec, env, state, key):
    """Every intermediate value of one episode, segment by segment; leading axis [segments]."""

    def segment(streams, key):
        command_key, tutor_key, rollout_key, reset_key = jax.random.split(key, 4)
        allowed = episode.successors(agent, state)
        before = streams
        commanded = episode.command(agent, spec, state, allowed, before, epsilon=0.5, key=command_key)
        subgoal, action = episode.choose_subgoal(agent, spec, state, commanded, deterministic=False, key=tutor_key)
        rolled, steps = episode.rollout(
            agent, spec, env, state, commanded, subgoal, deterministic=False, key=rollout_key
        )
        advanced = episode.advance(agent, rolled)
        decision, outcome = hierarchy.finished_period(agent, spec, state, advanced, steps)
        saved = {
            "before": before,
            "commanded": commanded,
            "subgoal": subgoal,
            "rolled": rolled,
            "steps": steps,
            "advanced": advanced,
            "decision": decision,
            "outcome": outcome,
            "tutor": hierarchy._tutor_transition(agent, spec, advanced, before.env.obs, action, steps),
            "controller": hierarchy._controller_rollout(agent, spec, steps, env_steps=0.0),
        }
        return episode.restart_ended(spec, env, advanced, steps, key=reset_key), saved

    start_key, scan_key = jax.random.split(key)
    streams = episode.start(spec, env, practice=0.6, key=start_key)
    keys = jax.random.split(scan_key, spec.episode_length // agent.tutor.period)
    last, saved = jax.lax.scan(segment, streams, keys)
    return last, saved


@pytest.fixture(scope="session", params=["published", "ours"])
def recording(request, breaking_env):
    """One recorded episode of the tiny hierarchy, as NumPy arrays, with what is needed to check it."""
    published = request.param == "published"
    overrides = {
        "commander.reward": "max" if published else "mean",
        "tutor.reward": "distance" if published else "progress",
        "controller.reward": "distance" if published else "progress",
        "tutor.relative_bounds": not published,
        "tutor.reward_scale": 0.1,
        "controller.reward_scale": 0.5,
    }
    parsed = loading.parse(TINY, overrides)
    agent, spec = parsed.agent(), Spec.of(breaking_env.env)

    def whole(key):
        state = states.init(agent, spec, key=key)
        # Greedy choices often fall on the goal's own region.
        eye = jnp.eye(state.abstraction.capacity)
        q = jnp.broadcast_to(eye, state.commander.q.shape)
        known = state.commander.replace(q=q, model=state.commander.model.replace(reach=q))
        state = state.replace(commander=known)
        return state.abstraction, record(agent, spec, breaking_env, state, key)

    abstraction, (last, saved) = to_numpy(jax.jit(whole)(jax.random.key(2)))
    return SimpleNamespace(config=parsed, spec=spec, abstraction=abstraction, last=last, published=published, **saved)


def to_numpy(tree):
    """The tree with NumPy arrays, typed keys left out."""

    def convert(leaf):
        return None if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.asarray(leaf)

    return jax.tree.map(convert, tree)
