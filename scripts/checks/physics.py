"""Check the physics of the ant tasks on an engine against plain MuJoCo, and write what was seen to a JSON file.

    python scripts/checks/physics.py --engine native --out results/physics/native.json [TASK ...]

For each task, from random starts and under uniform random actions:

    one_step    largest difference of qpos to `mujoco.mj_step` on the same model after one env step, 20 rollouts,
                and the number of that coordinate
    p_height, p_speed, p_distance
                two-sample Kolmogorov-Smirnov tests between engine and MuJoCo over `--rollouts` episodes, of the
                means over an episode of height and speed, and of the distance travelled
    crossings   throws of an ant at 3 to 12 m/s, from anywhere in any direction, that ended in a wall or the floor
    over        where walls are lower than 4 m, throws that bounced over them, which are not followed any further
    rest        lowest torso above its floor, in m, after 2 s without action, and contacts MuJoCo counts there
    non_finite, overflow
                env steps of `--random-steps` after which the environment had to be reset

A task passes if one_step is below 1e-5 (native) or 1e-3, no p-value below .001, nothing crosses, and every ant rests.
With `--preset fast --reference published` the presets are compared: one_step and the p-values are only told.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy import stats

import envs
from envs.ant import QPOS
from envs.arena import HEIGHT, Arena
from envs.tasks import TASKS

TOLERANCE = {"native": 1e-5, "jax": 1e-3, "warp": 1e-3}
P_VALUE = 1e-3
ONE_STEP_ROLLOUTS = 20
THROW_STEPS = 20
REST_STEPS = 20


class Batch:
    """`size` environments of a task with one compiled step; starts can be written into them."""

    def __init__(self, task: str, engine: str, size: int, *, preset: str, reference: str):
        self.env = envs.make(task, engine=engine, preset=preset)
        self.size = size
        self.model = envs.make(task, engine="native", preset=reference).body.physics.model
        vector = envs.VectorEnv(self.env, size)
        self.reset = jax.jit(vector.reset)
        self.step = jax.jit(vector.step, donate_argnums=0)

    def put(self, state: Any, qpos: np.ndarray, qvel: np.ndarray) -> Any:
        """`state` with the first environments at qpos [n, nq] and qvel [n, nv]."""
        data = state.pipeline_state.data
        data = data.replace(qpos=data.qpos.at[: len(qpos)].set(qpos), qvel=data.qvel.at[: len(qvel)].set(qvel))
        return state.replace(pipeline_state=state.pipeline_state.replace(data=data))

    def actions(self, seed: int, steps: int) -> np.ndarray:
        """Uniform random actions [steps, size, 8]."""
        return np.random.default_rng(seed).uniform(-1, 1, (steps, self.size, 8)).astype(np.float32)


def mujoco_path(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray, frames: int) -> np.ndarray:
    """Paths [T, nq + 2] (qpos, then the torso's velocity in the plane) by `mj_step` under ctrl [T, nu]."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    path = np.empty((len(ctrl), model.nq + 2))
    for t, torque in enumerate(ctrl):
        data.ctrl = torque
        mujoco.mj_step(model, data, nstep=frames)
        path[t] = np.concatenate([data.qpos, data.qvel[:2]])
    return path


def one_step(batch: Batch) -> dict[str, Any]:
    """Largest difference of qpos after one env step, and where."""
    n = min(ONE_STEP_ROLLOUTS, batch.size)
    state = batch.reset(jax.random.key(0))
    start = jax.device_get(state.pipeline_state.data)
    action = batch.actions(0, 1)[0]
    after = np.asarray(batch.step(state, action).pipeline_state.data.qpos)
    frames = round(batch.env.dt / batch.model.opt.timestep)
    gaps = [
        np.abs(
            mujoco_path(batch.model, start.qpos[i], start.qvel[i], torque(batch.model) * action[None, i], frames)[
                0, :-2
            ]
            - after[i]
        )
        for i in range(n)
    ]
    worst = np.max(gaps, axis=0)
    return {"one_step": float(worst.max()), "one_step_at": int(worst.argmax())}


def torque(model: mujoco.MjModel) -> float:
    """The torque of an action of 1, in N m."""
    return float(model.actuator_ctrlrange[0, 1])


def summaries(path: np.ndarray) -> np.ndarray:
    """Mean height, mean speed and distance travelled [3] of a path that begins with x, y, z and ends with vx, vy."""
    legs = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    return np.array([path[:, 2].mean(), np.linalg.norm(path[:, -2:], axis=1).mean(), legs.sum()])


def distributions(batch: Batch, rollouts: int, steps: int) -> dict[str, float]:
    """P-values of two-sample tests of the engine against MuJoCo."""
    n = min(rollouts, batch.size)
    state = batch.reset(jax.random.key(1))
    start = jax.device_get(state.pipeline_state.data)
    actions = batch.actions(1, steps)
    paths = np.empty((steps, n, 5))
    for t in range(steps):
        state = batch.step(state, actions[t])
        paths[t] = np.asarray(state.info["final_obs"][:n])[:, [0, 1, 2, QPOS, QPOS + 1]]
    frames = round(batch.env.dt / batch.model.opt.timestep)

    def plain(i: int) -> np.ndarray:
        return summaries(
            mujoco_path(batch.model, start.qpos[i], start.qvel[i], torque(batch.model) * actions[:, i], frames)
        )

    with ThreadPoolExecutor() as pool:
        reference = np.array(list(pool.map(plain, range(n))))
    seen = np.array([summaries(paths[:, i]) for i in range(n)])
    names = ("p_height", "p_speed", "p_distance")
    tests = {name: float(stats.ks_2samp(seen[:, k], reference[:, k]).pvalue) for k, name in enumerate(names)}
    means = {
        f"mean_{name[2:]}": [float(seen[:, k].mean()), float(reference[:, k].mean())] for k, name in enumerate(names)
    }
    return tests | means


def barred(batch: Batch, state: Any, n: int) -> np.ndarray:
    """True if each of the first n torsos is inside a wall, a closed gate, the floor, or out of the maze."""
    arena = batch.env.arena
    data = state.pipeline_state.data
    x, y, z = np.asarray(data.qpos[:n, :3]).T
    closed = (np.asarray(data.mocap_pos[:n, :, 2]) < top_of(arena)).all(axis=1)

    def inside(rectangles: np.ndarray) -> np.ndarray:
        found = np.zeros(len(x), bool)
        for x_lo, y_lo, x_hi, y_hi in rectangles:
            found |= (x > x_lo) & (x < x_hi) & (y > y_lo) & (y < y_hi)
        return found

    x_lo, y_lo, x_hi, y_hi = arena.bounds
    outside = (x < x_lo) | (x > x_hi) | (y < y_lo) | (y > y_hi)
    through = inside(arena.floors()) & (z < arena.floor_height - 0.1)
    shut = inside(arena.walls()) | (inside(arena.gates()) & closed)
    return (shut & (z < top_of(arena))) | outside | through | (z < -0.1)


def top_of(arena: Arena) -> float:
    """Height of the walls' upper edges."""
    return arena.floor_height + arena.wall_height


def above(batch: Batch, state: Any, n: int) -> np.ndarray:
    """True if each of the first n torsos is higher than the walls, if these are lower than usual."""
    arena = batch.env.arena
    return np.asarray(state.pipeline_state.data.qpos[:n, 2] > top_of(arena)) & (arena.wall_height < HEIGHT)


def throws(batch: Batch, number: int) -> dict[str, int]:
    """Ants among `number` thrown: `crossings` are found in a wall or behind it, `over` have been `above` the walls.

    Of those that have, what follows is not looked at.
    """
    rng = np.random.default_rng(2)
    arena, crossed, over = batch.env.arena, 0, 0
    for begin in range(0, number, batch.size):
        n = min(batch.size, number - begin)
        centres = arena.centres("0rg")[rng.integers(len(arena.centres("0rg")), size=n)]
        room = max(arena.cell / 2 - 1.0, 0.0)
        angle, speed = rng.uniform(0, 2 * np.pi, n), rng.uniform(3, 12, n)
        qpos, qvel = np.tile(batch.model.qpos0, (n, 1)), np.zeros((n, batch.model.nv))
        qpos[:, :2] = centres + rng.uniform(-room, room, (n, 2))
        qpos[:, 2] += arena.floor_height
        qpos[:, 3:7] = rng.normal(size=(n, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qvel[:, 0], qvel[:, 1] = speed * np.cos(angle), speed * np.sin(angle)
        state = batch.put(batch.reset(jax.random.key(3)), qpos.astype(np.float32), qvel.astype(np.float32))
        found, high = np.zeros(n, bool), np.zeros(n, bool)
        for _ in range(THROW_STEPS):
            state = batch.step(state, jnp.zeros((batch.size, 8)))
            high |= above(batch, state, n)
            found |= barred(batch, state, n) & ~high
        crossed, over = crossed + int(found.sum()), over + int(high.sum())
    return {"crossings": crossed, "over": over}


def rest(batch: Batch) -> dict[str, float]:
    """Places of ants after 2 s without action, and MuJoCo's number of contacts there."""
    state = batch.reset(jax.random.key(4))
    for _ in range(REST_STEPS):
        state = batch.step(state, jnp.zeros((batch.size, 8)))
    qpos = np.asarray(state.pipeline_state.data.qpos)
    data = mujoco.MjData(batch.model)
    contacts = []
    for pose in qpos[:ONE_STEP_ROLLOUTS]:
        data.qpos = pose
        mujoco.mj_forward(batch.model, data)
        contacts.append(data.ncon)
    return {"rest": float((qpos[:, 2] - batch.env.arena.floor_height).min()), "contacts": float(min(contacts))}


def random_steps(batch: Batch, number: int) -> dict[str, int]:
    """Faults among at least `number` env steps of random actions, episodes restarting."""
    state, non_finite, overflow = batch.reset(jax.random.key(5)), 0.0, 0.0
    steps = -(-number // batch.size)
    key = jax.random.key(6)
    draw = jax.jit(lambda t: jax.random.uniform(jax.random.fold_in(key, t), (batch.size, 8), minval=-1, maxval=1))
    for t in range(steps):
        state = batch.step(state, draw(t))
        non_finite += state.metrics["non_finite"].sum()
        overflow += state.metrics["overflow"].sum()
    assert bool(jnp.isfinite(state.obs).all())
    return {"random_steps": steps * batch.size, "non_finite": int(non_finite), "overflow": int(overflow)}


def verify(task: str, options: argparse.Namespace) -> dict[str, Any]:
    """All checks of one task."""
    began = time.monotonic()
    reference = options.reference or options.preset
    batch = Batch(task, options.engine, options.envs, preset=options.preset, reference=reference)
    row: dict[str, Any] = {"task": task, "engine": batch.env.engine, "preset": options.preset, "reference": reference}
    row |= one_step(batch) | rest(batch)
    row |= distributions(batch, options.rollouts, options.steps)
    row |= {"throws": options.throws} | throws(batch, options.throws)
    if options.random_steps:
        row |= random_steps(batch, options.random_steps)
    sound = row["crossings"] == 0 and row["rest"] > 0.1 and row["contacts"] > 0
    alike = min(row["p_height"], row["p_speed"], row["p_distance"]) > P_VALUE
    same = row["one_step"] < TOLERANCE[batch.env.engine]
    passed = sound and (reference != options.preset or (alike and same))
    return row | {"passed": passed, "seconds": round(time.monotonic() - began, 1)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", default=[name for name in envs.names() if TASKS[name].body == "ant"])
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--reference", help="preset of the model that MuJoCo steps (default: the same)")
    parser.add_argument("--envs", type=int, default=200, help="environments side by side")
    parser.add_argument("--rollouts", type=int, default=200)
    parser.add_argument("--steps", type=int, default=500, help="env steps of a rollout")
    parser.add_argument("--throws", type=int, default=1000)
    parser.add_argument("--random-steps", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for task in options.tasks:
        rows.append(verify(task, options))
        print(json.dumps({k: round(v, 8) if isinstance(v, float) else v for k, v in rows[-1].items()}), flush=True)
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["passed"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
