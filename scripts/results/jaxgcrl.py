"""The part of docs/results.md on JaxGCRL's mazes: env steps at the goal of all agents, from results/jaxgcrl/.

The rows are tested with test goals and with training goals: scripts/results/reproduce.py ... --goals test train.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from scripts.pages import charts
from scripts.results.rows import Row, evaluations
from star.report import statistics

MAZES = {"big maze": "jaxgcrl/ant_big_maze", "hardest maze": "jaxgcrl/ant_hardest_maze"}
AGENTS = {"STAR": "one_by_one/star", "STAR, frugal": "frugal", "CRL": "crl", "ChronoSRL": "chronosrl"}
STEPS = 1000  # env steps of an episode


def paths(rows: Mapping[str, Row]) -> list[str]:
    """The rows that are there."""
    wanted = (f"{folder}/{name}" for folder in MAZES.values() for name in AGENTS.values())
    return [path for path in wanted if path in rows]


def section(rows: Mapping[str, Row]) -> str:
    """The part of the page; nothing where nothing has been measured."""
    if not paths(rows):
        return ""
    return f"""## JaxGCRL's mazes

![Env steps at the goal of STAR, CRL and ChronoSRL in JaxGCRL's mazes](images/results_jaxgcrl.png)

| maze, agent | M env steps | training, s | at the goal | test goals | way, m | m/s | at most |
|---|---|---|---|---|---|---|---|
{chr(10).join(_lines(rows))}

* *at the goal*: env steps within .5 m of training goals, of {STEPS:,}. *test goals*: the same of the goals that
  JaxGCRL evaluates with.
* *way*, *m/s*: until the first arrival. *at most*: the same if all arrived, and stayed.
* The ant is that of [its published figures](environments.md#jaxgcrls-ant). Curves are of test goals.

"""


def _lines(rows: Mapping[str, Row]) -> Iterator[str]:
    for maze, folder in MAZES.items():
        for agent, name in AGENTS.items():
            if row := rows.get(f"{folder}/{name}"):
                yield f"| {maze}, {agent}{row.mark} | {' | '.join(_told(row))} |"


def _told(row: Row) -> list[str]:
    """Budget, seconds, env steps at training and test goals, way, speed, and the most there is to have."""
    seeds, steps = row.report["seeds"], row.report["env_steps_per_seed"]
    trained = [seed["train"] for seed in seeds]
    seconds = [len(run["seeds"]) * steps / run["env_steps_per_s"] for run in row.report["runs"]]
    reached = [seed for seed in trained if seed["steps_to_goal"] is not None]
    told = [f"{steps / 1e6:.1f}", f"{np.median(seconds):.0f}", _mean(trained), _mean(seeds)]
    if not reached:
        return [*told, "", "", ""]
    way, first = (np.mean([seed[key] for seed in reached]) for key in ("path_length", "steps_to_goal"))
    speed = np.mean([seed["path_length"] / seed["seconds_to_goal"] for seed in reached])
    return [*told, f"{way:.0f}", f"{speed:.1f}", f"{STEPS - first:.0f}"]


def _mean(seeds: list) -> str:
    """Mean and 95 % interval over seeds of the env steps at the goal."""
    mean, low, high = statistics.over_seeds(np.asarray([seed["time_at_goal"] for seed in seeds]))
    return f"**{mean:.0f}**" if len(seeds) < 2 else f"**{mean:.0f}** [{max(low, 0):.0f}, {min(high, STEPS):.0f}]"


def curves(results: Path) -> Figure:
    """Env steps at the goal over env steps and over seconds, in each maze: mean and range of the seeds."""
    figure = Figure(figsize=(8.2, 4.4), layout="constrained")
    axes = figure.subplots(len(MAZES), 2, sharey=True)
    for pair, (maze, folder) in zip(axes, MAZES.items(), strict=True):
        for number, (agent, name) in enumerate(AGENTS.items()):
            points = evaluations(results / folder / name)
            for axis, over in zip(pair, ("env_steps", "wall_s"), strict=True):
                charts.band(axis, points, "eval/time_at_goal", over=over, color=f"C{number}", label=agent)
        pair[0].set(title=maze, ylabel="env steps at the goal", ylim=(0, STEPS))
    axes[-1, 0].set_xlabel("million env steps of each seed")
    axes[-1, 1].set_xlabel("seconds, with compilation and evaluations")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right center")
    return figure
