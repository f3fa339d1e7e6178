"""Figures of tutoring: what was practised when, and graphs of prerequisites."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from star.training.figures import literal

Row = Mapping[str, Any]
Edge = tuple[int, int]
_PLAIN = {"fc": "white", "ec": "none", "pad": 0.5}


def skills_figure(tables: Sequence[Row]) -> Figure:
    """Levels and practice of each skill over exercises, for the first seed in `tables`, roots first."""
    rows = [row for row in tables if row["seed"] == tables[0]["seed"]]
    steps = [row["env_steps"] for row in rows]
    deep = depths(len(rows[0]["level"]), rows[0]["prerequisites"])
    order = np.argsort(deep, kind="stable")
    colours = [f"C{i % 10}" for i in range(len(order))]
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for skill, colour in zip(order, colours, strict=True):
        label = f"{skill}, depth {deep[skill]}"
        left.plot(steps, [row["level"][skill] for row in rows], color=colour, label=label)
    left.set(xlabel="exercises", ylabel="lasting level, Elo points", title=f"seed {rows[0]['seed']}")
    left.axhline(2000, color="black", lw=0.8, ls="--")
    left.grid(alpha=0.3)
    right.stackplot(steps, np.array([row["practised"] for row in rows]).T[order], colors=colours, alpha=0.8)
    right.set(xlabel="exercises", ylabel="share of the needs practised", ylim=(0, 1))
    figure.legend(*left.get_legend_handles_labels(), title="skill", loc="outside right center", fontsize="small")
    return figure


def graphs_figure(tables: Sequence[Row]) -> Figure:
    """The graph that the tutor knew at the end beside the true one, for the first seed in `tables`."""
    row = [row for row in tables if row["seed"] == tables[0]["seed"]][-1]
    names = [str(i) for i in range(len(row["level"]))]
    true, known = ({(i, j) for i, j in row[key]} for key in ("prerequisites", "known"))
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    for axis, edges, title in zip(
        figure.subplots(1, 2), (true, known), ("true graph", "graph that the tutor knows"), strict=True
    ):
        draw_graph(axis, names, {edge: 1.0 for edge in edges}, wrong=edges - true, place=depths(len(names), true))
        axis.set_title(title)
    figure.supxlabel("an arrow leads from a prerequisite; red: not in the true graph", fontsize="small")
    return figure


def found_figure(names: Sequence[str], shares: Mapping[Edge, float]) -> Figure:
    """A graph found: edges (skill, prerequisite) with the share of models that have them."""
    wide = max(np.bincount(depths(len(names), shares)))
    figure = Figure(figsize=(max(6.0, 1.5 * wide), 6.0), layout="constrained")
    draw_graph(figure.subplots(), names, shares, told=True)
    return figure


def draw_graph(
    axis: Axes,
    names: Sequence[str],
    shares: Mapping[Edge, float],
    *,
    wrong: set[Edge] | frozenset[Edge] = frozenset(),
    place: np.ndarray | None = None,
    told: bool = False,
) -> None:
    """Skills in rows by `place` (their depth), prerequisites above; edges are the darker the larger their share.

    `told` writes the shares beside the edges.
    """
    deep = depths(len(names), shares) if place is None else place
    at = _positions(deep, shares)
    for (child, parent), share in shares.items():
        colour = "tab:red" if (child, parent) in wrong else "black"
        arrow = FancyArrowPatch(
            at[parent], at[child], arrowstyle="-|>", mutation_scale=12, color=colour, alpha=0.25 + 0.75 * share,
            shrinkA=13, shrinkB=13, connectionstyle="arc3,rad=0.08",
        )  # fmt: skip
        axis.add_patch(arrow)
        if told:
            x, y = 0.6 * at[child] + 0.4 * at[parent]
            axis.text(x, y, f"{share:.2f}", fontsize=7, ha="center", va="center", color="tab:blue", bbox=_PLAIN)
    for name, (x, y) in zip(names, at, strict=True):
        axis.text(x, y, literal(name), ha="center", va="center", bbox={"boxstyle": "round", "fc": "white"}, fontsize=9)
    axis.set(xlim=(-0.7, at[:, 0].max() + 0.7), ylim=(at[:, 1].min() - 0.5, 0.5))
    axis.axis("off")


def depths(n: int, edges: Any) -> np.ndarray:
    """Number of skills that lie one before the other before each of `n`, from acyclic edges (skill, prerequisite)."""
    deep = np.zeros(n, int)
    for _ in range(n):
        for child, parent in edges:
            deep[child] = max(deep[child], deep[parent] + 1)
    return deep


def _positions(deep: np.ndarray, edges: Any) -> np.ndarray:
    """[n, 2]: a row for each depth; in it each skill as near to the mean of its prerequisites as the order allows."""
    at = np.zeros((len(deep), 2))
    widest = np.bincount(deep).max()
    for row in range(deep.max() + 1):
        members = np.flatnonzero(deep == row)
        wanted = [np.mean([at[j, 0] for i, j in edges if i == member] or [member]) for member in members]
        slots = (np.arange(len(members)) + 0.5) * widest / len(members)
        at[members[np.argsort(wanted, kind="stable")], 0] = slots
        at[members, 1] = -row
    return at
