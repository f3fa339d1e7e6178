"""The output of a sweep for people: a table of its trials, `trials.csv` and figures."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from envs.common import files
from star.config.kinds import Measure
from star.sweeps.plan import Plan
from star.training.figures import literal, save

Row = Mapping[str, Any]

_SHOWN = 20


def write(out: Path, rows: Sequence[Row], found: Plan, *, shares: Mapping[str, float]) -> None:
    """Write `trials.csv`, best first, and the figures that the complete and pruned trials in `rows` allow."""
    with files.whole(out / "trials.csv") as path:  # other workers may be at it too
        _write_csv(path, sorted(rows, key=partial(_place, found.measure)))
    valued = [row for row in rows if row["value"] is not None]
    if not valued:
        return
    objective, lowest = found.objective, found.measure.better == "low"
    figures = {
        "values": values_figure(valued, objective, lowest=lowest),
        "parallel": parallel_figure(valued, list(found.distributions), objective, lowest=lowest),
    }
    if shares:
        figures["importance"] = importance_figure(shares, objective)
    (out / "figures").mkdir(exist_ok=True)
    for name, figure in figures.items():
        with files.whole(out / "figures" / f"{name}.png") as path:
            save(figure, path)


def table(rows: Sequence[Row], found: Plan) -> Table:
    """The best trials, best first, then what failed and why."""
    parameters, ranked = list(found.distributions), sorted(rows, key=partial(_place, found.measure))
    shown = Table(title=f"{len(rows)} trials by {found.objective}")
    shown.add_column("trial", justify="right")
    shown.add_column("value", justify="right")
    for name in parameters:
        shown.add_column(Text(name), justify="right", overflow="fold")
    shown.add_column("state")
    for row in ranked[:_SHOWN]:
        state = f"{row['state']}: {row['reason']}" if row["reason"] else row["state"]
        cells = [str(row["trial"]), _text(row["value"]), *[_text(row[name]) for name in parameters], state]
        shown.add_row(*map(Text, cells))  # no markup: users typed some of it
    if len(ranked) > _SHOWN:
        shown.caption = f"and {len(ranked) - _SHOWN} more in trials.csv"
    return shown


def importance(study: optuna.Study) -> dict[str, float]:
    """Share of each parameter in what sets good trials apart (PED-ANOVA, Watanabe et al. 2023).

    Empty if there are too few trials to tell.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return optuna.importance.get_param_importances(study)
        except (ValueError, RuntimeError, ZeroDivisionError):
            return {}


def values_figure(rows: Sequence[Row], objective: str, *, lowest: bool = False) -> Figure:
    """The value of each trial in the order they began, and the best so far."""
    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axis = figure.subplots()
    for state, marker in (("complete", "o"), ("pruned", "x")):
        some = [row for row in rows if row["state"] == state]
        if some:
            axis.plot([row["trial"] for row in some], [row["value"] for row in some], marker, label=state)
    complete = [row for row in rows if row["state"] == "complete"]
    if complete:
        best = (np.minimum if lowest else np.maximum).accumulate([row["value"] for row in complete])
        axis.step([row["trial"] for row in complete], best, "k-", where="post", linewidth=1, label="best so far")
    axis.set(xlabel="trial", ylabel=objective)
    axis.grid(alpha=0.3)
    axis.legend()
    return figure


def parallel_figure(rows: Sequence[Row], parameters: Sequence[str], objective: str, *, lowest: bool = False) -> Figure:
    """Every trial as a line through its parameters, coloured by its value."""
    values = np.asarray([row["value"] for row in rows], float)
    figure = Figure(figsize=(max(6.4, 2.2 * (len(parameters) + 1)), 4.8), layout="constrained")
    axis = figure.subplots()
    heights = np.stack(
        [*[_draw_scale(axis, x, [row[name] for row in rows]) for x, name in enumerate(parameters)], _unit(values)]
    )
    _draw_ticks(axis, len(parameters), _unit(values), [f"{value:.3g}" for value in values])
    colours = ScalarMappable(norm=Normalize(values.min(), max(values.max(), values.min() + 1e-9)), cmap="viridis")
    for index in np.argsort(-values if lowest else values):  # the best on top
        axis.plot(heights[:, index], color=colours.to_rgba(values[index]), alpha=0.8, linewidth=1.5)
    axis.set(ylim=(-0.05, 1.05), xlim=(-0.3, len(parameters) + 0.5))
    names = [literal(name).replace(".", ".\n") for name in parameters]
    axis.set_xticks(range(len(parameters) + 1), [*names, objective], fontsize="small")
    axis.set_yticks([])
    figure.colorbar(colours, ax=axis, label=objective)
    return figure


def importance_figure(shares: Mapping[str, float], objective: str) -> Figure:
    """A bar for each parameter."""
    names = sorted(shares, key=lambda name: shares[name])
    figure = Figure(figsize=(6.4, 1.2 + 0.5 * len(names)), layout="constrained")
    axis = figure.subplots()
    bars = axis.barh(names, [shares[name] for name in names])
    axis.bar_label(bars, fmt="%.2f", padding=3)
    axis.set(xlabel=f"importance for {objective}", xlim=(0, 1.1))
    return figure


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]) if rows else ["trial"])
        writer.writeheader()
        writer.writerows(rows)


def _place(measure: Measure, row: Row) -> tuple[int, float]:
    """Complete trials by value, then pruned ones, then the rest."""
    order = ("complete", "pruned").index(row["state"]) if row["value"] is not None else 2
    return order, 0.0 if row["value"] is None else -measure.rank(row["value"])


def _draw_scale(axis: Axes, x: int, values: Sequence[Any]) -> np.ndarray:
    """Heights [n] in [0, 1] of a parameter's values, with its ticks at `x`. None is for a value that is not there."""
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    if not numbers:
        kinds = sorted({_text(value) for value in values})
        heights = np.asarray([kinds.index(_text(value)) for value in values]) / max(len(kinds) - 1, 1)
    else:
        array = np.asarray(values, float)
        heights = _unit(np.log(array) if array.min() > 0 and array.max() > 20 * array.min() else array)
    _draw_ticks(axis, x, heights, [_text(value) for value in values])
    return heights


def _draw_ticks(axis: Axes, x: int, heights: np.ndarray, texts: Sequence[str]) -> None:
    """A vertical line with at most seven of the values at their heights, the ends among them."""
    axis.axvline(x, color="0.6", linewidth=1, zorder=0)
    order = np.argsort(heights)
    last = -1.0
    for index in order:
        if heights[index] - last > 0.15 or last < 0:
            axis.annotate(
                literal(texts[index]), (x, heights[index]), (4, 0), textcoords="offset points", fontsize="x-small"
            )
            last = heights[index]


def _unit(values: np.ndarray) -> np.ndarray:
    span = np.ptp(values)
    return (values - values.min()) / span if span else np.full(len(values), 0.5)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
