"""Compare OGBench's ant with ours, state by state, and write what was seen to a JSON file.

    python scripts/checks/against_ogbench.py record            200 env steps of OGBench's own environment
    python scripts/checks/against_ogbench.py compare --out results/physics/ogbench.json

`record` needs OGBench, `pip install ogbench mujoco==3.17.0`, and nothing of STAR: an environment of its own will do.
It walks by a gait of sines, the one of 40 random ones that goes farthest in 60 env steps (`gait`, m), from random
places and headings. It keeps 150 env steps that begin away from walls and 50 that begin in contact with one. Each has
a goal .3 to .7 m away in a random direction.

`compare` makes the same env steps with `antmaze-giant`, the preset `published` and the engine `native`. It tells the
largest difference of a position (qpos, m and rad), and how many flags of success and of the end differ. It passes if
positions agree to 1e-4 and all flags are equal.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
STATES = ROOT / "results" / "physics" / "ogbench_states.npz"
MAZE = "giant"
FREE, AT_WALL = 150, 50  # env steps to keep
GAITS, GAIT_STEPS = 40, 60
WALK_STEPS, A_WALK = 40, 6  # env steps of a walk, and how many of them may be kept
TOLERANCE = 1e-4  # m and rad
LEGS = np.array([2, 3, 4, 5, 6, 7, 0, 1])  # of OGBench's motors, in the order of our joints


def gait(rng: np.random.Generator) -> tuple[float, np.ndarray, np.ndarray]:
    """A gait: period in env steps, and amplitude and phase of each motor [8]."""
    return rng.uniform(4, 14), rng.uniform(0.3, 1.0, 8), rng.uniform(0, 2 * np.pi, 8)


def action_at(walk: tuple[float, np.ndarray, np.ndarray], t: int) -> np.ndarray:
    """Action [8] of a gait in env step `t`."""
    period, amplitude, phase = walk
    return (amplitude * np.sin(2 * np.pi * t / period + phase)).astype(np.float32)


def place(env: Any, xy: np.ndarray, heading: float) -> None:
    """Put OGBench's ant at `xy`, turned by `heading` rad, in a pose of a fresh start."""
    env.reset()
    qpos = env.data.qpos.copy()
    qpos[:2], qpos[3:7] = xy, (np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2))
    env.set_state(qpos, env.data.qvel.copy())


def fastest(env: Any, rng: np.random.Generator) -> tuple[tuple[float, np.ndarray, np.ndarray], float]:
    """The gait of `GAITS` random ones that goes farthest from the start in `GAIT_STEPS`, and how far in m."""
    best: tuple[Any, float] = (None, 0.0)
    for _ in range(GAITS):
        walk = gait(rng)
        place(env, np.array([0.0, 4.0]), np.pi / 2)
        for t in range(GAIT_STEPS):
            env.step(action_at(walk, t))
        far = float(np.linalg.norm(env.get_xy() - (0.0, 4.0)))
        best = max(best, (walk, far), key=lambda one: one[1])
    return best


def touches_wall(env: Any) -> bool:
    """True if the ant is in contact with a wall."""
    names = [env.model.geom(int(i)).name for contact in env.data.contact for i in contact.geom]
    return any(name.startswith("block") for name in names)


def record(path: Path, seed: int) -> int:
    """Record the env steps to `path`."""
    from ogbench.locomaze.maze import make_maze_env

    np.random.seed(seed)
    rng = np.random.default_rng(seed)
    env = make_maze_env("ant", "maze", maze_type=MAZE, terminate_at_goal=True)
    env.action_space.seed(seed)
    env.reset(seed=seed)
    walk, far = fastest(env, rng)
    print(f"gait: {far:.2f} m in {GAIT_STEPS} env steps")
    free = np.argwhere(env.maze_map == 0)
    kept: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    while len(kept[False]) < FREE or len(kept[True]) < AT_WALL:
        middle = np.array(env.ij_to_xy(free[rng.integers(len(free))]))
        place(env, middle + rng.uniform(-1, 1, 2), rng.uniform(-np.pi, np.pi))
        shift, chosen = rng.integers(100), rng.choice(np.arange(5, WALK_STEPS), A_WALK, replace=False)
        for t in range(WALK_STEPS):
            at_wall, before = touches_wall(env), (env.data.qpos.copy(), env.data.qvel.copy())
            turn = rng.uniform(-np.pi, np.pi)
            env.set_goal(goal_xy=before[0][:2] + rng.uniform(0.3, 0.7) * np.array([np.cos(turn), np.sin(turn)]))
            action = action_at(walk, shift + t)
            env.set_state(*before)  # OGBench's solver forgets, as ours does, what it started from
            _, _, terminated, _, info = env.step(action)
            if t in chosen and len(kept[at_wall]) < (AT_WALL if at_wall else FREE):
                kept[at_wall].append({
                    "qpos": before[0], "qvel": before[1], "action": action, "goal": env.cur_goal_xy,
                    "after": env.data.qpos.copy(), "success": bool(info["success"]), "terminated": bool(terminated),
                    "at_wall": at_wall,
                })  # fmt: skip
    rows = kept[False] + kept[True]
    versions = [f"{name} {metadata.version(name)}" for name in ("ogbench", "mujoco")]
    states = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    np.savez_compressed(path, **states, versions=np.array(versions), gait=np.array(far))
    return 0


def steps(states: dict[str, np.ndarray], maze: str = MAZE) -> dict[str, np.ndarray]:
    """The ends of our env steps: `after` [n, 15], `success`, `terminated` (bool [n])."""
    import jax
    import jax.numpy as jnp

    import envs

    env = envs.make(f"antmaze-{maze}", engine="native", preset="published")
    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), len(states["qpos"])))
    qpos, qvel, goal = (jnp.asarray(states[key], jnp.float32) for key in ("qpos", "qvel", "goal"))
    data = first.pipeline_state.data.replace(qpos=qpos, qvel=qvel)
    state = first.replace(pipeline_state=first.pipeline_state.replace(data=data), info={**first.info, "goal": goal})
    after = jax.jit(jax.vmap(env.step))(state, jnp.asarray(states["action"][:, LEGS]))
    ended = (after.done > 0) & (after.info["truncation"] == 0)
    return {
        "after": np.asarray(after.obs[:, :15]),
        "success": np.asarray(after.metrics["success"] > 0),
        "terminated": np.asarray(ended),
    }


def compare(path: Path, out: Path | None) -> int:
    """Compare with the recorded env steps; returns 0 if they agree."""
    began = time.monotonic()
    with np.load(path) as file:
        states = dict(file)
    ours = steps(states)
    gaps, wall = np.abs(ours["after"] - states["after"]).max(axis=1), states["at_wall"]
    row: dict[str, Any] = {"task": f"antmaze-{MAZE}", "engine": "native", "preset": "published", "states": len(gaps)}
    row |= {"recorded_with": states["versions"].tolist(), "gait": float(states["gait"])}
    row |= {"at_wall": int(wall.sum()), "gap_free": float(gaps[~wall].max()), "gap_at_wall": float(gaps[wall].max())}
    row |= {"successes": int(states["success"].sum())}
    row |= {f"{key}_differ": int((ours[key] != states[key]).sum()) for key in ("success", "terminated")}
    row |= {"moved": float(np.median(np.linalg.norm(states["after"][:, :2] - states["qpos"][:, :2], axis=1)))}
    row["passed"] = bool(gaps.max() < TOLERANCE and not row["success_differ"] + row["terminated_differ"])
    row["seconds"] = round(time.monotonic() - began, 1)
    print(json.dumps(row))
    if out:
        out.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
    return 0 if row["passed"] else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("do", choices=("record", "compare"))
    parser.add_argument("--states", type=Path, default=STATES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.do == "record":
        return record(options.states, options.seed)
    return compare(options.states, options.out)


if __name__ == "__main__":
    sys.exit(main())
