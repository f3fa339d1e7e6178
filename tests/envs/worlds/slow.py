"""The worlds once more, written for reading: NumPy, float64, loops, one step after the other."""

import math
from functools import cache

import numpy as np

LINKS = (0.40, 0.35, 0.25)
PEN, STICK_1, STICK_2 = np.array([-0.35, 0.55, 0.25]), np.array([0.55, -0.45, 0.45]), np.array([-0.45, -0.55, 0.45])
TASKS = 6


def smooth(u):
    u = min(max(u, 0.0), 1.0)
    return 10 * u**3 - 15 * u**4 + 6 * u**5


def pen(sequence, length):
    """(value [6, 4], reached [6], the tip after every control step)."""
    world = {"hand": None, "pen": PEN.copy(), "whole": True, "line": None, "drawing": False, "dead": False}
    world |= {"stick_1": None, "stick_2": None}
    angles, height, tip, path = np.zeros(3), 0.5, np.array([1.0, 0.0, 0.5]), []
    for primitive in np.asarray(sequence, float)[:length]:
        tips, heights, angles, height = movement(primitive, angles, height)
        for now, commanded in zip(tips, heights, strict=True):
            step(world, tip, now, commanded)
            tip = now
            path.append(tip)
        for number, name in ((1, "stick_1"), (2, "stick_2")):
            if world["hand"] == name and not world["dead"]:
                world[name] = np.clip((tip - (STICK_1, STICK_2)[number - 1]) / 0.2, -1, 1)
    return (*results(world, tip), np.array(path))


def movement(primitive, angles, height):
    """30 tips and commanded heights, and the angles and height at the end."""
    x, tips, heights = list(angles), [], []
    speed = [0.0] * 3
    commands, (via, end) = primitive[:12].reshape(3, 4).tolist(), primitive[12:].tolist()
    for number, pushes in enumerate(bumps()):
        for joint, (*weights, goal) in enumerate(commands):
            push = math.pi * sum(weight * one for weight, one in zip(weights, pushes, strict=True))
            pull = 150 * (math.pi * goal - x[joint]) - 2 * math.sqrt(150) * speed[joint] + push
            x[joint], speed[joint] = x[joint] + speed[joint] / 300, speed[joint] + pull / 300
        if (number + 1) % 10 == 0:
            u = (number + 1) / 300
            heights.append(height + (via - height) * smooth(2 * u) + (end - via) * smooth(2 * u - 1))
            tips.append(kinematics(x, heights[-1]))
    return tips, heights, x, heights[-1]


@cache
def bumps():
    """The push of each weight of 1 at 300 times, so that alone it moves a joint of 1 rad by .35 rad at most."""
    centres, phase, found = [math.exp(-4.6 * t) for t in (0, 0.5, 1)], 1.0, []
    for _ in range(300):
        heights = [math.exp(-3 / c * (phase - c) ** 2) for c in centres]
        found.append([height * phase / sum(heights) for height in heights])
        phase -= 4.6 * phase / 300
    tops = []
    for chosen in range(3):
        x = speed = top = 0.0
        for pushes in found:
            pull = -150 * x - 2 * math.sqrt(150) * speed + pushes[chosen]
            x, speed = x + speed / 300, speed + pull / 300
            top = max(top, abs(x))
        tops.append(top)
    return [[0.35 * push / top for push, top in zip(pushes, tops, strict=True)] for pushes in found]


def kinematics(angles, height):
    x = y = along = 0.0
    for angle, link in zip(angles, LINKS, strict=True):
        along += angle
        x, y = x + link * math.cos(along), y + link * math.sin(along)
    return np.array([x, y, max(height, -0.2)])


def step(world, before, tip, commanded):
    """What the objects do while the tip goes from one point to the next."""
    if world["dead"]:
        return
    places = {"pen": world["pen"], "stick_1": STICK_1, "stick_2": STICK_2}
    touched = [name for name, place in places.items() if distance(place, before, tip) < 0.1]
    if world["hand"] is None:
        world["hand"] = touched[0] if touched else None
    elif [name for name in touched if name != world["hand"]]:
        world["dead"] = True
        return
    if world["hand"] in ("stick_1", "stick_2"):
        if np.abs((tip - places[world["hand"]]) / 0.2).max() > 1.01:
            world["hand"] = None
    if world["hand"] == "pen":
        world["pen"] = tip.copy()
        world["whole"] = world["whole"] and commanded >= -0.3
    if world["hand"] == "pen" and world["whole"] and tip[2] <= 0:
        first = world["line"][:2] if world["drawing"] else tip[:2]
        world["line"], world["drawing"] = np.concatenate([first, tip[:2]]), True
    else:
        world["drawing"] = False


def distance(point, start, end):
    way = end - start
    share = 0.0 if not way.any() else min(max(np.dot(point - start, way) / np.dot(way, way), 0.0), 1.0)
    return np.linalg.norm(start + share * way - point)


def results(world, tip):
    value, reached = np.zeros((TASKS, 4)), np.zeros(TASKS, bool)
    found = {0: tip}
    if not world["dead"]:
        if world["hand"] == "pen":
            found[1] = world["pen"]
        found |= {2: world["line"], 3: world["stick_1"], 4: world["stick_2"]}
        if world["stick_1"] is not None or world["stick_2"] is not None:
            x = 0.0 if world["stick_1"] is None else world["stick_1"][0]
            y = 0.0 if world["stick_2"] is None else world["stick_2"][1]
            found[5] = np.array([x, y])
    for task, numbers in found.items():
        if numbers is not None:
            value[task, : len(numbers)], reached[task] = numbers, True
    return value, reached


def throw(primitive):
    """(value [2, 4], reached [2])."""
    primitive = np.asarray(primitive, float)
    yaw, via, end = 0.75 * math.pi * primitive[0], primitive[1:4] * (1.6, 2.2, 1.6), primitive[4:7] * (1.6, 2.2, 1.6)
    duration, moment = 0.9 + 0.6 * primitive[7], 0.5 + 0.5 * primitive[8]

    def tip(share):
        start, stop, u = ((-1.2, 0.6, 0.4), via, 2 * share) if share < 0.5 else (via, end, 2 * share - 1)
        r, z, along = 0.0, 0.5, 0.0
        for link, a, b in zip((0.45, 0.40, 0.25), start, stop, strict=True):
            along += a + (b - a) * smooth(u)
            r, z = r + link * math.cos(along), z + link * math.sin(along)
        return np.array([r, z])

    r, z = tip(moment)
    small = 1e-6
    vr, vz = (tip(min(moment + small, 1)) - tip(max(moment - small, 0))) / (
        (min(moment + small, 1) - max(moment - small, 0)) * duration
    )
    value, reached, heading = np.zeros((2, 4)), np.zeros(2, bool), np.array([math.cos(yaw), math.sin(yaw)])
    speed = math.hypot(vr, vz)
    if speed > 0.6 and z > 0.05:
        height, far, dt = z, r, 0.02
        while True:  # fall, step by step; exactly so for a parabola
            if height + vz * dt - 9.81 * dt**2 / 2 < 0:
                last = (vz + math.sqrt(vz**2 + 2 * 9.81 * height)) / 9.81
                far += vr * last
                break
            height, far, vz = height + vz * dt - 9.81 * dt**2 / 2, far + vr * dt, vz - 9.81 * dt
        place = far * heading / 3
        if np.abs(place).max() <= 1:
            value[0, :2], reached[0] = place, True
    elif speed <= 0.6 and abs(z - 0.3) < 0.06 and abs(r) > 0.2:
        value[1, :2], reached[1] = r * heading / 1.1, True
    return value, reached


def rotation(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == "z" else [[c, 0, s], [0, 1, 0], [-s, 0, c]])


def six_joints(angles, shoulder, links, hand):
    """The tip of an arm whose joints turn about z, y, y, z, y, z."""
    frame, place = np.eye(3), np.array([0.0, 0.0, shoulder])
    steps = zip(
        "zyyzyz", angles, ((0, 0, 0), (0, 0, links[0]), (0, 0, links[1]), (0, 0, 0), (0, 0, 0), hand), strict=True
    )
    for axis, angle, then in steps:
        frame = frame @ rotation(axis, angle)
        place = place + frame @ np.array(then, float)
    return place


def fishing(primitives):
    """Where each float meets the water (x, y over 2.2 m), or NaN. In steps of 1.25 ms; tensions one after the other."""
    primitives, dt = np.asarray(primitives, float), 1.25e-3
    n, limits = len(primitives), np.array([0.96, 0.72, 0.72, 0.96, 0.72, 0.96])
    rest, inverse = np.array([0.0, -0.3, 0.8, 0.0, 0.2, 0.0]), [0.0, 1.0, 1 / 6]

    def tip(primitive, time):
        u = min(time / (1.05 + 0.45 * primitive[24]), 1.0)
        bumps = [math.comb(4, k) * u**k * (1 - u) ** (4 - k) for k in range(1, 5)]
        angles = rest + limits * (primitive[:24].reshape(6, 4) @ bumps)
        return six_joints(angles, 0.45, (0.3, 0.3), (0.15, 0.0, 0.8))

    anchor = np.array([tip(primitive, 0.0) for primitive in primitives])
    masses, speeds = [anchor - [0, 0, 0.5], anchor - [0, 0, 1.0]], [np.zeros((n, 3))] * 2
    landed, length = np.full((n, 2), np.nan), lambda way: np.linalg.norm(way, axis=1)[:, None]
    for step in range(1, 1601):
        before, old = [anchor, *masses], masses
        anchor = np.array([tip(primitive, step * dt) for primitive in primitives])
        now = [anchor]
        falls = [v + dt * np.array([0, 0, -9.81]) for v in speeds]
        now += [x + dt * v * (1 - 1.0 * dt) for x, v in zip(masses, falls, strict=True)]
        ways = []
        for i in range(2):
            last, free = before[i + 1] - before[i], now[i + 1] - now[i]
            way = np.where(length(last) > 0.4995, last, free)
            ways.append(way / length(way))
        tension = [np.zeros((n, 1))] * 2
        for i in [0, 1] * 12:
            gap = now[i + 1] - now[i]
            slope = (inverse[i] + inverse[i + 1]) * (gap * ways[i]).sum(axis=1, keepdims=True) / length(gap)
            pull = np.maximum((length(gap) - 0.5) / slope, -tension[i])
            tension[i] = tension[i] + pull
            now[i], now[i + 1] = now[i] + inverse[i] * pull * ways[i], now[i + 1] - inverse[i + 1] * pull * ways[i]
        masses = now[1:]
        speeds = [(x - y) / dt for x, y in zip(masses, old, strict=True)]
        first = (masses[1][:, 2] <= 0) & np.isnan(landed[:, 0])
        share = old[1][first, 2:] / (old[1][first, 2:] - masses[1][first, 2:])
        landed[first] = (old[1][first] + share * (masses[1][first] - old[1][first]))[:, :2] / 2.2
    return landed


def table(sequence, length):
    """(value [6, 4], reached [6], the tips), each primitive ending where its DMPs come to."""
    rest, limits = np.array([0, 0.5, 1.2, 0, 0.7, 0]), np.array([0.9, 0.7, 0.9, 0.8, 0.8, 0.8])
    numbers, angles, tips = np.asarray(sequence, float).reshape(-1, 6, 3), rest.copy(), []
    places, hand, put, found = {"blue": (0.45, 0.2), "green": (0.45, -0.2)}, None, set(), {}
    for primitive in numbers[:length]:
        angles = dmp_end(angles, rest + limits * primitive[:, 2], limits[:, None] * primitive[:, :2])
        tip = six_joints(angles, 0.15, (0.35, 0.35), (0, 0, 0.15))
        tips.append(tip)
        x, y, z = tip
        if not (-0.3 < z <= 0 and 0.2 <= x <= 0.8 and -0.45 <= y <= 0.45):
            continue
        found[0] = (x, y)
        if hand:
            places[hand], hand = (x, y), put.add(hand)
            if len(put) == 2:
                (x1, y1), (x2, y2) = places.values()
                found[3] = (math.hypot(x1 - x2, y1 - y2), math.atan2(abs(y1 - y2), abs(x1 - x2)) * 2 / math.pi)
            continue
        near = [name for name, (u, v) in places.items() if math.hypot(u - x, v - y) < 0.07]
        if near:
            hand = near[0]
        elif -0.45 <= y <= -0.35:
            found[4] = (x,)
            if 3 in found:
                found[5] = (*found[3], x)
    found |= {task: places[name] for task, name in ((1, "blue"), (2, "green")) if name in put}
    value, reached = np.zeros((6, 4)), np.zeros(6, bool)
    for task, one in found.items():
        value[task, : len(one)], reached[task] = one, True
    return value, reached, np.array(tips)


def dmp_end(start, goal, weights):
    """Where a movement with two weights a joint ends; pushes are scaled as in `bumps`. Linear, so a sum of four."""
    ends = unit_ends()
    return ends[0] * start + ends[1] * goal + weights @ ends[2:]


@cache
def unit_ends():
    """Of 300 steps of Euler's rule, from 1 to 0, from 0 to 1, and with either push."""
    x, speed, phase, path = np.array([1.0, 0, 0, 0]), np.zeros(4), 1.0, []
    for _ in range(300):
        heights = np.array([math.exp(-3 / c * (phase - c) ** 2) for c in (1.0, math.exp(-4.6))])
        push = np.concatenate([[0, 0], heights * phase / heights.sum()])
        pull = 150 * (np.array([0, 1, 0, 0]) - x) - 2 * math.sqrt(150) * speed + push
        x, speed, phase = x + speed / 300, speed + pull / 300, phase - 4.6 * phase / 300
        path.append(x)
    return np.concatenate([x[:2], 0.35 * x[2:] / np.abs(path).max(axis=0)[2:]])
