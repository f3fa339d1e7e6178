"""Compare the worlds in which skills are learnt with native MuJoCo models of the same arms, lines and objects.

    python scripts/checks/worlds.py [pen throw fishing table] [--movements 100] [--out results/physics/worlds.json]

The models have the sizes of the worlds. Their motors follow the angles that a world commands; the line is two tendons
that may be slack, the objects are discs on a plane, and what is in the hand is held by a constraint. A row tells by how
much both differ, as median, 95th percentile and maximum:

    tip          m, where a primitive of a random sequence ends; of fishing at any time  at most .02
    landing      m, where a thrown ball lands                                           at most .02
    float        over the length of the line, where it comes down, if it does           at most .05
    carried      over its way, how far an object gets that is taken and put down        at most .1

A row has passed if 95 % of its movements are within the limit. That is asked of the float too, although a movement in
which it grazes the water may end anywhere: there the least difference decides.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import worlds
from envs.worlds import dmp, fishing, pen, rope, table, throw

STEP = 2e-4  # s, about
STEPS = 1000  # in which a ball is thrown
STIFF, DAMP, ARMATURE = 1e6, 2e3, 1.0  # of motors: N m/rad, N m s/rad, kg m^2
SHARE = 0.95
GRAIN = 0.001  # kg: the mass in the middle of a line
HINGE, SLIDE = "hinge", "slide"
LIMITS = {"tip": 0.02, "landing": 0.02, "float": 0.05, "carried": 0.1}


def arm(joints: Sequence[tuple[str, str, Sequence[float]]], tip: Sequence[float]) -> str:
    """Bodies of a chain of (type, axis, place of the joint in the body before it), and the site `tip`."""
    head, tail = "", ""
    for number, (kind, axis, place) in enumerate(joints):
        head += (
            f'<body pos="{_numbers(place)}" gravcomp="1"><joint name="q{number}" type="{kind}" axis="{axis}" '
            f'armature="{ARMATURE}"/><inertial pos="0 0 0" mass=".1" diaginertia=".001 .001 .001"/>'
        )
        tail += "</body>"
    return f'{head}<site name="tip" pos="{_numbers(tip)}"/>{tail}'


def model(joints: Sequence[tuple[str, str, Sequence[float]]], tip: Sequence[float], more: str = "", world: str = ""):
    """A compiled model of an arm, and what else is in the world."""
    motors = "".join(f'<position joint="q{i}" kp="{STIFF}" kv="{DAMP}"/>' for i in range(len(joints)))
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" integrator="implicitfast"/>'
        f"<worldbody>{arm(joints, tip)}{world}</worldbody>{more}<actuator>{motors}</actuator></mujoco>"
    )


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def follow(
    simulator: mujoco.MjModel, data: mujoco.MjData, angles: np.ndarray, dt: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Lead the motors along angles [n + 1, joints], `dt` apart; after each of n times its number and the tip."""
    within = max(1, round(dt / STEP))
    simulator.opt.timestep = dt / within
    for number, (before, after) in enumerate(zip(angles[:-1], angles[1:], strict=True)):
        ahead = (after - before) / dt * DAMP / STIFF  # the motors brake all speed; this makes up for it
        for part in range(within):
            data.ctrl[:] = before + (after - before) * (part + 1) / within + ahead
            mujoco.mj_step(simulator, data)
        mujoco.mj_kinematics(simulator, data)
        yield number, data.site("tip").xpos.copy()


def start(simulator: mujoco.MjModel, angles: np.ndarray) -> mujoco.MjData:
    """The arm at rest in a posture."""
    data = mujoco.MjData(simulator)
    data.qpos[: len(angles)] = angles
    mujoco.mj_forward(simulator, data)
    return data


def spatial(shoulder: float, links: Sequence[float], hand: Sequence[float]) -> tuple[list[Any], Sequence[float]]:
    """The arm of six joints."""
    up, across, here = "0 0 1", "0 1 0", (0.0, 0.0, 0.0)
    places = ((0.0, 0.0, shoulder), here, (0.0, 0.0, links[0]), (0.0, 0.0, links[1]), here, here)
    axes = (up, across, across, up, across, up)
    return [(HINGE, axis, place) for axis, place in zip(axes, places, strict=True)], hand


def moves(starts: np.ndarray, goals: np.ndarray, weights: np.ndarray, steps: int) -> np.ndarray:
    """Angles [L steps + 1, joints] of DMPs one after the other, by Euler's rule."""
    found = [starts[None]]
    for goal, pushes in zip(goals, weights, strict=True):
        basis = dmp.curves(steps, pushes.shape[1])
        found.append(basis @ np.concatenate([found[-1][-1][None], goal[None], pushes.T]))
    return np.concatenate(found)


def random(world: worlds.World, number: int) -> np.ndarray:
    """Random sequences [number, L, p]."""
    size = (number, world.longest, world.primitive)
    return np.random.default_rng(0).uniform(-1, 1, size).astype(np.float32)


def check_pen(number: int) -> dict[str, list[float]]:
    """Three joints and a height."""
    world, errors = worlds.make("pen"), []
    sequences = random(world, number)
    seen = jax.device_get(world.trace(sequences, world.longest).path)
    along = [(0.0, 0.0, 0.0), (pen.LINKS[0], 0.0, 0.0), (pen.LINKS[1], 0.0, 0.0)]
    simulator = model([(SLIDE, "0 0 1", along[0]), *((HINGE, "0 0 1", place) for place in along)], (pen.LINKS[2], 0, 0))
    share = np.linspace(0, 2, pen.STEPS + 1)[1:]
    for sequence, tips in zip(sequences.astype(float), seen.tip, strict=True):
        numbers = np.pi * sequence[:, :-2].reshape(world.longest, pen.JOINTS, pen.NUMBERS)
        joints = moves(np.zeros(pen.JOINTS), numbers[..., -1], numbers[..., :-1], pen.STEPS)
        height = [np.array([pen.REST_HEIGHT])]
        for via, end in sequence[:, -2:]:
            up, on = (dmp.minimum_jerk(np.clip(share - half, 0, 1)) for half in (0, 1))
            height.append(height[-1][-1] + (via - height[-1][-1]) * up + (end - via) * on)
        angles = np.column_stack([np.concatenate(height), joints])
        for step, tip in follow(simulator, start(simulator, angles[0]), angles, 1 / pen.STEPS):
            if (step + 1) % pen.STEPS == 0:
                tip[2] = max(tip[2], pen.FLOOR)
                errors.append(np.linalg.norm(np.clip(tip, -1, 1) - tips[step]))
    return {"tip": errors}


def check_throw(number: int) -> dict[str, list[float]]:
    """A joint for the yaw, three in a plane, and a ball that is let go."""
    world = worlds.make("throw")
    sequences = random(world, number)
    seen = jax.device_get(world.execute(sequences, 1))
    ball = f'<body name="ball"><freejoint/><inertial pos="0 0 0" mass="{GRAIN}" diaginertia="1e-6 1e-6 1e-6"/></body>'
    down = "0 -1 0"  # an angle above 0 lifts
    places = ((0.0, 0.0, throw.SHOULDER), (throw.LINKS[0], 0.0, 0.0), (throw.LINKS[1], 0.0, 0.0))
    joints = [(HINGE, "0 0 1", (0.0, 0.0, 0.0)), *((HINGE, down, place) for place in places)]
    simulator = model(joints, (throw.LINKS[2], 0.0, 0.0), world=ball)
    swings = jax.jit(jax.vmap(throw._swing, in_axes=(None, 0)))
    found: dict[str, list[float]] = {"tip": [], "landing": []}
    for i, sequence in enumerate(sequences):
        move = throw._movement(sequence[0])
        dt = max(float(move.duration * move.share), 0.01) / STEPS
        swing = np.asarray(swings(move, float(move.share) * np.arange(STEPS + 1) / STEPS), float)
        angles = np.column_stack([np.full(STEPS + 1, float(move.yaw)), swing])
        data = start(simulator, angles[0])
        for _, place in follow(simulator, data, angles, dt):
            tip = place
        r, z = np.asarray(throw._tip(jnp.asarray(swing[-1])))
        heading = np.array([np.cos(move.yaw), np.sin(move.yaw)])
        found["tip"].append(float(np.linalg.norm(tip - [*(r * heading), z])))
        if seen.reached[i, throw.THROWN]:
            turns = np.zeros((3, simulator.nv))
            mujoco.mj_jacSite(simulator, data, turns, None, simulator.site("tip").id)
            landed = _fall(simulator, data, tip, turns @ data.qvel)
            found["landing"].append(float(np.linalg.norm(landed - throw.FIELD * seen.value[i, throw.THROWN, :2])))
    return found


def _fall(simulator: mujoco.MjModel, data: mujoco.MjData, place: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """The place at which a ball comes down that is let go."""
    data.qpos[4:7], data.qvel[4:7] = place, speed
    while data.qpos[6] > 0:
        before = data.qpos[4:7].copy()
        mujoco.mj_step(simulator, data)
    return _through(before, data.qpos[4:7])


def _through(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The place at which a way crosses z = 0."""
    return (before + (after - before) * before[2] / (before[2] - after[2]))[:2]


def check_fishing(number: int) -> dict[str, list[float]]:
    """Random movements with the rod, of those that bring the float down."""
    world = worlds.make("fishing")
    sequences = random(world, 10 * number)
    sequences = sequences[np.flatnonzero(world.execute(sequences, 1).reached[:, 0])[:number]]
    return fishing_apart(sequences, jax.device_get(world.trace(sequences, 1)))


def fishing_apart(sequences: np.ndarray, seen: Any) -> dict[str, list[float]]:
    """Distances of movements [n, 1, 25], whose traces are `seen`, from those of a rod and a line of two masses."""
    half = rope.LENGTH / 2
    masses = "".join(_mass(name, mass) for name, mass in (("middle", GRAIN), ("float", GRAIN / rope.SHARE)))
    ends = (("tip", "middle"), ("middle", "float"))
    limited = f'limited="true" range="0 {half}" solreflimit=".001 1" solimplimit=".99 .999 .0001"'
    line = "".join(f'<spatial {limited}><site site="{a}"/><site site="{b}"/></spatial>' for a, b in ends)
    arm_of_six = spatial(fishing.SHOULDER, fishing.LINKS, fishing.ROD)
    simulator = model(*arm_of_six, more=f"<tendon>{line}</tendon>", world=masses)
    commands = jax.jit(fishing._angles)
    found: dict[str, list[float]] = {"tip": [], "float": []}
    for i, sequence in enumerate(sequences):
        angles = np.asarray(commands(sequence[0]), float).T
        data = start(simulator, angles[0])
        tip = data.site("tip").xpos
        data.qpos[6:9], data.qpos[9:12] = tip - [0, 0, half], tip - [0, 0, 2 * half]
        before, tips = data.qpos[9:12].copy(), []
        for _, tip in follow(simulator, data, angles, rope.DT):
            place = data.qpos[9:12].copy()
            tips.append(tip)
            if place[2] <= 0:
                break
            before = place
        moving = min(len(tips), int((~seen.path.wet[i]).sum()))
        apart = np.linalg.norm(np.array(tips)[:moving] - seen.path.arm[i, :moving, 3], axis=1)
        found["tip"].append(float(apart.max()))
        if place[2] <= 0 or seen.path.wet[i].any():
            found["float"].append(_apart(place, before, seen.path.line[i, -1, 1], seen, i))
    return found


def _mass(name: str, mass: float) -> str:
    """A point that moves freely, in the air."""
    slides = "".join(
        f'<joint type="slide" axis="{axis}" damping="{rope.DRAG * mass}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1")
    )
    inertia = f'<inertial pos="0 0 0" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/>'
    return f'<body name="{name}">{slides}{inertia}<site name="{name}"/></body>'


def _apart(place: np.ndarray, before: np.ndarray, last: np.ndarray, seen: Any, i: int) -> float:
    """The distance of both landings; that of the floats at the end where only one has landed."""
    if place[2] <= 0 and seen.outcomes.reached[i, 0]:
        return float(np.linalg.norm(_through(before, place) - fishing.FIELD * seen.outcomes.value[i, 0, :2]))
    return float(np.linalg.norm(place - last)) / rope.LENGTH


def check_table(number: int) -> dict[str, list[float]]:
    """The arm of six joints; a disc that is taken, carried and put down on a plane."""
    world, body = worlds.make("table"), table.Body()
    arm_of_six = spatial(table.SHOULDER, table.LINKS, (0.0, 0.0, table.HAND))
    thick = 0.005
    disc = (
        '<geom type="plane" size="2 2 .1"/><site name="beside"/>'
        f'<body name="disc" pos="{_numbers([*table.OBJECTS[0], thick])}"><freejoint/>'
        f'<geom type="cylinder" size="{table.RADIUS} {thick}" mass=".05"/><site name="disc" pos="0 0 {-thick}"/></body>'
    )
    held = '<equality><connect site1="tip" site2="disc" active="false" solref=".01 1"/></equality>'
    alone, carrying = model(*arm_of_six), model(*arm_of_six, more=held, world=disc)
    found: dict[str, list[float]] = {"tip": [], "carried": []}
    for sequence in random(world, number):
        angles = _table_angles(body, sequence, world.longest)
        wanted = np.asarray(body.points(jnp.asarray(angles[:: table.STEPS].T))[-1]).T
        for step, tip in follow(alone, start(alone, angles[0]), angles, 1 / table.STEPS):
            if (step + 1) % table.STEPS == 0:
                found["tip"].append(float(np.linalg.norm(tip - wanted[(step + 1) // table.STEPS])))
    goals = world.benchmark("blue")[:number]
    sequences, _ = world.demonstrate("blue", goals)
    for sequence, goal in zip(np.asarray(sequences), np.asarray(goals), strict=True):
        angles = _table_angles(body, sequence, 2)
        data = start(carrying, angles[0])
        for step, _ in follow(carrying, data, angles, 1 / table.STEPS):
            data.eq_active[0] = table.STEPS <= step + 1 < 2 * table.STEPS
        for _ in range(round(0.3 / carrying.opt.timestep)):  # it comes to rest
            mujoco.mj_step(carrying, data)
        way, target = data.body("disc").xpos[:2] - table.OBJECTS[0], goal[:2] - table.OBJECTS[0]
        found["carried"].append(float(np.linalg.norm(way - target) / np.linalg.norm(target)))
    return found


def _table_angles(body: table.Body, sequence: np.ndarray, length: int) -> np.ndarray:
    starts, goals, weights = (np.asarray(one, float) for one in table._commands(body, jnp.asarray(sequence)))
    return moves(starts[0], goals[:length], weights[:length], table.STEPS)


CHECKS: dict[str, Callable[[int], dict[str, list[float]]]] = {
    "pen": check_pen,
    "throw": check_throw,
    "fishing": check_fishing,
    "table": check_table,
}


def rows(name: str, number: int) -> list[dict[str, Any]]:
    """The report on a world."""
    began = time.monotonic()
    found = CHECKS[name](number)
    seconds = round(time.monotonic() - began, 1)
    told = []
    for what, errors in found.items():
        share = float(np.mean(np.asarray(errors) <= LIMITS[what]))
        median, most_of, worst = (float(np.quantile(errors, q)) for q in (0.5, 0.95, 1.0))
        told.append(
            {"world": name, "what": what, "limit": LIMITS[what], "number": len(errors), "median": median}
            | {"q95": most_of, "worst": worst, "within": share, "passed": share >= SHARE, "seconds": seconds}
        )
    return told


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(CHECKS))
    parser.add_argument("--movements", type=int, default=100)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for name in options.names:
        if name not in CHECKS:
            raise SystemExit(f"error: {name}: no such world; known are {', '.join(CHECKS)}")
    told: list[dict[str, Any]] = []
    for name in options.names or CHECKS:
        told += rows(name, options.movements)
        for row in told[-len(LIMITS) :]:
            if row["world"] == name:
                print(json.dumps({k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()}), flush=True)
        if options.out:
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["passed"] for row in told) else 1


if __name__ == "__main__":
    sys.exit(main())
