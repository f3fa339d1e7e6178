"""Train and evaluate the agents of a results table, and draw their curves.

    python scripts/results/reproduce.py TASK [NAME ...] [--seed 0] [--seeds 5] [--level 0.9] [--one-by-one]
                                         [--goals test train] [--out FOLDER] [-- SETTINGS]
    python scripts/results/reproduce.py ROW [ROW ...] [--runs FOLDER] [--commit NAME]

A ROW is a file of results/ without its ending, such as ant_fall/gara: it is measured anew as its JSON says, with the
same settings and seeds.

TASK is a file of configs/ without its ending. A NAME is `star`, or a file of configs/agents, configs/ablations,
configs/sgim or configs/paper laid over it, or several of these, as hiro+td3_tutor; by default all agents. SETTINGS are
passed on to `star train`. For each name the seeds are trained side by side in one program, or with --one-by-one one
after another, which is how wall-clock times to a success are meant to be taken. Into results/TASK, or
results/TASK/one_by_one, go

    NAME.json     every seed's success on `--episodes` greedy episodes on test goals, and apart on other `--goals`; env
                  steps to success_any `--level` (null: never), seconds of training to it, and seconds since the start
                  of the run, with compilation and evaluations; of every program its seeds, command, commit, device,
                  versions and learning digest (scripts/results/digest.py)
    curves.jsonl  all evaluations during training
    curves.png    success_any over env steps and over wall-clock: mean over seeds, and their range if there are at most
                  five agents; where teachers may be asked also the share of episodes in which they are
    table.md      means over seeds with 95 % intervals, how many seeds have learnt the task, and each seed

Seeds that a JSON already holds with today's digest are not trained again; one of an older version is begun anew. Runs
are kept under `--runs`, those with other SETTINGS or digests apart, and one that was interrupted goes on. So the same
command ends what a lost machine began. `python scripts/results/page.py` then makes docs/results.md.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scripts.results import digest
from star.agent.episodes import MEASURES
from star.report.statistics import above, over_seeds
from star.training.journal import Journal, JsonLines

ROOT = Path(__file__).parents[2]
LAYERS = ("agents", "ablations", "sgim", "paper")
AGENTS = ("star", "hiro", "hrac", "gara", "flat", "flat_td3")
GOALS = ("test", "train")  # sets of goals that a row may be tested with
LEVEL = 0.9  # of success_any, for the time to it, unless said otherwise
MEASURED = ("eval/success_any", "eval/success_final", "eval/time_at_goal", "abstraction/regions")
CURVE = ("seed", "env_steps", "wall_s", *MEASURED)
STAR = (sys.executable, "-m", "star")


def layer(name: str) -> list[str]:
    """Arguments of `star train` that turn the task's config into that of the agent `name`; SystemExit if unknown."""
    found: list[str] = []
    for part in name.split("+"):
        if part == "star":
            continue
        paths = [path for folder in LAYERS if (ROOT / (path := Path("configs") / folder / f"{part}.yaml")).is_file()]
        if not paths:
            known = sorted(path.stem for folder in LAYERS for path in (ROOT / "configs" / folder).glob("*.yaml"))
            raise SystemExit(f"error: {part}: no such agent; known are star, {', '.join(known)}")
        found += ["--with", str(paths[0])]
    return found


def training(task: str, name: str, seeds: list[int], settings: list[str]) -> list[str]:
    """Words after `star` that train the consecutive `seeds` of one agent in one program."""
    chosen = ["--seed", str(seeds[0]), "--seeds", str(len(seeds)), *settings]
    return ["train", f"configs/{task}.yaml", *layer(name), *chosen]


def measure(
    task: str,
    name: str,
    seeds: list[int],
    options: argparse.Namespace,
    settings: list[str],
    *,
    goals: Sequence[str] = ("test",),
    version: str = "",
) -> dict[str, Any]:
    """Train and evaluate the consecutive `seeds` of one agent in one program: metrics, evaluation, how it was run.

    The evaluation of a seed is that with the first of `goals`; those with the others stand in it by their names. Runs
    of another `version` of the agent are kept apart.
    """
    apart = shlex.join(settings) + version
    other = [hashlib.sha256(apart.encode()).hexdigest()[:8]] if apart else []
    run = options.runs / task / "-".join([name, *map(str, seeds), *other])
    train = training(task, name, seeds, settings)
    if (run / "config.yaml").exists():  # interrupted, or done
        subprocess.run([*STAR, "train", "--resume", str(run)], cwd=ROOT, check=True)
    else:
        subprocess.run([*STAR, *train, "--run-dir", str(run)], cwd=ROOT, check=True)
    evaluated, *others = (_evaluated(run, which, options.episodes) for which in goals)
    for which, seen in zip(goals[1:], others, strict=True):
        evaluated = [seed | {which: more} for seed, more in zip(evaluated, seen, strict=True)]
    return {
        "rows": JsonLines(run / "metrics.jsonl").read(),
        "evaluated": evaluated,
        "run": {"seeds": seeds, "command": shlex.join(["star", *train])} | provenance(run, options.commit),
    }


def _evaluated(run: Path, goals: str, episodes: int) -> list[dict[str, Any]]:
    """The evaluation of each seed of `run` on a set of `goals`."""
    evaluate = [*STAR, "evaluate", str(run), "--episodes", str(episodes), "--goals", goals, "--json"]
    report = subprocess.run(evaluate, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return json.loads(report.splitlines()[-1])["seeds"]


def summarise(
    task: str, name: str, old: dict[str, Any], measured: dict[str, Any], *, level: float
) -> tuple[dict[str, Any], list]:
    """The content of an agent's JSON, the seeds of the `old` one included, and the new evaluations during training."""
    rows = measured["rows"]
    curve = [
        {"name": name} | {k: v for k, v in row.items() if k in CURVE or k.startswith("sgim/")}
        for row in rows
        if "eval/success_any" in row
    ]
    speed = float(np.median([row["env_steps_per_s"] for row in rows]))  # of the seeds of a program together
    for seed in measured["evaluated"]:
        first = next((p for p in curve if p["seed"] == seed["seed"] and p["eval/success_any"] >= level), None)
        seed |= {
            "env_steps_to_level": first and first["env_steps"],
            "training_seconds_to_level": first and round(first["env_steps"] * len(measured["evaluated"]) / speed, 1),
            "seconds_to_level": first and first["wall_s"],
        }
    return {
        "task": task,
        "name": name,
        "env_steps_per_seed": rows[-1]["env_steps"],
        "level": level,
        "seeds": [*old.get("seeds", []), *measured["evaluated"]],
        "runs": [*old.get("runs", []), measured["run"] | {"env_steps_per_s": speed}],
    }, curve


def groups(missing: list[int], *, one_by_one: bool) -> list[list[int]]:
    """The `missing` seeds by the program that trains them: alone, or with all that follow one another."""
    found: list[list[int]] = []
    for seed in missing:
        if found and not one_by_one and seed == found[-1][-1] + 1:
            found[-1].append(seed)
        else:
            found.append([seed])
    return found


def provenance(run: Path, commit: str | None) -> dict[str, Any]:
    """Commit (the one given, else that which the run noted), device, Python and versions of the last start of `run`."""
    noted = [
        row | ({"commit": commit} if commit else {}) for row in Journal.of(run, tables="regions").provenance.read()
    ]
    return {key: noted[-1][key] for key in ("commit", "device", "python", "versions")}


def table(reports: list[dict[str, Any]]) -> str:
    """A Markdown table of the agents."""
    level = reports[0].get("level", LEVEL)
    lines = [
        "| agent | seeds | env steps per seed | success_any | success_final | success_any above .9 "
        f"| success_any of each seed | median env steps to success_any {level:g} | seconds of training to it "
        "| seconds since the start |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for report in reports:
        seeds = report["seeds"]
        cells = [report["name"], str(len(seeds)), _steps(report["env_steps_per_seed"])]
        for key in MEASURES:
            scores = np.asarray([seed[key] for seed in seeds])
            mean, low, high = over_seeds(scores, episodes=seeds[0]["episodes"])
            cells.append(f"{mean:.3f} [{low:.3f}, {high:.3f}]" if len(seeds) > 1 else f"{mean:.3f}")
        learnt = above([seed["success_any"] for seed in seeds])
        cells.append("{} of {} [{:.2f}, {:.2f}]".format(learnt["seeds"], learnt["of"], *learnt["interval"]))
        cells.append(" ".join(f"{seed['success_any']:.3g}" for seed in seeds))
        for key, form in (
            ("env_steps_to_level", _steps),
            ("training_seconds_to_level", "{:.0f} s".format),
            ("seconds_to_level", "{:.0f} s".format),
        ):
            middle = float(np.median([np.inf if seed[key] is None else seed[key] for seed in seeds]))
            cells.append(form(middle) if np.isfinite(middle) else "never")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _steps(number: float) -> str:
    """Env steps for people."""
    return f"{number / 1e6:.1f} M" if number >= 1e6 else f"{number / 1e3:.3g} k"


def draw(curves: list[dict[str, Any]], path: Path) -> None:
    """success_any over env steps and over wall-clock, and how often teachers are asked."""
    names = sorted(dict.fromkeys(point["name"] for point in curves), key=lambda name: name != "star")
    unit, word = (1e6, "million") if max(point["env_steps"] for point in curves) >= 1e6 else (1e3, "thousand")
    asked = {name: _asked(curves, name) for name in names}
    panels = 3 if any(asked.values()) else 2
    figure = Figure(figsize=(5 * panels + 1.5, 4), layout="constrained")
    axes = figure.subplots(1, panels, sharey=True)
    for number, name in enumerate(names):
        style = {"color": f"C{number % 10}", "linestyle": ("-", "--", ":")[number // 10 % 3]}
        mine = [point for point in curves if point["name"] == name]
        steps = sorted({point["env_steps"] for point in mine})
        at = [[p for p in mine if p["env_steps"] == step] for step in steps]
        low, mean, high = (
            [f([p["eval/success_any"] for p in points]) for points in at] for f in (np.min, np.mean, np.max)
        )
        seconds = [np.mean([p["wall_s"] for p in points]) for points in at]
        for axis, x in zip(axes[:2], (np.asarray(steps) / unit, seconds), strict=True):
            axis.plot(x, mean, label=name, **style)
            if len(names) <= 5:
                axis.fill_between(x, low, high, color=style["color"], alpha=0.15, linewidth=0)
        if asked[name]:
            axes[2].plot([step / unit for step in asked[name]], list(asked[name].values()), **style)
    axes[0].set(xlabel=f"{word} env steps per seed", ylabel="success_any on test goals", ylim=(-0.02, 1.02))
    axes[1].set(xlabel="seconds, compilation included")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
    if panels > 2:
        axes[2].set(xlabel=f"{word} env steps per seed", ylabel="share of episodes with a teacher")
        axes[2].yaxis.set_tick_params(labelleft=True)
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def _asked(curves: list[dict[str, Any]], name: str) -> dict[int, float]:
    """Share of the taught episodes in which a teacher was asked, mean over seeds, by env steps."""
    shares: dict[int, list[float]] = {}
    for point in curves:
        teachers = [key.removeprefix("sgim/queries_") for key in point if key.startswith("sgim/queries_")]
        if point["name"] == name and teachers:
            shares.setdefault(point["env_steps"], []).append(sum(point[f"sgim/share_{t}"] for t in teachers))
    return {step: float(np.mean(values)) for step, values in sorted(shares.items())}


def again(row: str, options: Sequence[str] = ()) -> list[str]:
    """Arguments of this script, with `options`, that measure a row of results/ anew; SystemExit if there is none."""
    path = ROOT / "results" / f"{row}.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        runs, seeds = report["runs"], sorted(seed["seed"] for seed in report["seeds"])
    except (OSError, ValueError, KeyError, TypeError):
        raise SystemExit(f"error: {row}: results/{row}.json is no row of results") from None
    words = shlex.split(runs[-1]["command"])[2:]
    settings = [word for i, word in enumerate(words) if not _told_by_us(words, i)]
    alone = ["--one-by-one"] * all(len(run["seeds"]) == 1 for run in runs)
    level = ["--level", str(report.get("level", LEVEL)), "--episodes", str(report["seeds"][0]["episodes"])]
    which = ["--seed", str(seeds[0]), "--seeds", str(len(seeds)), "--out", str(path.parent)]
    others = [goals for goals in GOALS[1:] if goals in report["seeds"][0]]
    tested = ["--goals", GOALS[0], *others] if others else []
    return [report["task"], report["name"], *which, *level, *tested, *alone, *options, "--", *settings]


def _told_by_us(words: list[str], place: int) -> bool:
    """True if the word of a command at `place` is the config, or a layer, or says which seeds."""
    ours = ("--with", "--seed", "--seeds")
    return place == 0 or words[place] in ours or words[place - 1] in ours


def main(arguments: list[str] | None = None) -> None:
    """Measure agents of one task, or rows anew."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and "/" in given[0]:
        rows = list(itertools.takewhile(lambda word: not word.startswith("-"), given))
        for asked in [again(row, given[len(rows) :]) for row in rows]:
            fill(asked)
    else:
        fill(given)


def fill(given: list[str]) -> None:
    """Fill the folder of one task."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("task")
    parser.add_argument("names", nargs="*", default=AGENTS)
    parser.add_argument("--seed", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--level", type=float, default=LEVEL, help="of success_any, for the time to it")
    parser.add_argument("--goals", nargs="+", choices=GOALS, default=GOALS[:1], help="sets of goals to test with")
    parser.add_argument("--one-by-one", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--commit", help="what to record where there is no git")
    parser.add_argument("--runs", type=Path, default=Path("runs/reproduce"))
    end = given.index("--") if "--" in given else len(given)
    options, settings = parser.parse_intermixed_args(given[:end]), given[end + 1 :]
    if not (ROOT / "configs" / f"{options.task}.yaml").is_file():
        raise SystemExit(f"error: configs/{options.task}.yaml: no such file")
    options.runs = options.runs.resolve()
    for name in options.names:
        layer(name)

    out = options.out or ROOT / "results" / options.task / ("one_by_one" if options.one_by_one else "")
    out.mkdir(parents=True, exist_ok=True)
    record = JsonLines(out / "curves.jsonl")
    for name in options.names:
        path = out / f"{name}.json"
        report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        today = digest.of(shlex.join(["star", *training(options.task, name, [options.seed], settings)]))
        if not all(digest.same(program.get("digest"), today) for program in report.get("runs", [])):
            print(f"{path}: of an older version, begun anew", flush=True)
            report = {}
        level = report.get("level", LEVEL) if report else options.level
        if level != options.level:
            raise SystemExit(f"error: --level {options.level:g}: {path} was made with {level:g}")
        wanted = range(options.seed, options.seed + options.seeds)
        missing = sorted(set(wanted) - {seed["seed"] for seed in report.get("seeds", [])})
        for seeds in groups(missing, one_by_one=options.one_by_one):
            measured = measure(
                options.task, name, seeds, options, settings, goals=options.goals, version=json.dumps(today)
            )
            measured["run"]["digest"] = today
            report, curve = summarise(options.task, name, report, measured, level=options.level)
            there = {seed["seed"] for seed in report["seeds"]} - set(seeds)
            kept = [point for point in record.read() if point["name"] != name or point["seed"] in there] + curve
            record.path.write_text("".join(json.dumps(point) + "\n" for point in kept), encoding="utf-8")
            path.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    curves = record.read()
    paths = [out / f"{name}.json" for name in dict.fromkeys(point["name"] for point in curves)]
    reports = [json.loads(path.read_text(encoding="utf-8")) for path in paths if path.exists()]
    reports.sort(key=lambda report: (report["name"] != "star", report["name"]))
    (out / "table.md").write_text(table(reports), encoding="utf-8")
    draw(curves, out / "curves.png")
    print(table(reports))


if __name__ == "__main__":
    main()
