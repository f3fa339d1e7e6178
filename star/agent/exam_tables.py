"""Evaluations as tables for people."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from star.agent.episodes import MEASURES
from star.config import command_line
from star.report.statistics import ABOVE

_PLAIN_WIDTH = 200  # columns where nobody looks at a terminal
_SHOWN = 3  # failed episodes named in a table

Row = Mapping[str, Any]


def show(rows: Sequence[Row], comparison: Mapping[str, Any] | None, *, again: Sequence[str]) -> None:
    """Print the rows of `star.agent.exams.evaluate`, a line for each seed, and what `compare` found.

    `again` are the arguments that tell `star render` of which evaluation an episode is.
    """
    console = Console(width=None if sys.stdout.isatty() else _PLAIN_WIDTH, highlight=False)
    console.print(evaluations(rows))
    for line in remarks(rows):
        print(line)
    failing = next(((row, seed) for row in rows for seed in row["seeds"] if seed["failed"] and row["film"]), None)
    if failing:
        row, seed = failing
        words = ["--run", row["run"], "--checkpoint", row["env_steps"]]
        words += ["--seed", seed["seed"], "--episode", seed["failed"][0]]
        print("watch a failure:", command_line.of("render", *words, *again, "--out", "failure.html"))
    if comparison:
        console.print(groups(comparison["groups"]))
        if comparison["improvement"]:
            console.print(improvements(comparison["improvement"]))


def evaluations(rows: Sequence[Row]) -> Table:
    """A line for each seed of each checkpoint, and one for all seeds where there are several."""
    table = Table(title=_title(rows), box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)
    about = _telling(rows)
    counted = ["episodes"] if _episodes(rows) is None else []
    for name in about:
        table.add_column(name, overflow="fold")
    measured = ("s to\ngoal", "m to\ngoal", "SPL", "stayed", "end\ndistance")
    for name in ("env steps", "seed", *counted, *MEASURES, *measured):
        table.add_column(name, justify="right")
    for row in rows:
        begin: list[Text | str] = [*(Text(row[name]) for name in about), f"{row['env_steps']:,}"]
        for seed in row["seeds"]:
            table.add_row(*begin, str(seed["seed"]), *(str(seed[name]) for name in counted), *_cells(seed))
        if len(row["seeds"]) > 1:
            over = {f"{name}_interval": row[f"{name}_seeds_interval"] for name in MEASURES}
            table.add_row(*begin, "all", *(str(row[name]) for name in counted), *_cells({**row, **over}))
    return table


def remarks(rows: Sequence[Row]) -> list[str]:
    """Lines below the table: the episodes in which each seed failed, and how many seeds have learnt the task."""
    about = [*_telling(rows), *(["env_steps"] if len({row["env_steps"] for row in rows}) > 1 else [])]
    lines = []
    for row in rows:
        words = [f"{row[name]:,} env steps" if name == "env_steps" else str(row[name]) for name in about]
        for seed in row["seeds"]:
            if seed["failed"]:
                first = ", ".join(map(str, seed["failed"][:_SHOWN])) + ", ..." * (len(seed["failed"]) > _SHOWN)
                who = ", ".join([*words, f"seed {seed['seed']}"])
                lines.append(f"{who}: fails in episodes {first} ({_why(seed)})")
        if len(row["seeds"]) > 1:
            learnt = ", ".join(f"{name} {_above(row[f'{name}_above'])}" for name in MEASURES)
            lines.append(f"{', '.join([*words, f'seeds above {ABOVE:g}'])}: {learnt}")
    return lines


def _telling(rows: Sequence[Row]) -> list[str]:
    """The keys that tell the rows apart, but for their env steps."""
    return [name for name in ("run", "env") if len({row[name] for row in rows}) > 1]


def groups(found: Sequence[Row]) -> Table:
    """Means of groups of runs, and how many of their seeds have learnt the task."""
    table = Table(box=box.SIMPLE_HEAD, title="mean over seeds and tasks, 95 % intervals")
    if any(group["success_any"]["mean_interval"] is None for group in found):
        table.caption = "one seed of a task has no interval"
    for name in ("group", "runs", "seeds", *MEASURES, *(f"{name} above {ABOVE:g}" for name in MEASURES)):
        table.add_column(name, justify="left" if name == "group" else "right")
    for group in found:
        seeds = sum(len(scores) for scores in group["success_any"]["scores"].values())
        measured = [_interval(group[name]["mean"], group[name]["mean_interval"]) for name in MEASURES]
        learnt = [_above(group[name]["above"]) for name in MEASURES]
        table.add_row(Text(group["name"]), str(len(group["runs"])), str(seeds), *measured, *learnt)
    return table


def improvements(found: Sequence[Row]) -> Table:
    """Differences between groups; each pair once, in the order of the groups."""
    table = Table(box=box.SIMPLE_HEAD, title="difference of means A - B, 95 % intervals (Welch), and P(A > B) of seeds")
    if any(pair["success_any"] is None for pair in found):
        table.caption = "-: no task in common"
    table.add_column("A")
    table.add_column("B")
    for name in MEASURES:
        table.add_column(name, justify="right")
        table.add_column("P", justify="right")
    seen: set[frozenset[str]] = set()
    for pair in found:
        both = frozenset((pair["better"], pair["than"]))
        if both in seen:
            continue
        seen.add(both)
        measured = []
        for name in MEASURES:
            measured += [
                _interval(pair[f"{name}_difference"], pair[f"{name}_difference_interval"]),
                "-" if pair[name] is None else f"{pair[name]:.2f}",
            ]
        table.add_row(Text(pair["better"]), Text(pair["than"]), *measured)
    return table


def _title(rows: Sequence[Row]) -> str:
    kind, _, side = rows[0]["goals"].partition(" ")
    goals = f"goals on a grid of {side} x {side}" if side else {"test": "test goals", "train": "training goals"}[kind]
    tasks = dict.fromkeys(f"{row['env']} ({row['engine']})" for row in rows)
    episodes = _episodes(rows)
    told = "" if episodes is None else f"{episodes:,} episodes a seed, "
    return f"{', '.join(tasks)}: {goals}, {told}95 % intervals"


def _episodes(rows: Sequence[Row]) -> int | None:
    """The number of episodes of each seed; None if seeds differ in it."""
    found = {seed["episodes"] for row in rows for seed in row["seeds"]}
    return found.pop() if len(found) == 1 else None


def _cells(row: Row) -> list[str]:
    success = [_interval(row[name], row[f"{name}_interval"]) for name in MEASURES]
    means = (("seconds_to_goal", ".1f"), ("path_length", ".1f"), ("spl", ".2f"), ("stayed", ".2f"), ("distance", ".2f"))
    return [*success, *("-" if row[name] is None else format(row[name], f) for name, f in means)]


def _why(row: Row) -> str:
    """`3 flipped, 1 stuck`."""
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in row["failures"].items() if count)


def _above(found: Row) -> str:
    """`4 of 5 [0.28, 0.99]`."""
    low, high = found["interval"]
    return escape(f"{found['seeds']} of {found['of']} [{low:.2f}, {high:.2f}]")


def _interval(value: float | None, interval: Sequence[float] | None) -> str:
    """`value [low, high]` of a share, without an interval where there is none, or a dash."""
    if value is None:
        return "-"
    if interval is None:
        return f"{value:.3f}"
    low, high = interval
    return escape(f"{value:.3f} [{low:.3f}, {high:.3f}]")
