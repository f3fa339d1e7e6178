#!/usr/bin/env python
"""Cross what people put together, and see that each pair works or is refused in one line: docs/compatibility.md.

    python scripts/checks/matrix.py --out results/compatibility/cpu.json [--jobs 2]
    python scripts/checks/matrix.py --page docs/compatibility.md results/compatibility/*.json

Five tables: objects x modes of JAX and Python, objects x transformations of JAX, objects x ways to travel, options and
settings x types, files x encodings. A cell holds `works`, the one line that refuses, or `FAULT` and what happened;
with a fault the exit code is 1. `--page` writes the tables of one or several machines into the page.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import multiprocessing
import os
import pickle
import platform
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scripts.processes import importing

ROOT = Path(__file__).parents[2]
Table = dict[str, dict[str, str]]
WORKS = "works"
LIMIT = 900  # s, of all objects in one mode
MODES: Mapping[str, tuple[Mapping[str, str], Sequence[str]]] = {
    "as it is": ({}, ()),
    "`JAX_ENABLE_X64`": ({"JAX_ENABLE_X64": "1"}, ()),
    "`JAX_NUMPY_DTYPE_PROMOTION=strict`": ({"JAX_NUMPY_DTYPE_PROMOTION": "strict"}, ()),
    "`JAX_NUMPY_RANK_PROMOTION=raise`": ({"JAX_NUMPY_RANK_PROMOTION": "raise"}, ()),
    "`JAX_DEBUG_NANS`": ({"JAX_DEBUG_NANS": "1"}, ()),
    "`JAX_DEBUG_INFS`": ({"JAX_DEBUG_INFS": "1"}, ()),
    "`JAX_DISABLE_JIT`": ({"JAX_DISABLE_JIT": "1"}, ()),
    "`JAX_CHECK_TRACER_LEAKS`": ({"JAX_CHECK_TRACER_LEAKS": "1"}, ()),
    "`JAX_DEFAULT_PRNG_IMPL=rbg`": ({"JAX_DEFAULT_PRNG_IMPL": "rbg"}, ()),
    "`JAX_DEFAULT_PRNG_IMPL=unsafe_rbg`": ({"JAX_DEFAULT_PRNG_IMPL": "unsafe_rbg"}, ()),
    "`JAX_THREEFRY_PARTITIONABLE=0`": ({"JAX_THREEFRY_PARTITIONABLE": "0"}, ()),
    "`JAX_DEFAULT_MATMUL_PRECISION=bfloat16`": ({"JAX_DEFAULT_MATMUL_PRECISION": "bfloat16"}, ()),
    "`JAX_PLATFORMS=cpu`": ({"JAX_PLATFORMS": "cpu"}, ()),
    "`JAX_PLATFORMS=abacus`": ({"JAX_PLATFORMS": "abacus"}, ()),
    "`python -O`": ({}, ("-O",)),
}
TRAINED = ROOT / "scripts/checks/smallest.yaml"


# Objects, each used for a few steps


def sound(tree: Any) -> None:
    """Raise unless all floats of `tree` are finite and none has more than 32 bits."""
    import jax

    for leaf in jax.tree.leaves(tree):
        if hasattr(leaf, "dtype") and np.issubdtype(leaf.dtype, np.floating):
            assert leaf.dtype.itemsize <= 4, f"numbers are {leaf.dtype}"
            assert np.isfinite(np.asarray(leaf)).all(), "numbers are not finite"


def single(name: str, **options: Any) -> Any:
    """An environment: reset and step."""
    import jax
    import jax.numpy as jnp

    import envs

    env = envs.make(name, episode_length=3, **options)
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    for _ in range(4):
        state = step(state, jnp.full(env.action_size, 0.5))
        sound((state.obs, state.reward))


def batch() -> Any:
    """A batch that begins new episodes, in a scan, its buffers given away."""
    import jax
    import jax.numpy as jnp

    import envs

    vector = envs.VectorEnv(envs.make("point_maze", episode_length=3), 2)

    def play(state: Any, actions: Any) -> Any:
        return jax.lax.scan(lambda now, action: (vector.step(now, action), now.obs), state, actions)

    state, seen = jax.jit(play, donate_argnums=0)(jax.jit(vector.reset)(jax.random.key(0)), jnp.full((7, 2, 2), 0.5))
    sound((seen, state.obs))


def wrapped() -> Any:
    """An environment in brax's wrappers for training, which take raw keys alone."""
    import jax
    import jax.numpy as jnp
    from brax.envs.wrappers import training

    import envs

    env = training.wrap(envs.make("point_maze", episode_length=5), episode_length=5)
    state, step = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2)), jax.jit(env.step)
    for _ in range(6):
        state = step(state, jnp.full((2, 2), 0.5))
    sound(state.obs)


def gym() -> Any:
    """A Gymnasium environment: two episodes."""
    import gymnasium

    import envs  # noqa: F401

    env = gymnasium.make("star/PointMaze-v0", episode_length=3)
    for _ in range(2):
        obs, _ = env.reset(seed=1)
        assert env.observation_space.contains(obs), "the observation is outside of its space"
        for _ in range(3):
            obs = env.step(np.full(2, 0.5, np.float32))[0]
            assert env.observation_space.contains(obs), "the observation is outside of its space"
    return env


def gym_batch() -> Any:
    """A batch of Gymnasium environments."""
    import gymnasium

    import envs  # noqa: F401

    env = gymnasium.make_vec("star/PointMaze-v0", num_envs=2, episode_length=3)
    obs, _ = env.reset(seed=[1, 2])
    for _ in range(4):
        obs = env.step(np.full((2, 2), 0.5, np.float32))[0]
    assert env.observation_space.contains(obs), "the observation is outside of its space"
    return env


def goal_selection() -> Any:
    """`star.sgim` by itself: blocks of choices and updates."""
    import jax
    import jax.numpy as jnp

    from star import sgim
    from star.abstraction import regions

    bins = regions.create(([0.0], [3.0]), [[1.0, 2.0]], max_regions=4)
    config = sgim.Config()
    state = sgim.init(config, bins, costs=[1.0, 3.0])

    @jax.jit
    def block(state: Any, key: Any) -> Any:
        choice = jax.vmap(lambda one: sgim.select(config, state, key=one))(jax.random.split(key, 4))
        return sgim.update(config, state, choice, jnp.linspace(0.0, 1.0, 4))

    for key in jax.random.split(jax.random.key(0), 5):
        state = block(state, key)
    sound(state.gains)
    return state


def command(*words: str) -> None:
    """A command of `star`; raises `UserError` if it is refused in one line."""
    from envs.common.errors import UserError
    from star import cli

    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = cli.main(list(words))
    if code:
        lines = said.getvalue().strip().splitlines()
        assert code == 2 and len(lines) == 1, f"code {code} with {len(lines)} lines: {lines[-1:]}"
        raise UserError(lines[0].removeprefix("error: "))


def trainer() -> Any:
    """`star train` of all three levels, resumed, and `star evaluate`."""
    with tempfile.TemporaryDirectory() as folder:
        run = f"{folder}/run"
        command("train", str(TRAINED), "--run-dir", run, "--quiet", "--total-env-steps", "80")
        command("train", "--resume", run, "--quiet", "--total-env-steps", "160")
        command("evaluate", run, "--quiet")


OBJECTS: Mapping[str, Callable[[], Any]] = {
    "`envs.make`, point": partial(single, "point_maze"),
    "`envs.make`, ant (native)": partial(single, "ant_maze", engine="native"),
    "`envs.VectorEnv`": batch,
    "brax's wrappers": wrapped,
    "`gymnasium.make`": gym,
    "`gymnasium.make_vec`": gym_batch,
    "`star.sgim`": goal_selection,
    "`star train`, `--resume`, `evaluate`": trainer,
}


def outcome(use: Callable[[], Any]) -> str:
    """The result of using something: it works, the one line that refuses it, or a fault."""
    from envs.common.errors import UserError

    try:
        use()
    except UserError as error:
        line = str(error)
        return f"FAULT: {line.count(chr(10)) + 1} lines" if "\n" in line else line
    except Exception as error:
        return f"FAULT: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
    return WORKS


def in_mode(mode: str, objects: Sequence[str] = tuple(OBJECTS)) -> dict[str, str]:
    """The outcome of each object in a process of its own in that mode."""
    variables, flags = MODES[mode]
    environment = os.environ | importing(ROOT) | variables
    words = [sys.executable, *flags, str(Path(__file__)), "--objects", *objects]
    try:
        done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)
        return dict(zip(objects, json.loads(done.stdout.splitlines()[-1]), strict=True))
    except subprocess.TimeoutExpired:
        return dict.fromkeys(objects, f"FAULT: took more than {LIMIT} s")
    except (IndexError, ValueError):
        return dict.fromkeys(objects, f"FAULT: {done.stderr.strip().splitlines()[-1:]}")


def modes(jobs: int) -> Table:
    """Objects x modes of JAX and Python."""
    with ThreadPoolExecutor(jobs) as pool:
        rows = dict(zip(MODES, pool.map(in_mode, MODES), strict=True))
    for found in rows.values():
        for name, line in found.items():  # a device is missing to all alike
            if "abacus" in line and line.startswith("FAULT: RuntimeError"):
                found[name] = "JAX's own error: the library finds no device"
    return rows


# Transformations


def transformations() -> Table:
    """Objects x transformations of JAX: each gives what calls without it give."""
    import jax
    import jax.numpy as jnp

    import envs
    from star import sgim
    from star.abstraction import regions

    env = envs.make("point_maze", episode_length=9)
    vector = envs.VectorEnv(env, 2)
    config = sgim.Config()
    state = sgim.init(config, regions.create(([0.0], [3.0]), [[1.0]], max_regions=4), costs=[1.0, 3.0])
    choices = jax.vmap(lambda key: sgim.select(config, state, key=key))(jax.random.split(jax.random.key(0), 4))
    one, two = env.reset(jax.random.key(0)), vector.reset(jax.random.key(0))
    functions: dict[str, tuple[Callable[[Any], Any], Any]] = {
        "`MazeEnv.step`": (lambda a: env.step(one, a).reward, jnp.full(2, 0.3)),
        "`VectorEnv.step`": (lambda a: vector.step(two, a).reward, jnp.full((2, 2), 0.3)),
        "`MazeEnv.reset`": (lambda x: env.reset(jax.random.key(1)).obs * x, jnp.ones(())),
        "`VectorEnv.reset`": (lambda x: vector.reset(jax.random.key(1)).obs * x, jnp.ones(())),
        "`star.sgim.probabilities`": (
            lambda x: sgim.probabilities(config, state.replace(gains=state.gains + x)),
            jnp.full(state.gains.shape, 0.3),
        ),
        "`star.sgim.update`": (lambda x: sgim.update(config, state, choices, x).gains, jnp.full(4, 0.3)),
    }

    def same(found: Any, expected: Any) -> None:
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)

    def scan(function: Callable[[Any], Any], x: Any) -> Any:
        return jax.lax.scan(lambda carry, x: (carry, function(x)), 0, jnp.stack([x, x]))[1][1]

    def tangent(function: Callable[[Any], Any], x: Any) -> Any:
        primal, along = jax.jvp(function, (x,), (jnp.ones_like(x),))
        backward = jax.vjp(function, x)[1](jnp.ones_like(primal))[0]
        same(jnp.sum(along), jnp.sum(backward))
        return primal

    def donated(function: Callable[[Any], Any], x: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what has no room in the result cannot be given away
            return jax.jit(function, donate_argnums=0)(x + 0)

    ways: dict[str, Callable[[Callable[[Any], Any], Any], Any]] = {
        "jit": lambda f, x: jax.jit(f)(x),
        "vmap": lambda f, x: jax.vmap(f)(jnp.stack([x, x]))[1],
        "vmap twice": lambda f, x: jax.vmap(jax.vmap(f))(jnp.stack([x, x])[None])[0, 1],
        "scan": scan,
        "jvp and grad": tangent,
        "grad of vmap": lambda f, x: tangent(lambda y: jax.vmap(f)(jnp.stack([y, y]))[1], x),
        "vmap of grad": lambda f, x: (jax.vmap(jax.grad(lambda y: f(y).sum()))(jnp.stack([x, x])), f(x))[1],
        "checkpoint": lambda f, x: tangent(jax.checkpoint(f), x),
        "donation": donated,
        "eval_shape": lambda f, x: jnp.broadcast_to(f(x), jax.eval_shape(f, x).shape),
    }
    return {
        name: {way: outcome(lambda f=f, x=x, use=use: same(use(f, x), f(x))) for way, use in ways.items()}
        for name, (f, x) in functions.items()
    }


# Travel


def unpacked_elsewhere(data: bytes, queue: Any) -> None:
    """In another process: unpack what was packed, use it, and say that it works."""
    use(pickle.loads(data))
    queue.put(True)


def use(thing: Any) -> None:
    """One step of what can be stepped."""
    if hasattr(thing, "num_envs") and hasattr(thing, "action_space"):
        thing.step(np.full((2, 2), 0.5, np.float32))
    elif hasattr(thing, "action_space"):
        thing.step(np.full(2, 0.5, np.float32))


def use_in_a_process(thing: Any) -> None:
    """Use `thing` in a process of its own, begun anew."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=unpacked_elsewhere, args=(pickle.dumps(thing), queue))
    process.start()
    process.join(300)
    assert process.exitcode == 0, "the other process failed"


def use_in_threads(thing: Any) -> None:
    """Use `thing` in two threads at once."""
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(use, [thing, thing]))


def travels() -> Table:
    """Objects x ways to travel."""
    import jax

    import envs
    from star import sgim
    from star.config.loading import load

    env = envs.make("point_maze", episode_length=9)
    things = {
        "`gymnasium.make`": gym(),
        "`gymnasium.make_vec`": gym_batch(),
        "`MazeEnv`": env,
        "`MazeEnv`, ant (native)": envs.make("ant_maze", engine="native"),
        "`VectorEnv`": envs.VectorEnv(env, 2),
        "a state of `VectorEnv`": envs.VectorEnv(env, 2).reset(jax.random.PRNGKey(0)).obs,
        "`sgim.Config`": sgim.Config(),
        "`SgimState`": goal_selection(),
        "a config": load(TRAINED),
    }
    things["`gymnasium.make`"].reset(seed=0)

    ways: dict[str, Callable[[Any], None]] = {
        "pickle": lambda thing: use(pickle.loads(pickle.dumps(thing))),
        "deepcopy": lambda thing: use(copy.deepcopy(thing)),
        "spawn": use_in_a_process,
        "threads": use_in_threads,
    }
    if importable("cloudpickle"):
        import cloudpickle

        ways["cloudpickle"] = lambda thing: use(pickle.loads(cloudpickle.dumps(thing)))
    return {
        name: {way: outcome(lambda thing=thing, go=go: go(thing)) for way, go in ways.items()}
        for name, thing in things.items()
    }


def importable(name: str) -> bool:
    """True if there is a module of this name."""
    import importlib.util

    return importlib.util.find_spec(name) is not None


# Types


def twins(value: Any) -> Iterator[tuple[str, Any]]:
    """`value` in the other types that people pass, each with its name."""
    import jax.numpy as jnp

    if isinstance(value, bool):
        yield from (
            ("NumPy number", np.bool_(value)),
            ("array of one number", np.array(value)),
            ("JAX number", jnp.bool_(value)),
        )
    elif isinstance(value, int):
        if abs(value) < 2**31:
            yield "JAX number", jnp.asarray(value)
        yield from (("NumPy number", np.int64(value)), ("array of one number", np.array(value)))
    elif isinstance(value, float):
        if float(np.float32(value)) == value:
            yield from (("JAX number", jnp.asarray(value)), ("NumPy number", np.float32(value)))
        if value.is_integer():
            yield "whole number", int(value)
        yield from (("NumPy number", np.float64(value)), ("array of one number", np.array(value)))
    elif isinstance(value, str):
        yield from (("text of NumPy", np.str_(value)), ("path", Path(value)))
    elif isinstance(value, list | tuple) and value:
        yield from (("tuple", tuple(value)), ("list", list(value)))
        with contextlib.suppress(ValueError):  # of rows of unlike length there is no array
            array = np.array(value)
            yield "array", array
            if array.dtype.kind in "if":
                yield "JAX array", jnp.asarray(array)


def types() -> Table:
    """Every option of the tasks and every setting x the types in which people pass them."""
    import envs
    from envs import tasks
    from star.agent.sections import Config
    from star.config import loading

    rows = "11111\n1r001\n11111"
    valid = {
        "success_radius": 0.5,
        "cell": 4.0,
        "iterations": 4,
        "ls_iterations": 4,
        "integrator": "euler",
        "map": rows,
    }
    faults: dict[str, list[str]] = {}
    seen: dict[str, set[str]] = {}

    def check(kind: str, key: str, twin: str, given: Callable[[], Any], expected: Callable[[], Any]) -> None:
        def both() -> None:
            assert given() == expected(), "is not as its plain twin"

        seen.setdefault(kind, set()).add(twin)
        found = outcome(both)
        if found != WORKS:
            faults.setdefault(f"{kind}/{twin}", []).append(f"{key}: {found}")

    for name in ("point_maze", "ant_maze"):
        for key, option in tasks.TASKS[name].options().items():
            value = valid.get(key, option.default)
            plain = value.splitlines() if key == "map" else value
            extra = (
                [("list of rows", plain), ("tuple", tuple(plain)), ("array", np.array(plain))] if key == "map" else []
            )
            for twin, other in [*twins(value), *extra]:
                if (key, twin) == ("map", "path"):
                    continue  # the path of a file, not its text
                make = partial(_as_made, envs, name, key)
                check("options of tasks", key, twin, partial(make, other), partial(make, value))
    for key, default, _ in loading.fields(Config):
        for twin, other in twins(default):
            parse = partial(_as_parsed, loading, key)
            check("settings", key, twin, partial(parse, other), partial(parse, default))
    columns = sorted(set().union(*seen.values()))
    return {
        kind: {
            twin: "FAULT: " + "; ".join(faults[f"{kind}/{twin}"])[:500] if f"{kind}/{twin}" in faults else WORKS
            for twin in columns
            if twin in seen[kind]
        }
        for kind in seen
    }


def _as_made(envs: Any, name: str, key: str, value: Any) -> Any:
    env = envs.make(name, engine="auto" if name == "point_maze" else "native", **{key: value})
    return env.arena, env.episode_length, env.success_radius, env.dt, env.state_dim, env._ends, env._sparse


def _as_parsed(loading: Any, key: str, value: Any) -> Any:
    return loading.parse({}, {key: value}).model_dump(mode="json")


# Files


def files() -> Table:
    """Files that are read x encodings and line ends."""
    import envs
    from star.config import loading
    from star.sweeps.plan import plan as planned

    config = TRAINED.read_text(encoding="utf-8") + "# \N{GREEK SMALL LETTER ALPHA}\n"
    layer = "tutor:\n  reward: distance  # \N{GREEK SMALL LETTER ALPHA}\n"
    rows = "11111\n1r001\n11111\n"
    plan = (ROOT / "configs/sweeps/three_values.yaml").read_text(encoding="utf-8")
    base = ROOT / "configs"
    kinds: dict[str, tuple[str, str, Callable[[Path], Any]]] = {
        "config": (config, ".yaml", lambda path: loading.load(path)),
        "layer (`--with`)": (layer, ".yaml", lambda path: loading.load(base / "point_maze.yaml", layers=[path])),
        "map, rows": (rows, ".txt", lambda path: envs.make("point_maze", map=str(path)).arena),
        "map, YAML": (
            "cell: 4\nmap: |\n  " + rows.replace("\n", "\n  "),
            ".yaml",
            lambda path: envs.make("point_maze", map=path).arena,
        ),
        "sweep": (
            plan.replace("../point_maze.yaml", str(base / "point_maze.yaml")),
            ".yaml",
            lambda path: planned(path).name,
        ),
    }
    encodings = {
        "UTF-8": "utf-8",
        "UTF-8 with a mark": "utf-8-sig",
        "UTF-16": "utf-16",
        "Latin-1 with an accent": "latin-1",
    }
    ends = {"LF": "\n", "CRLF": "\r\n", "CR": "\r"}
    table: Table = {}
    with tempfile.TemporaryDirectory() as folder:
        for kind, (text, ending, read) in kinds.items():
            path, table[kind] = Path(folder) / f"file{ending}", {}
            path.write_text(text, encoding="utf-8")
            expected = read(path)
            for encoding, name in encodings.items():
                for end, mark in ends.items():
                    written = (
                        text.replace("\N{GREEK SMALL LETTER ALPHA}", "a") + "\n# \u00e9\n"
                        if name == "latin-1"
                        else text
                    )
                    path.write_bytes(written.replace("\n", mark).encode(name))
                    table[kind][f"{encoding}, {end}"] = outcome(partial(_is_read_as, read, path, expected)).replace(
                        str(path), "FILE"
                    )
    return table


def _is_read_as(read: Callable[[Path], Any], path: Path, expected: Any) -> None:
    assert read(path) == expected, "is read as something else"


# The page


def versions() -> str:
    """The equipment of this machine."""
    import jax
    import mujoco

    device = jax.devices()[0].device_kind
    return f"Python {platform.python_version()}, jax {jax.__version__}, mujoco {mujoco.__version__}, {device}"


def page(found: Mapping[str, Mapping[str, Table]]) -> str:
    """The tables as Markdown; what differs between machines is told in each of their names."""
    lines = ["Seen on " + "; ".join(f"{name}: {machine}" for name, machine in zip("AB", found, strict=False)) + ".", ""]
    first = next(iter(found.values()))
    for title, table in first.items():
        lines += [f"### {title}", ""]
        columns = list(dict.fromkeys(column for row in table.values() for column in row))
        notes: dict[str, int] = {}
        lines += ["| | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
        for name in table:
            cells = [
                _cell([tables[title].get(name, {}).get(column) for tables in found.values()], notes)
                for column in columns
            ]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines += ["", *(f"{number}. `{line}`" for line, number in notes.items()), *[""] * bool(notes)]
    return "\n".join(lines).rstrip() + "\n"


def _cell(outcomes: Sequence[str | None], notes: dict[str, int]) -> str:
    words = [
        "–" if line is None else "yes" if line == WORKS else f"refused ({notes.setdefault(line, len(notes) + 1)})"
        for line in outcomes
    ]
    return (
        words[0]
        if len(set(words)) == 1
        else ", ".join(f"{name}: {word}" for name, word in zip("AB", words, strict=False))
    )


BEGIN, END = "<!-- scripts/checks/matrix.py begins -->\n", "<!-- scripts/checks/matrix.py ends -->\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON to write the outcomes to")
    parser.add_argument("--jobs", type=int, default=2, help="modes tried at once")
    parser.add_argument("--page", type=Path, help="page to write the tables of the files into")
    parser.add_argument("files", nargs="*", type=Path, help="JSON files of --out")
    parser.add_argument("--objects", nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.objects is not None:
        with contextlib.redirect_stdout(sys.stderr):
            found = [outcome(OBJECTS[name]) for name in options.objects]
        print(json.dumps(found))
        return 0
    if options.page is not None:
        both = {machine: tables for path in options.files for machine, tables in json.loads(path.read_text()).items()}
        before, _, rest = options.page.read_text(encoding="utf-8").partition(BEGIN)
        options.page.write_text(
            before + BEGIN + "\n" + page(both) + "\n" + END + rest.partition(END)[2], encoding="utf-8"
        )
        return 0
    tables = {
        "Modes of JAX and Python": modes(options.jobs),
        "Transformations of JAX": transformations(),
        "Ways to travel": travels(),
        "Types of options": types(),
        "Encodings of files": files(),
    }
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps({versions(): tables}, indent=1) + "\n", encoding="utf-8")
    faults = [
        (title, row, column, line)
        for title, table in tables.items()
        for row, cells in table.items()
        for column, line in cells.items()
        if line.startswith("FAULT")
    ]
    for fault in faults:
        print(*fault, sep=" | ")
    print(f"{sum(len(row) for table in tables.values() for row in table.values())} pairs, {len(faults)} faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
