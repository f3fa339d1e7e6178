"""Results of evaluations: groups of runs compared, and rows and figures written into a folder.

compare   groups of runs, by the last checkpoint of each that was evaluated
write     the rows and figures, into a folder
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.common import files
from star.agent import exam_figures
from star.agent.episodes import MEASURES
from star.agent.sections import Config
from star.config import agents
from star.config.section import ConfigError
from star.report import statistics
from star.report.history import labels

ROWS = "evaluation.jsonl"
FIGURES = ("goals-*.png", "curve.png", "profile.png")


def compare(rows: Sequence[Mapping[str, Any]], groups: Mapping[str, Sequence[Path]]) -> dict[str, Any]:
    """Means, interquartile means, performance profiles and differences of groups of runs.

    A run counts with the last of its checkpoints in `rows`, a score is the success of one seed, and runs are compared
    on one task, which is an environment with its options. Where there are too few seeds for an interval it is None.
    """
    last: dict[str, Mapping[str, Any]] = {}
    for row in sorted(rows, key=lambda row: row["env_steps"]):
        last[row["run"]] = row
    found: dict[str, Any] = {"groups": [], "improvement": []}
    scores: dict[str, dict[str, dict[str, list[float]]]] = {}
    episodes = min((seed["episodes"] for row in last.values() for seed in row["seeds"]), default=None)
    for name, runs in groups.items():
        scores[name] = {measure: _scores([last[agents.told(run)] for run in runs], measure) for measure in MEASURES}
        entry: dict[str, Any] = {"name": name, "runs": [agents.told(run) for run in runs]}
        for measure, tasks in scores[name].items():
            every = np.concatenate(list(tasks.values()))
            mean, *interval = statistics.over_tasks(tasks, episodes=episodes)
            middle, *around = statistics.pooled(tasks, statistics.interquartile_mean)
            share, below, above = statistics.profile(every)
            entry[measure] = {
                "scores": tasks,
                "mean": mean,
                "mean_interval": _known(interval),
                "interquartile_mean": float(middle),
                "interquartile_mean_interval": _known(around),
                "above": statistics.above(every),
                "profile": np.round(share, 4).tolist(),
                "profile_interval": np.round([below, above], 4).tolist(),
            }
        found["groups"].append(entry)
    for better in groups:
        for than in groups:
            if better != than:
                pair: dict[str, Any] = {"better": better, "than": than}
                for measure in MEASURES:
                    one, other = scores[better][measure], scores[than][measure]
                    apart = statistics.difference(one, other, episodes=episodes)
                    pair |= {
                        measure: statistics.improvement(one, other),
                        f"{measure}_difference": apart and apart[0],
                        f"{measure}_difference_interval": apart and _known(apart[1:]),
                    }
                found["improvement"].append(pair)
    return found


def _known(interval: Sequence[float]) -> list[float] | None:
    """`interval`, or None where it is NaN: one seed tells nothing of how seeds differ."""
    return None if np.isnan(interval).any() else [float(end) for end in interval]


def _scores(rows: Sequence[Mapping[str, Any]], measure: str) -> dict[str, list[float]]:
    """For each task the scores of all seeds."""
    found: dict[str, list[float]] = {}
    for row in rows:
        found.setdefault(_task(row["env"], row["options"]), []).extend(seed[measure] for seed in row["seeds"])
    return found


def _task(env: str, options: Mapping[str, Any]) -> str:
    """An environment with its options in one spelling: 4 instead of 4.0, no empty lines around a map."""

    def spelt(value: Any) -> Any:
        if isinstance(value, str):
            return "\n".join(line.rstrip() for line in value.strip().splitlines())
        return int(value) if isinstance(value, float) and value.is_integer() else value

    plain = {key: spelt(value) for key, value in options.items()}
    return " ".join([env, *([json.dumps(plain, sort_keys=True)] if plain else [])])


def check_groups(groups: Mapping[str, Sequence[Path]], configs: Mapping[Path, Config]) -> None:
    """Raise `UserError` if a group holds a seed of a task twice: it would count as two."""
    for name, runs in groups.items():
        seen: dict[tuple[str, int], Path] = {}
        for run in runs:
            env, settings = configs[run].env, configs[run].trainer
            task = _task(env.name, env.options)
            for seed in range(settings.seed, settings.seed + settings.num_seeds):
                other = seen.setdefault((task, seed), run)
                if other != run:
                    both = " and in ".join(map(agents.told, (other, run)))
                    raise ConfigError(f"--group: {name}: seed {seed} is in {both}; allowed: once")


def check_place(out: Path, *, force: bool) -> None:
    """Raise `UserError` if `write` could not write into the folder `out`, or would replace something there."""
    files.check_name(out)
    above = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not above.is_dir():
        raise ConfigError(f"--out: {above} is a file, not a folder")
    if not os.access(above, os.W_OK):
        raise ConfigError(f"--out: {out}: the folder {above} is not writable")
    if (out / ROWS).exists() and not force:
        raise ConfigError(f"{out / ROWS}: exists; replace it with --force, or choose another folder with --out")


def write(out: Path, rows: Sequence[Mapping[str, Any]], comparison: Mapping[str, Any] | None) -> list[Path]:
    """Write `evaluation.jsonl` and the figures that the rows allow into `out`; returns the paths of all.

    What an earlier evaluation left there is replaced.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in [path for pattern in (ROWS, *FIGURES) for path in out.glob(pattern)]:
            old.unlink()
        lines = [*rows, *([comparison] if comparison else [])]
        (out / ROWS).write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
        return [out / ROWS, *_figures(out, rows, comparison)]
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror or error}") from None


def _figures(out: Path, rows: Sequence[Mapping[str, Any]], comparison: Mapping[str, Any] | None) -> Iterator[Path]:
    runs: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row)
    names = dict(zip(runs, labels([Path(run) for run in runs]), strict=True))
    for run, own in runs.items():
        if "per_goal" in own[0]:
            path = out / f"goals-{names[run].replace('/', '-')}.png"
            exam_figures.goals_figure(path, rows=own)
            yield path
    if any(len(own) > 1 for own in runs.values()):
        exam_figures.checkpoints_figure(out / "curve.png", runs={names[run]: own for run, own in runs.items()})
        yield out / "curve.png"
    if comparison:
        exam_figures.profile_figure(out / "profile.png", groups=comparison["groups"], taus=statistics.TAUS)
        yield out / "profile.png"
