"""Train the algorithms of SGIM-SAHT side by side in a world, and see which claims of the papers hold.

    python scripts/results/saht.py WORLD [NAME ...] [--seeds 20] [--total 25000] [--noise 0] [--runs DIR] [--out DIR]

WORLD is pen, throw, fishing or table; a NAME is one of the algorithms below, by default all that the claims about the
world need. Each is one run of `star train` with its seeds side by side; two of them are taught by what another run has
learnt, which `star record` writes. A run that is done is not made again, and one that was
interrupted goes on, so empty `--runs` when code or configs have changed. Into `--out`, results/saht by default, go

    WORLD.json    of every algorithm the errors of each seed at each evaluation, what was practised and asked, how long
                  it took; command, commit, device and versions; and every claim with its numbers
    WORLD.md      the table of errors, and that of the claims: 95 % bootstrap intervals over seeds
    WORLD.png     error over iterations by algorithm, for each task and for their mean
    WORLD_taught.png   error over what a teacher was asked for, by DAgger, CBA and SGIM-ACTS

and with `--docs` the pictures of docs/saht.md: these, and for pen two figures of SGIM-PB's run.
A claim that something is better holds if the interval of the difference lies on that side of 0; one that names a
number, if the mean does. With `--noise` the files are called WORLD_noise.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from envs import worlds
from scripts.pages import charts
from scripts.results.claims import Claim, less, mean, ratio, shown, told
from star.config.loading import load_run
from star.report.statistics import over_seeds
from star.saht.experiment import Saht
from star.saht.figures import TASKS, colour, plain_ticks
from star.training.journal import Journal, by_step

ROOT = Path(__file__).parents[2]
STAR = (sys.executable, "-m", "star")
TOTAL = {"pen": 25_000, "throw": 5_000, "fishing": 5_000, "table": 25_000}
SHORT = 5_000  # iterations up to which every epoch is followed by an evaluation
DEMOS = 25  # of the teachers that are compared in fishing


def flawed(flaw: str) -> list[str]:
    """Teachers of SGIM-ACTS with a flaw."""
    teachers = [{"kind": kind, "flaw": flaw} for kind in ("action", "outcome")]
    return ["--saht.teachers", json.dumps(teachers)]


def many(number: int) -> list[str]:
    """Teachers of actions and outcomes who show so many demonstrations of a task."""
    teachers = [{"kind": kind, "demos": number} for kind in ("action", "outcome")]
    return ["--saht.teachers", json.dumps(teachers)]


EVEN = ["--with", "saht/even"]
WIDE = ["--world.options", '{"scale": 10}']
SMALL = ["--world.options", '{"links": 0.9, "limits": 0.8}']
ALGORITHMS: Mapping[str, list[str]] = {
    "random": ["saht/random"],
    "sagg_riac": ["saht/sagg_riac"],
    "im_pb": ["saht/im_pb"],
    "sgim_d": ["saht/sgim_d"],
    "sgim_acts": ["saht/sgim_acts"],
    "sgim_pb": ["saht/sgim_pb"],
    "mimicry": ["saht/mimicry"],
    "emulation": ["saht/mimicry", "--saht.teachers", '[{"kind": "outcome"}]'],
    "im_pb_even": ["saht/im_pb", *EVEN],
    "sgim_acts_even": ["saht/sgim_acts", *EVEN],
    "sgim_pb_even": ["saht/sgim_pb", *EVEN],
    "sgim_acts_repetitive": ["saht/sgim_acts", *flawed("repetitive")],
    "sgim_acts_other_body": ["saht/sgim_acts", *flawed("other_body")],
    "even_repetitive": ["saht/sgim_acts", *EVEN, *flawed("repetitive")],
    "even_other_body": ["saht/sgim_acts", *EVEN, *flawed("other_body")],
    "sgim_d_wide": ["saht/sgim_d", *WIDE],
    "mimicry_wide": ["saht/mimicry", *WIDE],
    "sagg_riac_wide": ["saht/sagg_riac", *WIDE],
    "sgim_d_human": ["saht/sgim_d", *many(DEMOS)],
    "sgim_d_robot": ["saht/sgim_d"],
    "im_pb_small": ["saht/im_pb", *SMALL],
    "im_pb_taught": ["saht/im_pb", *SMALL],
    "sgim_acts_many": ["saht/sgim_acts", *many(500)],
    "dagger": ["saht/dagger"],
    "cba": ["saht/cba"],
}
"""The arguments of `star train` for each."""
IMITATORS = ("sgim_acts", "sgim_acts_many", "dagger", "cba")
"""Those that are compared by what they ask."""
LEARNT = {"sgim_d_robot": "sagg_riac", "im_pb_taught": "sgim_pb"}
"""Learners that are taught by the finds of another."""
OF_WORLD = {
    "pen": ("sgim_pb", "sgim_acts", "im_pb", "sagg_riac", "random", "sgim_pb_even", "sgim_acts_even", "im_pb_even")
    + ("sgim_d", "mimicry"),
    "throw": ("sgim_acts", "sagg_riac", "mimicry", "emulation", "random", "sgim_d", "sgim_acts_even")
    + ("sgim_acts_repetitive", "sgim_acts_other_body", "even_repetitive", "even_other_body")
    + IMITATORS[1:],
    "fishing": ("sagg_riac", "random", "sgim_d_wide", "mimicry_wide", "sagg_riac_wide", "sgim_d_human", "sgim_d_robot")
    + IMITATORS,
    "table": ("sgim_pb", "im_pb", "sagg_riac", "random", "sgim_pb_even", "mimicry", "im_pb_small", "im_pb_taught")
    + IMITATORS,
}


def trained(world: str, name: str, options: argparse.Namespace) -> dict[str, Any]:
    """The measurements of a run of the algorithm; it is made, or gone on with, if need be."""
    run = options.runs / _stem(world, options.noise) / name
    words = [*ALGORITHMS[name], "--world.name", world, "--seeds", str(options.seeds)]
    words += ["--total-env-steps", str(options.total), "--trainer.checkpoint_every", "1000"]
    words += ["--trainer.eval_every", "1"] * (options.total <= SHORT)
    words += ["--world.noise", str(options.noise)] if options.noise else []
    if name in LEARNT:
        words += ["--saht.teachers", json.dumps(learnt(world, name, options))]
    if _done(run, options.total):
        pass
    elif (run / "config.yaml").exists():
        subprocess.run([*STAR, "train", "--resume", str(run), "--quiet"], cwd=ROOT, check=True)
    else:
        subprocess.run([*STAR, "train", *words, "--run-dir", str(run), "--quiet"], cwd=ROOT, check=True)
    return {"command": shlex.join(["star", "train", *words])} | read(run)


def learnt(world: str, name: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Teachers who show what a learner of another algorithm can do, whose run is made if need be."""
    other = LEARNT[name]
    trained(world, other, options)
    run = options.runs / _stem(world, options.noise) / other
    file = run.with_name(f"{other}.npz")
    if not file.exists():
        command = [*STAR, "record", str(run), "--out", str(file), "--episodes", "500"]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    kept = file.with_name(f"{name}.npz")
    with np.load(file) as arrays:
        shown = dict(arrays)
    if name == "sgim_d_robot":
        rows = np.random.default_rng(0).permutation(len(shown["tasks"]))[:DEMOS]
        kinds = ["action", "outcome"]
    else:
        rows, kinds = np.flatnonzero(shown["pairs"][:, 0] >= 0), ["procedure"]
    np.savez(kept, **{key: array if array.ndim == 0 else array[rows] for key, array in shown.items()})
    tasks = dict.fromkeys(map(str, shown["tasks"][rows]))
    return [{"kind": kind, "task": task, "source": str(kept)} for kind in kinds for task in tasks]


def _stem(world: str, noise: float) -> str:
    return world + "_noise" * (noise > 0)


def _done(run: Path, total: int) -> bool:
    """True if the run has been trained, and was evaluated at its end."""
    rows = Journal.of(run, tables="practice").metrics.read()
    return bool(rows) and rows[-1]["env_steps"] >= total and "eval/error" in rows[-1]


def read(run: Path) -> dict[str, Any]:
    """Of a run: errors of each seed, shares of tasks and of teachers by tenths of the time, tallies, and provenance."""
    journal = Journal.of(run, tables="practice")
    rows, tables, starts = journal.metrics.read(), journal.tables.read(), journal.provenance.read()
    epochs = by_step(rows)
    evaluated = [now for now in epochs if "eval/error" in now[0]]
    config = load_run(run, {})
    section, names = config.saht, worlds.make(config.world.name).names
    taught = [teacher.name for teacher in section.teachers]
    n = len(epochs)
    tenths = [slice(n * i // 10, max(n * (i + 1) // 10, n * i // 10 + 1)) for i in range(10)]

    def by_tenth(keys: Sequence[str]) -> list[list[float]]:
        """[tenths][seeds] of a sum of metrics."""
        sums = np.array([[sum(row[key] for key in keys) for row in now] for now in epochs])
        return [np.round(sums[part].mean(axis=0), 4).tolist() for part in tenths]

    last = [row for row in tables if row["env_steps"] == rows[-1]["env_steps"]]
    return {
        "seeds": [row["seed"] for row in epochs[0]],
        "iterations": rows[-1]["env_steps"],
        "wall_s": rows[-1]["wall_s"],
        "iterations_per_s": float(np.median([row["env_steps_per_s"] for row in rows])),
        **{key: starts[-1][key] for key in ("commit", "device", "python", "versions") if key in starts[-1]},
        "steps": [now[0]["env_steps"] for now in evaluated],
        "errors": {
            name: [[round(row[f"eval/{key}"], 5) for row in now] for now in evaluated]
            for name, key in [("mean", "error"), *((name, f"error_{name}") for name in names)]
        },
        "areas": [
            [round(float(np.mean([row[f"eval/area_{name}"] for name in names])), 5) for row in now] for now in evaluated
        ],
        "asked": asked(epochs),
        "executed": [[round(row["eval/executed"], 5) for row in now] for now in evaluated if "eval/executed" in now[0]],
        "tasks": {name: by_tenth([f"saht/task_{name}"]) for name in names},
        "requests": by_tenth([f"saht/strategy_{way}" for way in taught]),
        "ways": [*section.strategies, *taught],
        "chosen": [row["chosen"] for row in last],
        "played": [row["played"] for row in last],
    }


def asked(epochs: Sequence[Sequence[Mapping[str, Any]]]) -> list[list[int]]:
    """For each evaluation and seed the iterations so far for which a teacher was asked; [] where that was not noted."""
    if any("saht/asked" not in row for now in epochs for row in now):
        return []
    sums = np.cumsum([[row["saht/asked"] for row in now] for now in epochs], axis=0)
    return [sums[number].tolist() for number, now in enumerate(epochs) if "eval/error" in now[0]]


def _final(algorithm: Mapping[str, Any], task: str = "mean", at: int = -1) -> np.ndarray:
    """The errors of each seed."""
    return np.asarray(algorithm["errors"][task][at])


def _share(algorithm: Mapping[str, Any], task: int, begins: Sequence[str]) -> np.ndarray:
    """For each seed the share of the iterations for a task with strategies whose names begin so."""
    mine = [any(way.startswith(one) for one in begins) for way in algorithm["ways"]]
    chosen = np.asarray(algorithm["chosen"], float)[:, task]
    return chosen[:, mine].sum(axis=1) / np.maximum(chosen.sum(axis=1), 1)


def claims_of_pen(found: Mapping[str, Any]) -> list[Claim]:
    """Those about the world pen, as far as their algorithms are there."""
    claims: list[Claim] = []
    tip, character = 0, 5
    if {"im_pb", "sagg_riac"} <= found.keys():
        im, sagg = found["im_pb"], found["sagg_riac"]
        claims += [
            mean("e", "IM-PB: mean error", _final(im), "<= .17", lambda x: x <= 0.17),
            ratio(
                "e", "IM-PB / SAGG-RIAC: character", _final(im, "character"), _final(sagg, "character"),
                "<= .5", lambda x: x <= 0.5,
            ),
            *(
                less("e", f"IM-PB - SAGG-RIAC: {task}", _final(im, task), _final(sagg, task))
                for task in ("line", "pen")
            ),
        ]  # fmt: skip
        played = np.asarray(im["played"], float)
        length = played @ np.arange(1, played.shape[-1] + 1) / np.maximum(played.sum(axis=-1), 1)
        claims.append(
            less("e", "IM-PB: primitives for the tip - for the character", length[:, tip], length[:, character])
        )
    if {"sgim_pb", "sgim_acts"} <= found.keys():
        pb, acts = found["sgim_pb"], found["sgim_acts"]
        claims += [
            *(
                less("f", f"SGIM-PB - SGIM-ACTS: {task}", _final(pb, task), _final(acts, task))
                for task in ("line", "character")
            ),
            mean("f", "SGIM-PB: mean error", _final(pb), "<= .11", lambda x: x <= 0.11),
        ]
    simple = {"tip": tip, "joystick_1": 3, "joystick_2": 4}
    return claims + _of_progress(found, ("the character", character), simple, ("the tip", "tip"))


def _of_progress(
    found: Mapping[str, Any], hard: tuple[str, int], simple: Mapping[str, int], easy: tuple[str, str]
) -> list[Claim]:
    """Rows g to j, and even: of a task made of others, of simple ones, and of the easiest, what it is called and is."""
    claims: list[Claim] = []
    if "sgim_pb" in found:
        pb = found["sgim_pb"]
        procedures = ("procedures", "procedure_")
        share, text = _share(pb, hard[1], procedures), f"SGIM-PB: share of procedures for {hard[0]}"
        claims.append(mean("g", text, share, ">= .4", lambda x: x >= 0.4))
        for task, number in simple.items():
            share = _share(pb, number, procedures)
            claims.append(mean("g", f"SGIM-PB: share of procedures for {task}", share, "<= .12", lambda x: x <= 0.12))
        shares = np.asarray(pb["tasks"][easy[1]])
        claims.append(
            ratio("h", f"SGIM-PB: share of {easy[0]}, first quarter / last", _quarter(shares), _quarter(shares[::-1]),
                   ">= 1.2", lambda x: x >= 1.2)
        )  # fmt: skip
        asked = np.asarray(pb["requests"])
        claims += [
            ratio("i", "SGIM-PB: requests, first tenth / last", asked[0], asked[-1], ">= 1.5", lambda x: x >= 1.5),
            mean("j", "SGIM-PB: requests, share of all blocks", asked.mean(axis=0), "<= .35", lambda x: x <= 0.35),
        ]
    if {"sgim_pb", "sgim_pb_even"} <= found.keys():
        pb, even = found["sgim_pb"], found["sgim_pb_even"]
        for at, step in enumerate(pb["steps"]):
            if step >= 10_000:
                claims.append(
                    less("even", f"SGIM-PB - even choice at {step:,}", _final(pb, at=at), _final(even, at=at))
                )
        claims.append(
            ratio("even", "SGIM-PB / even choice at the end", _final(pb), _final(even), "<= .88", lambda x: x <= 0.88)
        )
    return claims


def _quarter(tenths: np.ndarray) -> np.ndarray:
    """Mean over the first quarter of ten tenths [10, seeds]."""
    return (tenths[0] + tenths[1] + 0.5 * tenths[2]) / 2.5


def claims_of_throw(found: Mapping[str, Any]) -> list[Claim]:
    """Those about the world throw, as far as their algorithms are there."""
    claims: list[Claim] = []
    if "sgim_acts" not in found:
        return claims
    acts = found["sgim_acts"]
    for name in ("random", "sagg_riac", "mimicry", "emulation"):
        if name in found:
            claims.append(less("c", f"SGIM-ACTS - {name}: mean error", _final(acts), _final(found[name])))
    for number, task in enumerate(("thrown", "placed")):
        chosen = np.asarray(acts["chosen"], float)[:, number]
        asked = np.array([way.startswith(("action_", "outcome_")) for way in acts["ways"]])
        own = np.array([way in (f"action_{task}", f"outcome_{task}") for way in acts["ways"]])
        share = chosen[:, own].sum(axis=1) / np.maximum(chosen[:, asked].sum(axis=1), 1)
        claims.append(
            mean("c", f"SGIM-ACTS: own teachers among those asked for {task}", share, ">= .65", lambda x: x >= 0.65)
        )
    for flaw in ("repetitive", "other_body"):
        if f"sgim_acts_{flaw}" in found:
            claims.append(
                ratio("d", f"SGIM-ACTS: {flaw} / good teachers", _final(found[f"sgim_acts_{flaw}"]), _final(acts),
                       "<= 1.1", lambda x: x <= 1.1)
            )  # fmt: skip
        if {f"even_{flaw}", "sgim_acts_even"} <= found.keys():
            claims.append(
                ratio("d", f"even choice: {flaw} / good teachers", _final(found[f"even_{flaw}"]),
                       _final(found["sgim_acts_even"]), ">= 1.2", lambda x: x >= 1.2)
            )  # fmt: skip
    return claims


def claims_of_fishing(found: Mapping[str, Any]) -> list[Claim]:
    """Those about the world fishing, as far as their algorithms are there."""
    claims: list[Claim] = []
    for other in ("mimicry_wide", "sagg_riac_wide"):
        if {"sgim_d_wide", other} <= found.keys():
            mine, its = found["sgim_d_wide"], found[other]
            claims += [
                less("a", f"SGIM-D - {other}: error", _final(mine), _final(its)),
                less("a", f"{other} - SGIM-D: area", np.asarray(its["areas"][-1]), np.asarray(mine["areas"][-1])),
            ]
    if {"sgim_d_human", "sgim_d_robot"} <= found.keys():
        human, robot = _final(found["sgim_d_human"]), _final(found["sgim_d_robot"])
        claims.append(ratio("b", "SGIM-D: smooth demos / learnt ones", human, robot, "<= .9", lambda x: x <= 0.9))
    return claims


def claims_of_table(found: Mapping[str, Any]) -> list[Claim]:
    """Those about the world table, as far as their algorithms are there."""
    claims: list[Claim] = []
    touch, rhythm, tune = 0, 4, 5
    for row, one, other in (("e", "im_pb", "sagg_riac"), ("f", "sgim_pb", "sgim_acts")):
        if {one, other} <= found.keys():
            for task in ("burst", "tune"):
                text = f"{one} - {other}: {task}"
                claims.append(less(row, text, _final(found[one], task), _final(found[other], task)))
    claims += _of_progress(found, ("tune", tune), {"touch": touch, "rhythm": rhythm}, ("touch", "touch"))
    if {"im_pb_small", "im_pb_taught"} <= found.keys():
        alone, taught = found["im_pb_small"], found["im_pb_taught"]
        at = min(range(len(taught["steps"])), key=lambda i: abs(taught["steps"][i] - 10_000))
        text = f"IM-PB, taught by another body - alone: tune at {taught['steps'][at]:,}"
        claims.append(less("transfer", text, _final(taught, "tune", at), _final(alone, "tune", at)))
    return claims


def at_equal_cost(found: Mapping[str, Any]) -> list[Claim]:
    """SGIM-ACTS beside the other imitators, after as many iterations of a teacher as all of them have asked for."""
    there = [name for name in IMITATORS if found.get(name, {}).get("asked")]
    if "sgim_acts" not in there or len(there) == 1:
        return []
    most = int(min(np.mean(found[name]["asked"][-1]) for name in there))
    errors = {name: _after(found[name], most) for name in there}
    return [
        less("taught", f"SGIM-ACTS - {name}: mean error after {most:,} requests", errors["sgim_acts"], errors[name])
        for name in there
        if name != "sgim_acts"
    ]


def _after(algorithm: Mapping[str, Any], requests: float) -> np.ndarray:
    """The mean error of each seed after so many iterations of a teacher, between evaluations by interpolation."""
    asked, errors = np.asarray(algorithm["asked"], float), np.asarray(algorithm["errors"]["mean"])
    return np.array([np.interp(requests, asked[:, seed], errors[:, seed]) for seed in range(asked.shape[1])])


CLAIMS = {"pen": claims_of_pen, "throw": claims_of_throw, "fishing": claims_of_fishing, "table": claims_of_table}


def table(found: Mapping[str, Any], claims: Sequence[Claim]) -> str:
    """Both tables, in Markdown."""
    first = next(iter(found.values()))
    tasks = list(first["errors"])
    lines = [f"| algorithm | {' | '.join(tasks)} | seconds |", "|---" * (len(tasks) + 2) + "|"]
    for name, one in found.items():
        cells = []
        for task in tasks:
            cells.append(shown(_final(one, task)))
        lines.append(f"| {name} | {' | '.join(cells)} | {one['wall_s']:.0f} |")
    return "\n".join([*lines, "", *told(claims)]) + "\n"


def draw(found: Mapping[str, Any]) -> Figure:
    """The error over iterations of each algorithm: mean over seeds."""
    tasks = list(next(iter(found.values()))["errors"])
    tasks = tasks[1:] if len(tasks) == 2 else tasks  # the mean of one task is that task
    columns = min(4, len(tasks))
    lines = -(-len(tasks) // columns)
    figure = Figure(figsize=(3.1 * columns + 2.2, 2.7 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, task in zip(panels, tasks, strict=False):
        for number, (name, one) in enumerate(found.items()):
            mean = [np.mean(now) for now in one["errors"][task]]
            style = "--" if "even" in name else ":" if number >= len(TASKS) else "-"
            axes.plot(np.asarray(one["steps"]) / 1000, mean, style, color=colour(number), lw=1.4, label=name)
        axes.set(title="mean of the tasks" if task == "mean" else task.replace("_", " "), yscale="log")
        plain_ticks(axes)
        axes.grid(alpha=0.3, which="both")
        axes.tick_params(labelsize=7, which="both")
    for axes in panels[len(tasks) :]:
        axes.set_axis_off()
    figure.supxlabel("thousand iterations", size=9)
    figure.supylabel("error", size=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
    return figure


def draw_taught(found: Mapping[str, Any]) -> Figure:
    """The mean error of the imitators over what they have asked for: mean over seeds, 95 % interval."""
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(name for name in IMITATORS if found.get(name, {}).get("asked")):
        one = found[name]
        steps = np.mean(one["asked"], axis=1)
        mean, low, high = np.transpose([over_seeds(np.asarray(now)) for now in one["errors"]["mean"]])
        axes.plot(steps, mean, color=colour(number), lw=1.4, marker=".", label=name)
        axes.fill_between(steps, low, high, color=colour(number), alpha=0.2, lw=0)
    axes.set(xlabel="iterations of a teacher", ylabel="mean error", yscale="log")
    plain_ticks(axes)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    return figure


def pictures(run: Path) -> None:
    """Two figures of a run, for docs/saht.md."""
    config, journal = load_run(run, {}), Journal.of(run, tables="practice")
    drawn = Saht(config).figures(journal.metrics.read(), journal.tables.read())
    for name in ("curriculum", "hierarchy"):
        charts.save(drawn[name], f"saht_{name}", dpi=80)


def main(arguments: list[str] | None = None) -> None:
    """Fill the files of one world."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("world", choices=sorted(TOTAL))
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(ALGORITHMS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument(
        "--total", type=int, help="iterations of each seed (default: 25,000 in pen and table, 5,000 in the others)"
    )
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "saht")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "saht")
    parser.add_argument("--docs", action="store_true", help="draw the pictures of docs/saht.md")
    options = parser.parse_args(arguments)
    options.total = options.total or TOTAL[options.world]
    options.runs = options.runs.resolve()
    for name in options.names:
        if name not in ALGORITHMS:
            raise SystemExit(f"error: {name}: no such algorithm; known are {', '.join(ALGORITHMS)}")

    options.out.mkdir(parents=True, exist_ok=True)
    place = options.out / f"{_stem(options.world, options.noise)}.json"
    old = json.loads(place.read_text(encoding="utf-8"))["algorithms"] if place.exists() else {}
    for name in options.names or OF_WORLD[options.world]:
        old[name] = trained(options.world, name, options)
        found = {one: old[one] for one in ALGORITHMS if one in old}
        claims = CLAIMS[options.world](found) + at_equal_cost(found)
        about = {"world": options.world, "noise": options.noise, "claims": [one._asdict() for one in claims]}
        place.write_text(json.dumps(about | {"algorithms": found}) + "\n", encoding="utf-8")
        place.with_suffix(".md").write_text(table(found, claims), encoding="utf-8")
        draw(found).savefig(place.with_suffix(".png"), dpi=80)
        if at_equal_cost(found):
            draw_taught(found).savefig(place.with_name(f"{place.stem}_taught.png"), dpi=80)
    if options.docs:
        charts.save(draw(found), f"saht_{place.stem}", dpi=80)
        if at_equal_cost(found):
            charts.save(draw_taught(found), f"saht_{place.stem}_taught", dpi=80)
        if options.world == "pen":
            pictures(options.runs / place.stem / "sgim_pb")
    print(place.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
