"""Figures of a run of CHIME: births over time, competence by observable, the hierarchy found, and tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.ticker import EngFormatter, MaxNLocator

from envs.worlds import room as rooms
from envs.worlds.room import Room
from star.report.statistics import over_seeds
from star.training.figures import literal
from star.training.journal import by_step

Row = Mapping[str, Any]
Births = Sequence[tuple[str, str, int]]

COLOURS = ("0.35", "#4477aa", "#228833", "#ccbb44", "#ee6677", "#aa3377", "#66ccee", "#994455", "#004488")
FIRSTS = {"robot": "#4477aa", "object": "#228833", "object by object": "#ee6677"}
"""The order that is looked for, and its colours."""


def figures(room: Room, rows: Sequence[Row], tables: Sequence[Row]) -> dict[str, Figure]:
    """All of them by their names, as far as there is something to show."""
    found: dict[str, Figure] = {}
    if rows:
        found |= {"competence": competence(room, rows), "curriculum": curriculum(room, rows)}
    evaluated = [row for row in rows if "eval/distance" in row]
    if evaluated:
        found["summary"] = summary(evaluated)
    last = [row for row in tables if row["env_steps"] == tables[-1]["env_steps"]]
    if last:
        found |= {"births": births(last), "hierarchy": hierarchy(room, last)}
    return found


def kind(outcome: str, control: str) -> str:
    """The one of `FIRSTS` that a model with this outcome and control is."""
    return outcome if outcome == "robot" else "object" if control in ("action", "robot") else "object by object"


def firsts(pairs: Births) -> dict[str, int]:
    """The action at which a model of the robot, of an object and of an object by an object was first born, if ever.

    `pairs` are an outcome, its control and the first birth.
    """
    found: dict[str, int] = {}
    for outcome, control, action in pairs:
        name = kind(outcome, control)
        found[name] = min(action, found.get(name, action))
    return found


def births(last: Sequence[Row]) -> Figure:
    """The share of learners that have had a model of each kind, over actions, and each first birth."""
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.subplots()
    end = last[0]["env_steps"]
    for number, (name, colour) in enumerate(FIRSTS.items()):
        times = sorted(first[name] for row in last if name in (first := firsts(row["births"])))
        share = np.arange(len(times) + 1) / len(last)
        axes.step([0, *times, end], [*share, share[-1]], where="post", color=colour, lw=1.8, label=name)
        axes.plot(times, np.full(len(times), -0.04 - 0.03 * number), "|", color=colour, ms=6)
    axes.set(ylabel="share of learners", ylim=(-0.15, 1.05), title="first birth of a model")
    axes.legend(loc="center right")
    axes.grid(alpha=0.3)
    _over_actions(axes)
    return figure


def competence(room: Room, rows: Sequence[Row]) -> Figure:
    """The competence of the best model of each disc over actions: mean over seeds and its 95 % interval."""
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.subplots()
    moments = by_step(rows)
    steps = [now[0]["env_steps"] for now in moments]
    for name, colour in zip(room.discs, COLOURS, strict=False):
        table = [np.array([row[f"chime/competence_{name}"] for row in now]) for now in moments]
        _band(axes, steps, table, colour, name)
    axes.set(ylabel="competence of the best model", ylim=(-0.02, 1))
    axes.legend()
    axes.grid(alpha=0.3)
    _over_actions(axes)
    return figure


def curriculum(room: Room, rows: Sequence[Row]) -> Figure:
    """Practice over time, and movements: means over seeds."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    moments = by_step(rows)
    steps = [now[0]["env_steps"] for now in moments]

    def shares(what: str, name: str) -> np.ndarray:
        found = np.array([np.mean([row[f"chime/{what}_{name}"] for row in now]) for now in moments])
        width = max(1, len(found) // 25)  # so many moments are drawn as one
        return np.array([found[max(0, i - width + 1) : i + 1].mean() for i in range(len(found))])

    discs = [name for name in room.discs if any(row[f"chime/practice_{name}"] for row in rows)]
    colours = [COLOURS[room.discs.index(name)] for name in discs]
    if discs:
        named = [literal(name) for name in discs]
        left.stackplot(steps, [shares("practice", name) for name in discs], labels=named, colors=colours)
        left.legend(loc="upper right", fontsize="small")
    for number, name in enumerate(room.discs[1 : 1 + room.movable], 1):
        right.plot(steps, shares("moved", name), color=COLOURS[number], label=literal(name))
    left.set(title="tasks", ylabel="share of episodes", ylim=(0, 1))
    right.set(title="objects that moved", ylabel="share of actions", ylim=(0, None))
    right.legend(fontsize="small")
    for axes in (left, right):
        _over_actions(axes)
    return figure


def summary(rows: Sequence[Row]) -> Figure:
    """The distance from the goal at the end of tests: mean over seeds and its 95 % interval."""
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.subplots()
    moments = by_step(rows)
    steps = [now[0]["env_steps"] for now in moments]
    for kind, colour in zip(rooms.KINDS, FIRSTS.values(), strict=True):
        key = f"eval/distance_{kind}"
        if key in rows[0]:
            _band(axes, steps, [np.array([row[key] for row in now]) for now in moments], colour, kind)
    axes.set(ylabel="distance from the goal at the end of a test", ylim=(0, None))
    axes.legend()
    axes.grid(alpha=0.3)
    _over_actions(axes)
    return figure


def hierarchy(room: Room, last: Sequence[Row]) -> Figure:
    """The models that are on in the end: arrows lead from the control, with the share of learners as a label."""
    count: dict[tuple[str, str], float] = {}
    for row in last:
        for pair in competences(row["models"]):
            count[pair] = count.get(pair, 0.0) + 1 / len(last)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    graph(figure.subplots(), room, count)
    return figure


def competences(models: Sequence[Row]) -> dict[tuple[str, str], float]:
    """Of the models that are on: control and outcome, and the competence."""
    return {(model["control"], model["outcome"]): model["competence"] for model in models if model["on"]}


def graph(axes: Axes, room: Room, shares: Mapping[tuple[str, str], float]) -> None:
    """Arrows from control to outcome, the darker the larger their share; what nothing controls is grey."""
    objects = room.discs[1:]
    places = {"action": (0.0, 0.0), "robot": (1.0, 0.0)}
    places |= {name: (2.0, (len(objects) - 1) / 2 - i) for i, name in enumerate(objects)}
    others = sorted({name for pair in shares for name in pair} - places.keys())
    places |= {name: (1.0, -1.0 - i) for i, name in enumerate(others)}
    for (control, outcome), share in shares.items():
        start, end = places[control], places[outcome]
        bend, gap = (0.35, 14) if start[0] == end[0] else (0.0, 29)  # names are wider than high
        axes.add_patch(
            FancyArrowPatch(
                start, end, arrowstyle="-|>", mutation_scale=14, color="black", alpha=0.2 + 0.8 * min(share, 1.0),
                shrinkA=gap, shrinkB=gap, connectionstyle=f"arc3,rad={bend}",
            )
        )  # fmt: skip
        across, up = np.subtract(end, start)
        aside = bend / 2 * np.array([up, -across]) if bend else 0.17 / np.hypot(across, up) * np.array([-up, across])
        x, y = 0.55 * np.array(end) + 0.45 * np.array(start) + aside
        axes.text(
            x, y, f"{share:.2f}", fontsize=8, ha="center", va="center",
            color="tab:blue", bbox={"fc": "white", "ec": "none", "pad": 0.5},
        )  # fmt: skip
    known = {outcome for _, outcome in shares} | {"action"}
    for name, (x, y) in places.items():
        ink = "black" if name in known else "0.6"
        axes.text(
            x, y, literal(name), ha="center", va="center", fontsize=9, color=ink,
            bbox={"boxstyle": "round", "fc": "white", "ec": ink},
        )  # fmt: skip
    rows = [y for _, y in places.values()]
    axes.set(xlim=(-0.4, 2.5), ylim=(min(rows) - 0.6, max(rows) + 0.6), title="models that are on")
    axes.axis("off")


def _band(axes: Axes, steps: Sequence[int], table: Sequence[np.ndarray], colour: str, name: str) -> None:
    mean, low, high = np.transpose([over_seeds(np.asarray(now)) for now in table])
    axes.plot(steps, mean, color=colour, lw=1.5, label=literal(name))
    axes.fill_between(steps, low, high, color=colour, alpha=0.18, lw=0)


def _over_actions(axes: Axes) -> None:
    axes.set_xlabel("actions")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
