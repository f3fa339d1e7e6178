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
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import numpy as np

from envs.common import files
from star.config import command_line, kinds
from star.config.kinds import Measure
from star.config.run import RunConfig
from star.report import history, statistics
from star.report.history import NUMBER, Row, Run
from star.training import program as programs

MAX_POINTS = 300  # of a curve
MAX_BOXES = 24_000  # regions of all runs in all frames together
MAX_FILM = 1_500_000  # bytes of a film in the page

_FILMS = (".mp4", ".gif", ".html")
_MARK = '<meta name="generator" content="star report">'
SMALL_FILM = ("--every", "5", "--fps", "10", "--height", "240")  # about 1 MB for an episode of 500 env steps


def write(runs: Mapping[Path, RunConfig], out: Path, *, groups: Mapping[str, Sequence[Path]] | None = None) -> str:
    """Write the report of `runs` (directory: configuration) to `out`; returns a line that says what was written.

    Those of each of the `groups` are shown as one run, before the others. An existing file is replaced.

    Raises:
      UserError: in one line, if a run, a group or `out` cannot be used; nothing is written then.
    """
    programs.select_device("cpu")  # a GPU may be busy with one of the runs
    found = {
        path: history.read(path, config, name=name)
        for (path, config), name in zip(runs.items(), history.labels(list(runs)), strict=True)
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
    kind = kinds.of(run.config)
    return {
        "name": run.name,
        "task": kind.title(run.config),
        "unit": kind.unit,
        "measures": [
            {"key": m.key, "label": m.label or m.name, "where": m.where, "share": m.episodes is not None}
            for m in kind.measures
        ],
        "seeds": run.seeds,
        "facts": facts(run),
        "evaluations": evaluation_curves(run.evaluations, kind.measures, run.config),
        "epochs": epoch_curves(run.epochs),
        "map": _map(run, most),
        "film": film(run.paths[0]),
        "pictures": pictures(run.paths[0], kind.pictures),
        "config": run.config.to_yaml(),
    }


def _map(run: Run, most: int) -> dict[str, Any] | None:
    """The drawing of its tables, if its kind of experiment has one."""
    draw = kinds.of(run.config).commands.get("map")
    return draw(run.config, run.tables, run.seeds, most=most) if draw and run.tables else None


def facts(run: Run) -> dict[str, Any]:
    """Progress and success of the run, its provenance, and the command to make it again.

    `measured` has [mean, low, high] over seeds of each measure in the last evaluation, or None before the first.
    """
    last = run.epochs[-1][0]
    regions = _table(run.epochs[-1:], "abstraction/regions")
    measured = {
        measure.key: _seeds(_table(run.evaluations[-1:], measure.key), _episodes(measure, run.config)) or None
        for measure in kinds.of(run.config).measures
    }
    return {
        "env_steps": last["env_steps"],
        "total_env_steps": run.stretches[0][-1][1].trainer.total_env_steps,
        "wall_s": last["wall_s"],
        # the first epoch compiles
        "env_steps_per_s": float(np.median(_table(run.epochs[1:] or run.epochs, "env_steps_per_s")[0])),
        "regions": short(regions.mean(axis=0))[0],
        "path": ", ".join(map(str, run.paths)),
        "engine": history.settings(run).get("env.engine"),
        "command": " && ".join(run.again),
        "starts": run.starts,
        "changes": history.changes(run),
        "measured": measured,
        "notices": notices(run),
    }


def notices(run: Run) -> list[str]:
    """Notices about each seed."""
    lines = kinds.of(run.config).notices.lines
    found = {seed: lines([row for rows in run.epochs for row in rows if row["seed"] == seed]) for seed in run.seeds}
    return [f"seed {seed}: {line}" for seed, of_seed in found.items() for line in of_seed.values()]


def _episodes(measure: Measure, config: RunConfig) -> int | None:
    """Of how many episodes a measure is a share, if it is one."""
    return measure.episodes(config) if measure.episodes else None


def evaluation_curves(
    epochs: Sequence[Sequence[Row]], measures: Sequence[Measure], config: RunConfig
) -> dict[str, Any]:
    """Results of evaluations, as curves over `env_steps` and `wall_s`, thinned to `MAX_POINTS`.

    Each has the `mean` over seeds, `low` and `high` (95 % interval of that mean, None of one seed), and the `seeds`
    themselves.
    """
    shares = {measure.key: _episodes(measure, config) for measure in measures}
    found: dict[str, Any] = _clocks(epochs)
    for key in _numbers(epochs, "eval/"):
        table = _thin(_table(epochs, key))
        mean, low, high = map(short, statistics.over_seeds(table, episodes=shares.get(key)))
        found[key] = {"mean": mean, "low": low, "high": high, "seeds": [short(row) for row in table]}
    return found


def epoch_curves(epochs: Sequence[Sequence[Row]]) -> dict[str, list[float | None]]:
    """All other metrics, means over seeds, as curves over `env_steps` and `wall_s`, thinned to `MAX_POINTS`."""
    keys = [
        key
        for key in _numbers(epochs, "")
        if not key.startswith("eval/") and key not in ("seed", "env_steps", "wall_s")
    ]
    return _clocks(epochs) | {key: short(_thin(_table(epochs, key)).mean(axis=0)) for key in keys}


def _clocks(epochs: Sequence[Sequence[Row]]) -> dict[str, list[float | None]]:
    return {key: short(_thin(_table(epochs, key)[:1])[0], digits=7) for key in ("env_steps", "wall_s")}


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


def _seeds(table: np.ndarray, episodes: int | None) -> list[float | None]:
    """[mean, low, high] of a measure [seeds, 1], perhaps a share of so many episodes; without seeds nothing."""
    return short(np.ravel(statistics.over_seeds(table, episodes=episodes))) if table.size else []


def short(values: Any, *, digits: int = 4) -> list[float | None]:
    """Numbers with few digits; None for those that JSON cannot hold."""
    return [float(f"{v:.{digits}g}") if math.isfinite(v) else None for v in np.asarray(values, float)]


def film(run_dir: Path) -> dict[str, Any]:
    """The newest film in the figures of a run that is small enough, as text or base64, and how to make one."""
    out = str(run_dir / "figures" / "episode.html")
    command = command_line.of("render", "--run", run_dir, "--out", out, *SMALL_FILM)
    folder = run_dir / "figures"
    found = [path for path in folder.iterdir() if path.suffix in _FILMS] if folder.is_dir() else []
    newest = sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)
    for path in newest:
        data = path.read_bytes() if path.stat().st_size <= MAX_FILM else b""
        if not data or _MARK.encode() in data[:1000]:
            continue
        whole = data.decode(errors="replace") if path.suffix == ".html" else base64.b64encode(data).decode()
        return {"name": path.name, "kind": path.suffix[1:], "data": whole}
    large = [path.name for path in newest if path.stat().st_size > MAX_FILM]
    return {"command": command, "large": large}


def pictures(run_dir: Path, names: Sequence[str]) -> list[dict[str, str]]:
    """The figures of a run that its kind wants shown, as far as they are there and small enough: name and base64."""
    paths = [run_dir / "figures" / f"{name}.png" for name in names]
    there = [path for path in paths if path.is_file() and path.stat().st_size <= MAX_FILM]
    return [{"name": path.stem, "data": base64.b64encode(path.read_bytes()).decode()} for path in there]


def html(shown: Mapping[str, Any]) -> str:
    """The page, with style, script and `shown` in it."""
    assets = resources.files("star").joinpath("assets")
    parts = {ending: assets.joinpath(f"report.{ending}").read_text(encoding="utf-8") for ending in ("css", "js")}
    # no text can end the element that holds it
    parts["json"] = json.dumps(shown, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts["connect"] = "self" if shown.get("watched") else "none"  # only a page that is served asks for more
    page = assets.joinpath("report.html").read_text(encoding="utf-8")
    return re.sub(r"%(css|js|json|connect)%", lambda found: parts[found[1]], page)  # once: data may hold such words too
