"""Compare preset `jaxgcrl` with JaxGCRL's own environments on its backend `mjx`, and write a JSON file.

    git clone https://github.com/MichalBortkiewicz/JaxGCRL
    python scripts/checks/against_jaxgcrl.py JaxGCRL --engines jax native --out results/physics/jaxgcrl.json

    goals, test_goals   True if they are the same; of its `ant`, whose goals are a circle, the radii of both
    p_start             two-sample Kolmogorov-Smirnov tests of the starts: the smallest p-value of 29 numbers
    layout              largest difference between its observation and qpos, qvel, goal
    position, velocity  largest difference of a number of the state after one env step, from 100 states and
                        actions: half of them on walks of random actions, half thrown around the start at 3 m/s
    within              how many of the 100 differ by less than 1e-4 in every number
    walls, itself       how many of the 100 begin with a contact with a wall, or of the ant with itself
    ends, same_ends     how many of the 100 end the episode, and whether the same ones do

A task passes if all goals and ends agree, no p-value is below .001, and all 100 are within 1e-4. Compiling takes
minutes.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import stats

import envs
from envs.ant import ORIENTATION, QPOS
from envs.tasks import TASKS

OURS = {"ant": "ant_open", "ant_u_maze": "ant_u_maze", "ant_big_maze": "ant_big_maze"}
STATES, RESETS = 100, 1000
THROW = 3.0  # m/s
ROOM = 1.3  # m around the start from which ants are thrown
CLOSE = 1e-4
P_VALUE = 1e-3
MOTORS = np.array([6, 7, 0, 1, 2, 3, 4, 5])  # where its motors stand among ours: its first is that of hip 4


class Seen(NamedTuple):
    """Env steps of JaxGCRL's, [n]: the state before, the solver's warm start, its action, the state after, and its end.

    States are those of our observation: places count from the start.
    """

    before: np.ndarray
    warmstart: np.ndarray
    action: np.ndarray
    after: np.ndarray
    done: np.ndarray


def loaded(clone: Path, name: str, *, folder: str = "envs") -> ModuleType:
    """The module `name` of its environments or another folder, without the packages that it needs otherwise."""
    spec = importlib.util.spec_from_file_location(name, clone / "jaxgcrl" / folder / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def theirs(clone: Path, task: str, *, backend: str = "mjx") -> tuple[Any, np.ndarray]:
    """Its environment, and the place of its start."""
    if task == "ant":
        return loaded(clone, "ant").Ant(backend=backend), np.zeros(2)
    env = loaded(clone, "ant_maze").AntMaze(backend=backend, maze_layout_name=task.removeprefix("ant_"))
    return env, np.asarray(env.possible_starts[0])


def goals(clone: Path, task: str, origin: np.ndarray, drawn: np.ndarray) -> dict[str, Any]:
    """The comparison of goals; `drawn` [n, 2] are its own at resets."""
    ours = TASKS[OURS[task]].goals
    if task == "ant":
        radii = [np.linalg.norm(places, axis=1) for places in (drawn, ours["train"].lower)]
        return {
            "radii": [float(np.mean(one)) for one in radii],
            "goals": all(np.allclose(one, radii[0][0], atol=1e-5) for one in radii),
        }
    module, found = loaded(clone, "ant_maze"), {}
    for key, name, maze in (("goals", "train", task), ("test_goals", "test", f"{task}_eval")):
        own = module.make_maze(maze.removeprefix("ant_"), TASKS[OURS[task]].arena.cell)[2]
        found[key] = {tuple(place) for place in (np.asarray(own) - origin).tolist()} == set(ours[name].lower)
    return found


def moved(states: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """`states` [..., 29 or more] with places that count from the start and quaternions of length 1."""
    states = np.array(states, np.float32)
    states[..., :2] -= origin
    states[..., ORIENTATION] /= np.linalg.norm(states[..., ORIENTATION], axis=-1, keepdims=True)
    return states


def walked(env: Any, starts: Any, origin: np.ndarray, states: int) -> Seen:
    """Env steps of random actions, the second half after throws."""
    rng, step, size = np.random.default_rng(0), jax.jit(env.step), env.state_dim
    begun, rows = iter(range(RESETS)), []

    def fresh(*, thrown: bool) -> Any:
        number = next(begun)
        state = jax.tree.map(lambda leaf: leaf[number], starts)
        if not thrown:
            return state
        data = state.pipeline_state
        place, speed = origin + rng.uniform(-ROOM, ROOM, 2), rng.normal(0, THROW, 2)
        q, qd = data.q.at[:2].set(place), data.qd.at[:2].set(speed)
        return state.replace(pipeline_state=data.replace(q=q, qd=qd, qpos=q, qvel=qd))

    for number in range(states):
        thrown = number >= states // 2
        if number == 0 or (thrown and number % 5 == 0) or rows[-1][-1]:
            state = fresh(thrown=thrown)
        action = rng.uniform(-1, 1, env.action_size).astype(np.float32)
        data, after = state.pipeline_state, step(state, jnp.asarray(action))
        before = np.concatenate([data.q[:QPOS], data.qd[: size - QPOS]])
        rows.append((before, data.qacc_warmstart[: size - QPOS], action, after.obs[:size], after.done > 0))
        state = after
    seen = Seen(*map(np.stack, zip(*rows, strict=True)))
    return seen._replace(before=moved(seen.before, origin), after=moved(seen.after, origin))


def stepped(env: Any, seen: Seen) -> tuple[np.ndarray, np.ndarray]:
    """The state after each of the steps by our environment [n, 29], and whether it ends the episode [n]."""
    body = env.body

    def one(before: Any, warmstart: Any, action: Any) -> Any:
        data = body.physics.init(before[:QPOS], before[QPOS:]).replace(warmstart=warmstart)
        data = body.step(data, jnp.zeros(8).at[MOTORS].set(action))
        return body.observe(data, jnp.zeros((), jnp.int32)), body.unhealthy(data)

    after, done = jax.jit(jax.vmap(one))(seen.before, seen.warmstart, seen.action)
    return np.asarray(after), np.asarray(done)


def touching(model: mujoco.MjModel, states: np.ndarray) -> dict[str, int]:
    """Counts of `states` [n, 29] in which the ant touches a wall, and itself."""
    data, counts = mujoco.MjData(model), {"walls": 0, "itself": 0}
    for state in states:
        data.qpos = state[:QPOS]
        mujoco.mj_forward(model, data)
        pairs = [{model.geom(i).name.partition("_")[0] for i in pair} for pair in data.contact.geom]
        counts["walls"] += any("wall" in pair for pair in pairs)
        counts["itself"] += any(not pair & {"wall", "floor"} for pair in pairs)
    return counts


def compared(clone: Path, task: str, engines: list[str], states: int) -> list[dict[str, Any]]:
    """A row for each engine."""
    own, origin = theirs(clone, task)
    starts = jax.jit(jax.vmap(own.reset))(jax.random.split(jax.random.PRNGKey(0), RESETS))
    data, obs = starts.pipeline_state, np.asarray(starts.obs)
    target = data.x.pos[:, -1, :2]
    layout = np.abs(obs - np.concatenate([data.q[:, :-2], data.qd[:, :-2], target], axis=1)).max()
    seen, rows = walked(own, starts, origin, states), []
    for engine in engines:
        env = envs.make(OURS[task], preset="jaxgcrl", engine=engine)
        begun = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), RESETS)).obs[:, : env.state_dim]
        pairs = zip(moved(obs[:, : env.state_dim], origin).T, np.asarray(begun).T, strict=True)
        after, done = stepped(env, seen)
        gap = np.abs(after - seen.after)
        row = {"task": task, "engine": env.engine, "dt": [float(own.dt), env.dt]}
        row |= {"observation_size": [own.observation_size, env.observation_size], "layout": float(layout)}
        row |= goals(clone, task, origin, obs[:, -2:])
        row |= {"p_start": min(float(stats.ks_2samp(*pair).pvalue) for pair in pairs)}
        row |= {"states": states, "within": int((gap < CLOSE).all(axis=1).sum())}
        row |= {"position": float(gap[:, :QPOS].max()), "velocity": float(gap[:, QPOS:].max())}
        row |= {"median_position": float(np.median(gap[:, :QPOS].max(axis=1)))}
        row |= {"median_velocity": float(np.median(gap[:, QPOS:].max(axis=1)))}
        row |= touching(env.body.physics.model, seen.before)
        row |= {"ends": int(seen.done.sum()), "same_ends": bool((seen.done == done).all())}
        alike = row["goals"] and row.get("test_goals", True) and row["same_ends"] and row["p_start"] > P_VALUE
        rows.append(row | {"passed": bool(alike and row["within"] == states)})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path, help="folder of JaxGCRL's source")
    parser.add_argument("--tasks", nargs="+", choices=OURS, default=["ant", "ant_u_maze"])
    parser.add_argument("--engines", nargs="+", default=["jax"])
    parser.add_argument("--states", type=int, default=STATES)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # brax's notice about its own pipelines
    jax.config.update("jax_default_matmul_precision", "highest")
    rows = [row for task in options.tasks for row in compared(options.clone, task, options.engines, options.states)]
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["passed"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
