"""Train CHIME in its room, beside a learner whose tasks are given and beside random actions, and look at the claims.

    python scripts/results/chime.py [NAME ...] [--seeds 20] [--total 12000] [--runs DIR] [--out DIR] [--docs]
                                    [--add FILE ...]

NAME is room, given or random, a config of configs/chime; by default all. Each is one run of `star train` with its seeds
side by side. A run that is done is not made again, and one that was interrupted goes on, so empty `--runs` when code or
configs have changed. Into `--out`, results/chime by default, go

    room.json    of every learner the tests of each seed at each evaluation, first births, what was practised, how long
                 it took; command, commit, device and versions; and every claim with its numbers
    room.md      the table of tests, and that of the claims: 95 % bootstrap intervals over seeds
    room_*.png   figures of the run of CHIME

and with `--docs` the pictures of docs/chime.md. `--add` takes over what other machines have measured, the learners of
each FILE, a room.json of theirs; without a NAME none is trained then.

A claim that something is better holds if the interval of the difference lies on that side of 0; one that names a
number, if the mean does.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from scripts.pages import charts
from scripts.results.claims import Claim, less, mean, ratio, shown, told
from scripts.results.saht import ROOT, STAR
from star.config.loading import load_run
from star.saht.chime.experiment import Chime
from star.saht.chime.figures import FIRSTS, firsts, kind
from star.training.figures import save
from star.training.journal import Journal, by_step

NAMES = ("room", "given", "random")
KINDS = ("position", "wall", "push")
FIGURES = ("births", "competence", "hierarchy", "curriculum")
TIMED = 5000  # actions for which at most so many seconds were wanted
MOST_SECONDS = 1200


def trained(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Measurements of a run, which is made or goes on if need be."""
    run = options.runs / name
    words = [f"chime/{name}", "--seeds", str(options.seeds), "--total-env-steps", str(options.total)]
    rows = Journal.of(run, tables="models").metrics.read() if run.exists() else []
    if not rows or rows[-1]["env_steps"] < options.total or "eval/distance" not in rows[-1]:
        goes_on = (run / "config.yaml").exists()
        how = ["--resume", str(run)] if goes_on else [*words, "--run-dir", str(run)]
        subprocess.run([sys.executable, *STAR[1:], "train", *how, "--quiet"], cwd=ROOT, check=True)
    return {"command": shlex.join(["star", "train", *words])} | read(run)


def read(run: Path) -> dict[str, Any]:
    """Of a run: tests of each seed, first births, practice by fifths of the time, models at the end, and provenance."""
    journal = Journal.of(run, tables="models")
    rows, tables, starts = journal.metrics.read(), journal.tables.read(), journal.provenance.read()
    epochs = by_step(rows)
    evaluated = [now for now in epochs if "eval/distance" in now[0]]
    discs = sorted(key.removeprefix("chime/practice_") for key in rows[-1] if key.startswith("chime/practice_"))
    fifths = [range(len(epochs) * i // 5, len(epochs) * (i + 1) // 5) for i in range(5)]
    last = [row for row in tables if row["env_steps"] == rows[-1]["env_steps"]]
    return {
        "seeds": [row["seed"] for row in epochs[0]],
        "actions": rows[-1]["env_steps"],
        "wall_s": rows[-1]["wall_s"],
        "timed_s": next((row["wall_s"] for row in rows if row["env_steps"] >= TIMED), None),
        **{key: starts[-1][key] for key in ("commit", "device", "python", "versions") if key in starts[-1]},
        "steps": [now[0]["env_steps"] for now in evaluated],
        "tests": {
            f"{what}_{kind}": [[round(row[f"eval/{what}_{kind}"], 4) for row in now] for now in evaluated]
            for what in ("distance", "success")
            for kind in KINDS
        },
        "practice": {
            disc: [
                np.mean([[row[f"chime/practice_{disc}"] for row in epochs[i]] for i in part], axis=0).round(4).tolist()
                for part in fifths
            ]
            for disc in discs
        },
        "births": [row["births"] for row in last],
        "models": [row["models"] for row in last],
    }


def claims(found: Mapping[str, Any]) -> list[Claim]:
    """Row k of docs/chime.md, as far as its learners are there."""
    made: list[Claim] = []
    if "room" not in found:
        return made
    room = found["room"]
    names = list(FIRSTS)
    whole = [firsts(births) for births in room["births"]]
    soon = [firsts([pair for pair in births if pair[-1] <= TIMED]) for births in room["births"]]

    def in_order(first: Mapping[str, int], count: int) -> float:
        times = [first.get(name, np.inf) for name in names[:count]]
        return float(np.isfinite(times).all() and bool((np.diff(times) > 0).all()))

    for row, order, count, text in (
        ("ours", whole, 2, "share of learners with births in order: robot, object"),
        ("k", whole, 3, "share of learners with births in order: robot, object, object by object"),
        ("ours", soon, 3, f"the same within {TIMED:,} actions"),
    ):
        share = np.array([in_order(first, count) for first in order])
        made.append(mean(row, text, share, ">= .8", lambda x: x >= 0.8))
    last = [{kind(model["outcome"], model["control"]) for model in models if model["on"]} for models in room["models"]]
    text = f"share of learners whose model of an {names[-1]} is on in the end"
    made.append(mean("ours", text, np.array([float(names[-1] in one) for one in last]), ">= .8", lambda x: x >= 0.8))
    practice = np.asarray(room["practice"]["robot"])
    made.append(less("ours", "share of the robot in practice, last fifth - first", practice[-1], practice[0]))
    tests = {name: {key: np.asarray(value[-1]) for key, value in one["tests"].items()} for name, one in found.items()}
    if "random" in found:
        both = [tests[name]["distance_position"] for name in ("room", "random")]
        made.append(ratio("k", "positions: CHIME / random actions", *both, "<= .5", lambda x: x <= 0.5))
        for test in ("wall", "push"):
            both = [tests[name][f"distance_{test}"] for name in ("room", "random")]
            made.append(less("ours", f"{test}: CHIME - random actions", *both))
    if room["timed_s"] is not None:
        text, seconds = f"seconds of {len(whole)} learners for {TIMED:,} actions", np.array([room["timed_s"]])
        made.append(mean("time", text, seconds, f"<= {MOST_SECONDS}", lambda x: x <= MOST_SECONDS))
    return made


def table(found: Mapping[str, Any], made: list[Claim]) -> str:
    """Both tables, in Markdown."""
    columns = [f"{what}_{kind}" for kind in KINDS for what in ("distance", "success")]
    lines = [f"| learner | {' | '.join(columns).replace('_', ' ')} | seconds |", "|---" * (len(columns) + 2) + "|"]
    for name, one in found.items():
        cells = []
        for column in columns:
            cells.append(shown(np.asarray(one["tests"][column][-1]), digits=2 if column.startswith("success") else 1))
        lines.append(f"| {name} | {' | '.join(cells)} | {one['wall_s']:.0f} |")
    return "\n".join([*lines, "", *told(made)]) + "\n"


def write(place: Path, found: Mapping[str, Any]) -> None:
    """The record of all learners, and beside it their tables."""
    found = {name: found[name] for name in NAMES if name in found}
    made = claims(found)
    place.write_text(json.dumps({"claims": [one._asdict() for one in made], "learners": found}) + "\n", "utf-8")
    place.with_suffix(".md").write_text(table(found, made), encoding="utf-8")


def draw(run: Path, options: argparse.Namespace) -> None:
    """The figures of the run of CHIME."""
    journal = Journal.of(run, tables="models")
    drawn = Chime(load_run(run, {})).figures(journal.metrics.read(), journal.tables.read())
    for figure in FIGURES:
        if figure in drawn:
            save(drawn[figure], options.out / f"room_{figure}.png")
            if options.docs:
                charts.save(drawn[figure], f"chime_{figure}", dpi=80)


def main(arguments: list[str] | None = None) -> None:
    """Fill the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--total", type=int, default=12_000, help="actions of each seed (default: 12,000)")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "chime")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "chime")
    parser.add_argument("--docs", action="store_true", help="draw the pictures of docs/chime.md")
    parser.add_argument("--add", type=Path, nargs="+", default=[], metavar="FILE", help="take these learners over")
    options = parser.parse_args(arguments)
    options.runs = options.runs.resolve()
    for name in options.names:
        if name not in NAMES:
            raise SystemExit(f"error: {name}: no such learner; known are {', '.join(NAMES)}")
    options.out.mkdir(parents=True, exist_ok=True)
    place = options.out / "room.json"
    found: dict[str, Any] = {}
    for file in [*[place] * place.exists(), *options.add]:
        found |= json.loads(file.read_text(encoding="utf-8"))["learners"]
    write(place, found)
    for name in options.names or NAMES * (not options.add):
        found[name] = trained(name, options)
        write(place, found)
        if name == "room":
            draw(options.runs / name, options)
    print(place.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
