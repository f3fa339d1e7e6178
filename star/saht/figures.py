"""Figures of a run of SGIM-SAHT, as in the thesis: tasks practised, strategies, and purposes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from envs.worlds import World
from star.report.statistics import over_seeds
from star.saht.proposals import Way
from star.training.figures import literal
from star.training.journal import by_step

Row = Mapping[str, Any]

KINDS = {
    "random": ("random", "0.7"),
    "actions": ("actions, alone", "#4477aa"),
    "procedures": ("procedures, alone", "#228833"),
    "dagger": ("DAgger", "#66ccee"),
    "cba": ("confidence-based autonomy", "#994455"),
    "action": ("teachers of actions", "#ee99aa"),
    "outcome": ("teachers of outcomes", "#ccbb44"),
    "procedure": ("teachers of procedures", "#aa3377"),
}
"""The name and colour of each kind of strategy."""
TASKS = ("#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377", "0.5", "#994455", "#004488", "#ddaa33")
_MOST_MATRICES = 12


def figures(world: World, ways: Sequence[Way], rows: Sequence[Row], tables: Sequence[Row]) -> dict[str, Figure]:
    """All of them by their names, as far as there is something to show."""
    found: dict[str, Figure] = {}
    if any("eval/error" in row for row in rows):
        found["summary"] = summary(world, rows)
    if rows:
        found["curriculum"] = curriculum(world, ways, rows)
    last = [row for row in tables if row["env_steps"] == tables[-1]["env_steps"]]
    if last:
        found |= {
            "strategies": strategies(world, ways, last),
            "lengths": lengths(world, last),
            "interest": interest(world, last[0]),
        }
        if any(way.kind == "procedures" for way in ways):
            found["hierarchy"] = hierarchy(world, last)
    return found


def summary(world: World, rows: Sequence[Row]) -> Figure:
    """The error of each task over iterations: mean over seeds and its 95 % interval."""
    figure = Figure(figsize=(6.8, 4.4), layout="constrained")
    axes = figure.subplots()
    evaluated = by_step([row for row in rows if "eval/error" in row])
    steps = [now[0]["env_steps"] for now in evaluated]
    named = [("mean of all tasks", "eval/error", "0.1")]
    named += [(name, f"eval/error_{name}", colour(i)) for i, name in enumerate(world.names)]
    for name, key, shade in named:
        table = [[row[key] for row in now] for now in evaluated]
        mean, low, high = np.transpose([over_seeds(np.asarray(one)) for one in table])
        axes.plot(steps, mean, color=shade, marker=".", lw=2.2 if shade == "0.1" else 1.3, label=literal(name))
        axes.fill_between(steps, np.maximum(low, 1e-3), high, color=shade, alpha=0.18, lw=0)
    _over_iterations(axes)
    axes.set(yscale="log", ylabel="error on goals of the evaluation")
    plain_ticks(axes)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small", ncols=2)
    return figure


def curriculum(world: World, ways: Sequence[Way], rows: Sequence[Row]) -> Figure:
    """Tasks practised over time, and strategies: means over seeds."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    moments = by_step(rows)
    steps = [now[0]["env_steps"] for now in moments]

    def share(name: str) -> np.ndarray:
        return np.array([np.mean([row[f"saht/{name}"] for row in now]) for now in moments])

    tasks = [share(f"task_{name}") for name in world.names]
    left.stackplot(
        steps, tasks, labels=[literal(name) for name in world.names], colors=[colour(i) for i in range(len(tasks))]
    )
    kinds = _by_kind(ways, lambda way: share(f"strategy_{way.name}"))
    right.stackplot(
        steps,
        list(kinds.values()),
        labels=[KINDS[kind][0] for kind in kinds],
        colors=[KINDS[kind][1] for kind in kinds],
    )
    for axes, title in ((left, "tasks"), (right, "strategies")):
        _over_iterations(axes)
        axes.set(title=title, ylim=(0, 1), xlim=(steps[0], steps[-1]) if len(steps) > 1 else None)
        _legend_below(axes)
    left.set_ylabel("share of blocks")
    return figure


def strategies(world: World, ways: Sequence[Way], last: Sequence[Row]) -> Figure:
    """Strategies of each task: the iterations of a seed, by kind of strategy."""
    chosen = np.mean([row["chosen"] for row in last], axis=0)  # [S, M]
    kinds = _by_kind(ways, lambda way: chosen[:, list(ways).index(way)])
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    _stacked(axes, world, kinds, lambda kind: KINDS[kind])
    axes.set(ylabel="iterations for goals of the task", title="strategies by task")
    return figure


def lengths(world: World, last: Sequence[Row]) -> Figure:
    """Of how many primitives sequences were, by the task that they were for."""
    played = np.mean([row["played"] for row in last], axis=0)  # [S, L]
    share = played / np.maximum(played.sum(axis=1, keepdims=True), 1)
    shades = np.linspace(0.85, 0.15, share.shape[1])
    parts = {n: share[:, n] for n in range(share.shape[1])}
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    _stacked(axes, world, parts, lambda n: (f"{n + 1} primitive{'s' * (n > 0)}", str(shades[n])))
    axes.set(ylabel="share of sequences", ylim=(0, 1), title="length of sequences by task")
    return figure


def interest(world: World, row: Row) -> Figure:
    """The regions of goals of a seed, in the first two dimensions of each task, by their interest."""
    lower, upper, worth = (np.asarray(row[name]) for name in ("lower", "upper", "interest"))
    figure = Figure(figsize=(2.2 * len(world.tasks) + 1, 2.8), layout="constrained")
    panels = figure.subplots(1, len(world.tasks), squeeze=False)[0]
    scale = ScalarMappable(norm=Normalize(0, max(worth.max(), 1e-9)), cmap="viridis")
    for task, axes in enumerate(panels):
        low, high = (np.asarray(x)[task, :2] for x in (world.lower, world.upper))
        for i in np.flatnonzero((lower[:, 0] <= task) & (task < upper[:, 0])):
            corner, end = (low + (high - low) * x[i, 1:3] for x in (lower, upper))
            axes.add_patch(Rectangle(corner, *(end - corner), facecolor=scale.to_rgba(worth[i]), edgecolor="white"))
        plane = world.dims[task] > 1
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]) if plane else (0, 1), title=literal(world.names[task]))
        axes.tick_params(labelsize=7)
    figure.colorbar(scale, ax=list(panels), label="interest")
    figure.suptitle(f"regions of goals, seed {row['seed']}", size=10)
    return figure


def hierarchy(world: World, last: Sequence[Row]) -> Figure:
    """For each task the pairs of tasks that learners' own procedures were made of; those of the world are framed."""
    pairs = np.mean([row["pairs"] for row in last], axis=0)[:_MOST_MATRICES]
    share = pairs / np.maximum(pairs.sum(axis=(1, 2), keepdims=True), 1)
    n = len(world.tasks)
    designed = jax.device_get(jax.jit(lambda: [world.decompose(task, jnp.zeros(4)) for task in range(n)])())
    figure = Figure(figsize=(2.1 * len(share) + 1.4, 3.1), layout="constrained")
    panels = figure.subplots(1, len(share), squeeze=False, sharey=True)[0]
    for task, axes in enumerate(panels):
        axes.imshow(share[task], cmap="Purples", vmin=0, vmax=max(share.max(), 1e-9))
        axes.set_title(literal(world.names[task]), size=9)
        axes.set_xticks(range(n), [literal(name) for name in world.names], rotation=90, size=7)
        axes.set_yticks(range(n), [literal(name) for name in world.names], size=7)
        if designed[task].exists:
            first, second = designed[task].tasks
            axes.add_patch(Rectangle((second - 0.5, first - 0.5), 1, 1, fill=False, edgecolor="#ee6677", lw=2))
    panels[0].set_ylabel("first", size=8)
    figure.supxlabel("second", size=8)
    figure.colorbar(panels[-1].images[0], ax=list(panels), label="share of procedures")
    figure.suptitle("tasks that procedures alone were made of; framed: as the world was designed", size=10)
    return figure


def plain_ticks(axes: Axes) -> None:
    """Numbers as they are on a logarithmic axis, those that begin with 1, 2 or 5."""
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def colour(task: int) -> str:
    """That of a task."""
    return TASKS[task % len(TASKS)]


def _by_kind(ways: Sequence[Way], value: Callable[[Way], np.ndarray]) -> dict[str, np.ndarray]:
    """Sums over the strategies of each kind, in the order of `KINDS`."""
    there = [kind for kind in KINDS if any(way.kind == kind for way in ways)]
    return {kind: np.sum([value(way) for way in ways if way.kind == kind], axis=0) for kind in there}


def _stacked(axes: Axes, world: World, parts: Mapping[Any, np.ndarray], look: Callable[[Any], tuple[str, str]]) -> None:
    """A bar for each task."""
    names, base = [literal(name) for name in world.names], np.zeros(len(world.tasks))
    for part, height in parts.items():
        label, shade = look(part)
        axes.bar(names, height, bottom=base, label=label, color=shade, width=0.7)
        base = base + height
    axes.tick_params(axis="x", labelsize=8)
    _legend_below(axes)


def _legend_below(axes: Axes) -> None:
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3, fontsize="small", frameon=False)


def _over_iterations(axes: Axes) -> None:
    axes.set_xlabel("iterations")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
