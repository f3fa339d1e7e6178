"""What all tests share: JAX on the CPU, compiled quickly, and a tiny hierarchy, recorded step by step."""

import gc
import os
from importlib.metadata import version
from pathlib import Path

os.environ["JAX_PLATFORMS"] = "cpu"
# Compilation is most of what tests cost: it is done in haste, and kept for other processes and the next time. XLA's
# older emitter of fusions compiles an epoch in two thirds of the time; JAX 0.11 has it no more, and ends at its name.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    + " --xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_COMPILE"
    + " --xla_cpu_use_fusion_emitters=false" * version("jax").startswith("0.10."),
)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")  # to keep smaller ones costs more
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # nobody reads where in our code an operation comes from

from dataclasses import replace  # noqa: E402
from types import SimpleNamespace  # noqa: E402
from typing import Any, NamedTuple  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from PIL import Image  # noqa: E402

import envs  # noqa: E402
from envs import arena, opengl  # noqa: E402
from envs.common import modes, plugins  # noqa: E402
from envs.maze import MazeEnv  # noqa: E402
from envs.tasks import TASKS  # noqa: E402
from star.agent import commander, controller, levels, play, tutor  # noqa: E402
from star.agent.decisions import Roadmap  # noqa: E402
from star.agent.sections import StarTrainerConfig  # noqa: E402
from star.config import loading  # noqa: E402
from star.spec import Spec  # noqa: E402
from star.training import loop  # noqa: E402
from star.training import program as programs  # noqa: E402
from star.training.checkpoint import Checkpoints  # noqa: E402
from tests.browser import program, started

# What is imported and traced stays: to look through it for garbage again and again is a tenth of all time.
gc.freeze()
gc.set_threshold(100_000, 20, 100)

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

    def unhealthy(self, data):
        return jnp.zeros((), bool)

    def dropped(self, data):
        return jnp.zeros((), bool)


# What no file after the first few takes longer than is how far apart the workers end.
LONGEST = (
    "test_trainer.py",
    "test_docs.py",
    "test_strategies.py",
    "test_epoch.py",
    "test_faults.py",
    "test_scripts.py",
    "test_wheel.py",
    "test_sweep.py",
    "test_devices.py",
    "test_selection.py",
    "test_chime_runs.py",
    "test_acting.py",
    "test_development.py",
    "test_tasks.py",
    "test_mistakes.py",
    "test_play.py",
    "test_exams.py",
    "test_refinement.py",
    "test_physics.py",
    "test_sb3.py",
    "test_films.py",
    "test_chronosrl.py",
    "test_crl.py",
    "test_environment.py",
    "test_td3.py",
    "test_commander.py",
    "test_gym.py",
)


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that both workers end at the same time."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(places)))


@pytest.fixture(scope="session", autouse=True)
def compiled_once():
    """Compiling takes most of the time of tests, and a program has no state: configs of one structure share it."""
    build, known = programs.build, {}

    def shared(config):
        modes.check_training()
        key = compiled(config)
        if key is None:
            return build(config)
        if key not in known:
            program = build(config)
            known[key] = known.setdefault(compiled(program.config), program)  # with which a run goes on
        program = known[key]
        resolved = program.experiment.resolve(config)
        return replace(program, config=resolved, hyper=resolved.hyper())

    programs.build = shared
    yield
    programs.build = build


def compiled(config):
    """The structure of `config`, whatever the loop around its program does; None if it depends on files."""
    if config.experiment == "saht":
        return None if any(one.source != "world" for one in config.saht.teachers) else programs.structure(config)
    if config.experiment == "chime":
        return programs.structure(config)
    if config.experiment != "star" or ":" in config.env.name:
        return None
    learners = any(":" in level.learner for _, level, _ in config.learners())
    if learners or any(teacher.source != "map" for teacher in config.sgim.teachers):
        return None
    try:
        maps = {key: with_map(getattr(config.env, key)) for key in ("options", "training")}
    except (envs.EnvError, TypeError, AttributeError):
        return None
    names = ("num_envs", "eval_episodes", "device", "devices")
    trainer = StarTrainerConfig(**{name: getattr(config.trainer, name) for name in names})
    return programs.structure(config.model_copy(update={"env": config.env.model_copy(update=maps), "trainer": trainer}))


def with_map(options):
    """These options with the rows of their map instead of its file, which may change."""
    return options | {"map": arena.load(options["map"])} if "map" in options else options


@pytest.fixture(autouse=True)
def nobody_trusted(monkeypatch):
    """Each test begins with no trusted module, and what its commands trust is forgotten after it."""
    monkeypatch.setenv(plugins.TRUSTED, "")


@pytest.fixture
def undrawn():
    """Runs of the test make their figures and draw none: that takes longer than all else. Those of fixtures do draw."""

    def save(figure, path):
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (1, 1)).save(path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "save", save)
        yield


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
    checkpoints.save(160, state, program.config, score=0.0)
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
def fresh(tiny, breaking_env):
    """The tiny hierarchy as it begins, from a seed, with other sections of its settings if these are given."""
    init, spec = jax.jit(levels.init, static_argnames="spec"), Spec.of(breaking_env.env)

    def begun(seed=0, **sections):
        return init(loading.parse({**tiny, **sections}).hyper(), spec, key=jax.random.key(seed))

    return begun


@pytest.fixture(scope="session")
def turning(breaking_env):
    """What the levels know of it if its whole state is read as a quaternion and subgoals set a heading."""
    return replace(Spec.of(breaking_env.env, heading=2.0), orientation=(0, 1, 2, 3))


class Steps(NamedTuple):
    """A segment with both ends of each of its env steps, [l, B]."""

    obs: Any
    next_obs: Any
    subgoal: Any
    next_subgoal: Any
    alive: Any
    ended: Any
    terminated: Any
    non_finite: Any
    success: Any
    distance: Any

    @classmethod
    def of(cls, passed):
        """Those of a `star.agent.segments.Segment`."""
        same = {name: getattr(passed, name) for name in cls._fields if hasattr(passed, name)}
        ends = {name: getattr(passed, name)[:-1] for name in ("obs", "subgoal")}
        return cls(**same | ends, next_obs=passed.obs[1:], next_subgoal=passed.subgoal[1:])


def record(config, spec, env, state, key):
    """Every intermediate value of one episode, segment by segment; leading axis [segments]."""
    agent = levels.of(config, spec)
    roadmap = Roadmap.of(config.commander, state.abstraction, state.graph)
    nobody = jnp.zeros(())

    def segment(before, key):
        *keys, reset_key = jax.random.split(key, 4)
        rolled, passed, marks = play.segment(agent, env, state, roadmap, before, env_steps=nobody, keys=keys)
        memory, finished = commander.experience(config.commander, agent.task, roadmap, rolled.memory, passed, marks)
        renewed = commander.renewed(memory)
        advanced = rolled.replace(memory=memory)
        saved = {
            "before": before,
            "commanded": rolled.memory,
            "subgoal": passed.choice.subgoal,
            "rolled": rolled,
            "steps": Steps.of(passed),
            "passed": passed,
            "advanced": advanced,
            "decision": finished.decision,
            "outcome": finished.outcome,
            "tutor": tutor.experience(config.tutor, agent.task, passed, marks, renewed=renewed),
            "controller": controller.experience(config.controller, agent.task, passed, env_steps=0.0),
        }
        return play.restart_ended(agent, env, advanced, passed, key=reset_key), saved

    start_key, scan_key = jax.random.split(key)
    streams = play.start(agent, env, key=start_key)
    return jax.lax.scan(segment, streams, jax.random.split(scan_key, spec.episode_length // config.tutor.period))


@pytest.fixture(scope="session", params=["published", "ours"])
def recording(request, breaking_env):
    """One recorded episode of the tiny hierarchy, as NumPy arrays, with what is needed to check it."""
    published = request.param == "published"
    overrides = {
        "commander.reward": "max" if published else "mean",
        "tutor.reward": "distance" if published else "progress",
        "controller.reward": "distance" if published else "progress",
        "tutor.relative_bounds": not published,
        "tutor.straight": not published,
        "tutor.reward_scale": 0.1,
        "controller.reward_scale": 0.5,
        "commander.epsilon_start": 0.5,
        "commander.epsilon_spread": False,
    }
    parsed = loading.parse(TINY, overrides)
    agent, spec = parsed.hyper(), Spec.of(breaking_env.env)

    def whole(key):
        state = levels.init(agent, spec, key=key)
        # Greedy choices often fall on the goal's own region.
        eye = jnp.eye(state.abstraction.capacity)
        q = jnp.broadcast_to(eye, state.commander.q.shape)
        known = state.commander.replace(q=q)
        state = state.replace(commander=known)
        return state.abstraction, record(agent, spec, breaking_env, state, key)

    abstraction, (last, saved) = to_numpy(jax.jit(whole)(jax.random.key(2)))
    return SimpleNamespace(config=parsed, spec=spec, abstraction=abstraction, last=last, published=published, **saved)


def to_numpy(tree):
    """The tree with NumPy arrays, typed keys left out."""

    def convert(leaf):
        return None if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else np.asarray(leaf)

    return jax.tree.map(convert, tree)
