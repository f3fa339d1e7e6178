"""The report: runs as one HTML page that needs no network and no other file.

    content   what it shows of runs, as plain values: curves thinned and summarised, regions at some moments
    write     star/assets/report.html with its style, its script and these values as JSON in it

All that a user may have named reaches the page as JSON and is drawn as text, never as markup.
"""

from __future__ import annotations

import base64
import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np

from envs import video
from envs.arena import ROBOT
from envs.common import files
from star import evaluation, history, report
from star import program as programs
from star.agent.sections import Config
from star.history import NUMBER, Row, Run

MAX_POINTS = 300  # of a curve
MAX_BOXES = 24_000  # regions of all runs in all frames together
MAX_FILM = 1_500_000  # bytes of a film in the page

_MARK = '<meta name="generator" content="star report">'
_SMALL_FILM = ("--every", "5", "--fps", "10", "--height", "240")  # about 1 MB for an episode of 500 env steps


def write(runs: Mapping[Path, Config], out: Path, *, groups: Mapping[str, Sequence[Path]] | None = None) -> str:
    """Write the report of `runs` (directory: configuration) to `out`; returns a line that says what was written.

    Those of each of the `groups` are shown as one run, before the others. An existing file is replaced.

    Raises:
      UserError: in one line, if a run, a group or `out` cannot be used; nothing is written then.
    """
    programs.select_device("cpu")  # a GPU may be busy with one of the runs
    found = {
        path: history.read(path, config, name=name)
        for (path, config), name in zip(runs.items(), report.labels(list(runs)), strict=True)
    }
    merged = [history.together(name, [found.pop(path) for path in paths]) for name, paths in (groups or {}).items()]
    page = html(content([*merged, *found.values()]))
    with files.whole(out) as partial:
        partial.write_text(page, encoding="utf-8")
    return f"{out}: {len(runs)} run{'s' * (len(runs) > 1)}, {out.stat().st_size / 1e6:.1f} MB; open it in a browser"


def content(runs: Sequence[Run]) -> dict[str, Any]:
    """All that the page shows, as values that JSON can hold."""
    return {
        "made": {"date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", "version": metadata.version("star-rl")},
        "runs": [_shown(run, most=MAX_BOXES // len(runs)) for run in runs],
        "settings": history.differences([history.settings(run) for run in runs]),
    }


def _shown(run: Run, *, most: int) -> dict[str, Any]:
    return {
        "name": run.name,
        "task": run.config.env.name,
        "seeds": run.seeds,
        "facts": facts(run),
        "evaluations": evaluation_curves(run.evaluations, episodes=run.config.trainer.eval_episodes),
        "epochs": epoch_curves(run.epochs),
        "map": growth(run, most=most) if run.regions else None,
        "film": film(run.paths[0]),
        "config": run.config.to_yaml(),
    }


def facts(run: Run) -> dict[str, Any]:
    """How far the run is, how well it does, what it was made with, and how to make it again.

    The shares of success are [mean, low, high] over seeds in the last evaluation, or None before the first.
    """
    last, episodes = run.epochs[-1][0], run.config.trainer.eval_episodes
    regions = _table(run.epochs[-1:], "abstraction/regions")
    best = {name: _table(run.evaluations[-1:], f"eval/{name}") for name in ("success_any", "success_final")}
    return {
        "env_steps": last["env_steps"],
        "total_env_steps": run.stretches[0][-1][1].trainer.total_env_steps,
        "wall_s": last["wall_s"],
        # the first epoch compiles
        "env_steps_per_s": float(np.median(_table(run.epochs[1:] or run.epochs, "env_steps_per_s")[0])),
        "regions": _short(regions.mean(axis=0))[0],
        "path": ", ".join(map(str, run.paths)),
        "engine": history.settings(run)["env.engine"],
        "command": " && ".join(run.again),
        "starts": run.starts,
        "changes": history.changes(run),
    } | {name: _seeds(table, episodes) or None for name, table in best.items()}


def evaluation_curves(epochs: Sequence[Sequence[Row]], *, episodes: int) -> dict[str, Any]:
    """What was measured on test goals, as curves over `env_steps` and `wall_s`, thinned to `MAX_POINTS`.

    Each has the `mean` over seeds, `low` and `high` (95 % interval of that mean, None of one seed), and the `seeds`
    themselves. Shares are those of so many greedy `episodes` of each seed.
    """
    found: dict[str, Any] = _clocks(epochs)
    for key in _numbers(epochs, "eval/"):
        table = _thin(_table(epochs, key))
        shares = episodes if key.startswith("eval/success") else None
        mean, low, high = map(_short, evaluation.over_seeds(table, episodes=shares))
        found[key] = {"mean": mean, "low": low, "high": high, "seeds": [_short(row) for row in table]}
    return found


def epoch_curves(epochs: Sequence[Sequence[Row]]) -> dict[str, list[float | None]]:
    """All other metrics, means over seeds, as curves over `env_steps` and `wall_s`, thinned to `MAX_POINTS`."""
    keys = [
        key
        for key in _numbers(epochs, "")
        if not key.startswith("eval/") and key not in ("seed", "env_steps", "wall_s")
    ]
    return _clocks(epochs) | {key: _short(_thin(_table(epochs, key)).mean(axis=0)) for key in keys}


def _clocks(epochs: Sequence[Sequence[Row]]) -> dict[str, list[float | None]]:
    return {key: _short(_thin(_table(epochs, key)[:1])[0], digits=7) for key in ("env_steps", "wall_s")}


def _numbers(epochs: Sequence[Sequence[Row]], prefix: str) -> list[str]:
    """The keys of the last epoch that begin with `prefix`."""
    return sorted(key for key in (epochs[-1][0] if epochs else ()) if key.startswith(prefix))


def _table(epochs: Sequence[Sequence[Row]], key: str) -> np.ndarray:
    """[seeds, epochs] of a metric; NaN where there is no number."""
    found = [[row.get(key) for row in rows] for rows in epochs]
    values = [[value if isinstance(value, NUMBER) else math.nan for value in row] for row in found]
    return np.asarray(values, float).reshape(-1, len(values[0]) if values else 1).T


def _thin(table: np.ndarray) -> np.ndarray:
    """[n, T] with means of neighbours where T is more than `MAX_POINTS`."""
    if table.shape[1] <= MAX_POINTS:
        return table
    return np.stack([part.mean(axis=1) for part in np.array_split(table, MAX_POINTS, axis=1)], axis=1)


def _seeds(table: np.ndarray, episodes: int) -> list[float | None]:
    """[mean, low, high] of shares [seeds, 1] of so many episodes; without seeds nothing."""
    return _short(np.ravel(evaluation.over_seeds(table, episodes=episodes))) if table.size else []


def _short(values: Any, *, digits: int = 4) -> list[float | None]:
    """Numbers with few digits; None for those that JSON cannot hold."""
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in np.asarray(values, float)]


def growth(run: Run, *, most: int = MAX_BOXES) -> dict[str, Any]:
    """The abstraction of every seed as it grew, over the walls, at as many moments as hold `most` regions together.

    `boxes` are corners [x, y, .., x, y, ..] that `frames` name by index, so that a region that stays takes little
    room. `chosen`, `visited` and `drawn` are shares in %, other tables are as in `regions.jsonl`.
    """
    config = run.config.model_copy(update={"env": run.config.env.model_copy(update={"engine": "auto"})})
    env = programs.make_env(config, "test")
    robots = env.arena.centres(ROBOT)
    boxes: dict[tuple[float | None, ...], int] = {}
    frames: dict[int, list[dict[str, Any]]] = {seed: [] for seed in run.seeds}
    for row in _fewer(run.regions, most):
        if row["seed"] in frames:
            frames[row["seed"]].append(_frame(row, boxes))
    return {
        "axes": ["xyz"[i] if i < 3 else f"state {i}" for i in env.abstract_indices],
        "walls": np.round(env.arena.walls(), 3).tolist(),
        "chasms": np.round(env.arena.chasms(), 3).tolist(),
        "start": robots[0].tolist() if len(robots) == 1 else None,
        "boxes": list(boxes),
        "frames": [{"seed": seed, "moments": moments} for seed, moments in frames.items()],
    }


def _fewer(rows: Sequence[Row], most: int) -> list[Row]:
    """The rows of moments evenly apart, the first and the last among them."""
    steps = sorted({row["env_steps"] for row in rows})
    shown = max(2, int(len(steps) * min(1.0, most / sum(len(row["lower"]) for row in rows))))
    kept = {steps[i] for i in np.linspace(len(steps) - 1, 0, min(shown, len(steps))).round().astype(int)}
    return [row for row in rows if row["env_steps"] in kept]


def _frame(row: Row, boxes: dict[tuple[float | None, ...], int]) -> dict[str, Any]:
    corners = (tuple(_short([*low, *high])) for low, high in zip(row["lower"], row["upper"], strict=True))
    kept = ("env_steps", "goal", "target", "reaches", "misses")
    frame = {key: row[key] for key in kept if key in row}
    frame["box"] = [boxes.setdefault(box, len(boxes)) for box in corners]
    for key in ("chosen", "visited", "drawn"):
        if key in row:
            frame[key] = _short(100 * np.asarray(row[key]) / max(sum(row[key]), 1e-9))
    return frame | {key: _short(row[key]) for key in ("value", "competence") if key in row}


def film(run_dir: Path) -> dict[str, Any]:
    """The newest film in the figures of a run that is small enough, as text or base64, and how to make one."""
    out = str(run_dir / "figures" / "episode.html")
    command = shlex.join(["star", "render", "--run", str(run_dir), "--out", out, *_SMALL_FILM])
    folder = run_dir / "figures"
    found = [path for path in folder.iterdir() if path.suffix in video.FILMS] if folder.is_dir() else []
    newest = sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)
    for path in newest:
        data = path.read_bytes() if path.stat().st_size <= MAX_FILM else b""
        if not data or _MARK.encode() in data[:1000]:
            continue
        whole = data.decode(errors="replace") if path.suffix == ".html" else base64.b64encode(data).decode()
        return {"name": path.name, "kind": path.suffix[1:], "data": whole}
    large = [path.name for path in newest if path.stat().st_size > MAX_FILM]
    return {"command": command, "large": large}


def html(shown: Mapping[str, Any]) -> str:
    """The page, with style, script and `shown` in it."""
    assets = resources.files("star").joinpath("assets")
    parts = {ending: assets.joinpath(f"report.{ending}").read_text(encoding="utf-8") for ending in ("css", "js")}
    # no text can end the element that holds it
    parts["json"] = json.dumps(shown, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    page = assets.joinpath("report.html").read_text(encoding="utf-8")
    return re.sub(r"%(css|js|json)%", lambda found: parts[found[1]], page)  # once: data may hold such words too
