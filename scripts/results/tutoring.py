"""Compare tutors, and see how well prerequisites are found: the tables of docs/tutoring.md.

    python scripts/results/tutoring.py [PART ...] [--graphs 20] [--seed 0] [--out results/tutoring] [-- SETTINGS]

PART is one of these, by default both:

    tutors      every tutor teaches the same students on the same graphs, by `star train tutoring/NAME` with SETTINGS:
                tutors.json (lasting levels of each graph, and their curves), levels.png, and of knowledge tracing
                discovery.json (precision, recall and AUC of each graph and of all edges together)
    withheld    the withheld-skill test on the same graphs: withheld.json, like discovery.json, and withheld_apart.json,
                where each exercise needs one skill alone

table.md is made of all of these files, with 95 % intervals over graphs and whether each claim holds.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from star.cli.words import split_settings
from star.config.loading import load
from star.report.statistics import mean_interval
from star.training import program as programs
from star.training import trainer
from star.training.journal import Journal
from star.tutoring import graphs as matrices
from star.tutoring import withheld
from star.tutoring.experiment import withheld_scores

TUTORS = {
    "random": ("random", {}),
    "fixed": ("fixed", {}),
    "progress": ("progress", {}),
    "zpdes": ("zpdes", {}),
    "sgim_graph": ("sgim_graph", {}),
    "sgim_graph, graph found": ("sgim_graph_found", {}),
    "sgim_graph, all edges found": ("sgim_graph_found", {"teaching.sure": 0.0}),
    "sgim_graph, no graph": ("sgim_graph", {"teaching.graph": "none"}),
    "sgim_graph, wrong graph": ("sgim_graph", {"teaching.graph": "wrong"}),
}


def taught(name: str, settings: dict[str, Any], folder: Path, *, seed: int, graphs: int) -> dict[str, Any]:
    """One tutor's results with the students of all graphs."""
    config, own = TUTORS[name]
    settings = {"trainer.seed": seed, "trainer.num_seeds": graphs} | own | settings
    began, run = time.monotonic(), folder / name.replace(", ", "-").replace(" ", "_")
    trainer.train(load(f"tutoring/{config}", settings), run, quiet=True)
    journal = Journal.of(run, tables="skills")
    rows = journal.metrics.read()
    steps = sorted({row["env_steps"] for row in rows})
    of = lambda key, step: [row[key] for row in rows if row["env_steps"] == step]  # noqa: E731
    result = {
        "tutor": name,
        "settings": settings,
        "level": of("eval/level", steps[-1]),
        "mastered": of("eval/mastered", steps[-1]),
        "curve": {str(step): [round(x, 1) for x in of("eval/level", step)] for step in steps},
        "seconds": round(time.monotonic() - began, 1),
    }
    if "graph/auc" in rows[0]:
        result["graphs"] = {key: of(f"graph/{key}", steps[-1]) for key in ("precision", "recall", "auc")}
        result["tables"] = [row for row in journal.tables.read() if row["env_steps"] == steps[-1]]
    return result


def discovered(found: dict[str, Any]) -> dict[str, Any]:
    """Quality of the graphs that a tutor found, each and all of their edges together."""
    tables = found.pop("tables")
    true, known = ([{tuple(edge[:2]) for edge in row[key]} for row in tables] for key in ("prerequisites", "found"))
    edges = counted(true, known)
    return {"each": found.pop("graphs"), "edges": edges, "pooled": pooled(edges)}


def counted(true: Sequence[set[Any]], found: Sequence[set[Any]]) -> dict[str, list[int]]:
    """Numbers of edges of each graph."""
    hits = [len(a & b) for a, b in zip(true, found, strict=True)]
    return {"found": list(map(len, found)), "true": list(map(len, true)), "right": hits}


def pooled(edges: Mapping[str, Sequence[int]]) -> dict[str, float]:
    """Precision and recall of the edges of all graphs together."""
    right = sum(edges["right"])
    return {"precision": right / sum(edges["found"]), "recall": right / sum(edges["true"])}


def tested(settings: dict[str, Any], *, seed: int, graphs: int) -> dict[str, Any]:
    """Quality of the graphs that the withheld-skill test finds.

    Students choose evenly but for the skill withheld: preferences are of use to knowledge tracing alone.
    """
    began = time.monotonic()
    own = {"trainer.seed": seed, "trainer.num_seeds": graphs, "discovery.preference": 0.0} | settings
    config = load("tutoring/random", own)
    program = programs.build(config)
    courses = program.init(program.seed_keys()).course
    work = jax.jit(jax.vmap(lambda course, key: withheld_scores(config, course, key=key)))
    rows = jax.device_get((courses, *work(courses, program.evaluation_keys(0))))
    each: dict[str, list[float]] = {"precision": [], "recall": [], "auc": []}
    edges, pairs, together = [], [], []
    for i in range(graphs):
        course, lot, scores = jax.tree.map(lambda x, i=i: x[i], rows)
        effects = withheld.discover(course.needs, scores, lot)
        for key, value in matrices.quality(course.parents, effects.parents, effects.drop).items():
            each[key].append(float(value))
        above = np.asarray(matrices.ancestors(course.parents))
        edges.append([_edges(course.parents), _edges(effects.parents)])
        pairs.append([_edges(above), _edges(effects.pairs)])
        common = course.needs.T.astype(int) @ course.needs > 0
        together.append(int((effects.pairs & ~above & common).sum()))
    found = counted(*zip(*edges, strict=True))
    about = {"settings": own, "rate": withheld.RATE, "seconds": round(time.monotonic() - began, 1)}
    about |= {"each": each, "edges": found, "pooled": pooled(found)}
    return about | {"pairs": counted(*zip(*pairs, strict=True)) | {"wrong_with_common_exercise": together}}


def _edges(graph: Any) -> set[tuple[int, int]]:
    return set(map(tuple, np.argwhere(graph).tolist()))


def claims(level: dict[str, np.ndarray], graphs: dict[str, Any]) -> list[tuple[str, str, bool]]:
    """The claims, the findings, and True where they hold."""
    rows = []
    for key, least in (("precision", 0.65), ("recall", 0.75), ("auc", 0.85)):
        value = np.asarray(graphs["each"][key], float)
        rows.append((f"{key} of the graph found >= {least}", _interval(value, ".2f"), bool(value.mean() >= least)))
    best = level["sgim_graph"]
    for other in ("random", "progress", "zpdes", "fixed"):
        gain = best - level[other]
        rows.append((f"`sgim_graph` above `{other}`, level", _interval(gain, "+.0f"), mean_interval(gain)[0] > 0))
    kept = [
        _ratio(level["sgim_graph, graph found"] - level[other], best - level[other]) for other in ("random", "progress")
    ]
    for other, (share, low, high) in zip(("random", "progress"), kept, strict=True):
        rows.append(
            (
                f"graph found keeps >= .7 of the gain over `{other}`",
                f"{share:.2f} [{low:.2f}, {high:.2f}]",
                share >= 0.7,
            )
        )
    for other in ("sgim_graph, no graph", "progress"):
        loss = level["sgim_graph, wrong graph"] - level[other]
        rows.append(
            (f"a wrong graph is worse than `{other}`, level", _interval(loss, "+.0f"), mean_interval(loss)[1] < 0)
        )
    return rows


def _ratio(above: np.ndarray, below: np.ndarray) -> tuple[float, float, float]:
    """Ratio of two means over graphs, with the 95 % percentile bootstrap of graphs drawn anew."""
    rows = np.random.default_rng(0).integers(0, len(above), (9999, len(above)))
    draws = above[rows].mean(axis=1) / below[rows].mean(axis=1)
    return float(above.mean() / below.mean()), *np.quantile(draws, (0.025, 0.975))


def _interval(values: np.ndarray, shape: str) -> str:
    low, high = mean_interval(values)
    return f"{values.mean():{shape}} [{low:{shape}}, {high:{shape}}]"


def table(tutors: dict[str, Any], discovery: dict[str, Any], test: dict[str, Any], apart: dict[str, Any]) -> str:
    """Markdown, of the content of the JSON `FILES`: tutors, claims, two ways to find a graph, and pairs of skills."""
    level = {one["tutor"]: np.asarray(one["level"]) for one in tutors["tutors"]}
    lines = [
        "| tutor | level at the end | level, mean over time | skills mastered | seconds |",
        "|---|---|---|---|---|",
    ]
    for one in tutors["tutors"]:
        course = np.mean(list(one["curve"].values()), axis=0)
        cells = (
            _interval(level[one["tutor"]], ".0f"),
            _interval(course, ".0f"),
            _interval(np.asarray(one["mastered"]), ".2f"),
        )
        lines.append(f"| {one['tutor']} | {' | '.join(cells)} | {one['seconds']:.0f} |")
    lines += ["", "| to be shown | found | |", "|---|---|---|"]
    lines += [
        f"| {what} | {found} | {'holds' if holds else '**fails**'} |" for what, found, holds in claims(level, discovery)
    ]
    right, found, true = (sum(discovery["edges"][key]) for key in ("right", "found", "true"))
    lines += [
        "",
        f"Of the {found} edges found in all graphs {right} are right; {right} of the {true} true ones are found.",
        "",
        *_ways(discovery, test),
        "",
        *_pairs(test, apart),
    ]
    return "\n".join([*lines, ""])


def _ways(tracing: dict[str, Any], test: dict[str, Any]) -> list[str]:
    lines = ["| of the graph found | knowledge tracing | withheld-skill test | difference |", "|---|---|---|---|"]
    for key in ("precision", "recall", "auc"):
        one, other = (np.asarray(way["each"][key], float) for way in (tracing, test))
        lines.append(
            f"| {key} | {_interval(one, '.2f')} | {_interval(other, '.2f')} | {_interval(other - one, '+.2f')} |"
        )
    cells = [f"{sum(way['edges']['found'])}, {sum(way['edges']['right'])}" for way in (tracing, test)]
    return [*lines, f"| edges of all graphs, and right ones | {' | '.join(cells)} | |"]


def _pairs(test: dict[str, Any], apart: dict[str, Any]) -> list[str]:
    """The pairs that the test found; the graph is made of them."""
    both = test, apart
    lines = ["| pairs of skills | exercises as above | one skill for each exercise |", "|---|---|---|"]
    for text, key in (
        ("one comes before the other", "true"),
        ("found", "found"),
        ("right", "right"),
        ("wrong, and some exercise needs both skills", "wrong_with_common_exercise"),
    ):
        lines.append(f"| {text} | {' | '.join(str(sum(one['pairs'][key])) for one in both)} |")
    wrong = [1 - sum(one["pairs"]["right"]) / sum(one["pairs"]["found"]) for one in both]
    return [*lines, f"| share of wrong ones, {test['rate']} asked for | {' | '.join(f'{x:.2f}' for x in wrong)} |"]


def draw(tutors: list[dict[str, Any]], path: Path) -> None:
    """Mean level over exercises."""
    figure = Figure(figsize=(7.6, 4.2), layout="constrained")
    axis = figure.subplots()
    for number, one in enumerate(tutors):
        steps = list(map(int, one["curve"]))
        style = {"color": f"C{number}", "ls": ":" if "," in one["tutor"] else "-"}
        axis.plot(steps, [np.mean(levels) for levels in one["curve"].values()], label=one["tutor"], **style)
    axis.set(xlabel="exercises", ylabel="lasting level, Elo points")
    axis.grid(alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", fontsize="small")
    figure.savefig(path, dpi=110)


def teach(settings: dict[str, Any], options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The part of the tutors: what each of its files holds."""
    tutors: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in TUTORS:
            tutors.append(taught(name, settings, Path(folder), seed=options.seed, graphs=options.graphs))
            print(f"{name}: {_interval(np.asarray(tutors[-1]['level']), '.0f')}, {tutors[-1]['seconds']} s", flush=True)
    found = {one["tutor"]: discovered(one) for one in tutors if "tables" in one}
    draw(tutors, options.out / "levels.png")
    return {"tutors": {"tutors": tutors}, "discovery": found["sgim_graph, graph found"]}


def withhold(settings: dict[str, Any], options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The part of the withheld-skill test."""
    kinds: dict[str, dict[str, Any]] = {"withheld": {}, "withheld_apart": {"course.needs": 0}}
    return {name: tested(settings | own, seed=options.seed, graphs=options.graphs) for name, own in kinds.items()}


FILES = ("tutors", "discovery", "withheld", "withheld_apart")
PARTS: Mapping[str, Callable[..., dict[str, dict[str, Any]]]] = {"tutors": teach, "withheld": withhold}


def main() -> None:
    """Teach, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--graphs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/tutoring"))
    words, settings = split_settings(sys.argv[1:])
    options = parser.parse_args([word for word in words if word != "--"])
    for part in options.parts:
        if part not in PARTS:
            parser.error(f"{part!r} is not allowed: should be {' or '.join(PARTS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    about = {"graphs": options.graphs, "seed": options.seed, "command": " ".join(["python", *sys.argv])}
    about |= {"device": jax.default_backend(), "python": platform.python_version(), "jax": jax.__version__}
    for part in options.parts or PARTS:
        for name, content in PARTS[part](settings, options).items():
            (options.out / f"{name}.json").write_text(json.dumps(about | content) + "\n", encoding="utf-8")
    files = [options.out / f"{name}.json" for name in FILES]
    missing = [str(file) for file in files if not file.is_file()]
    if missing:
        print(f"no table is made without {', '.join(missing)}")
        return
    made = table(*(json.loads(file.read_text(encoding="utf-8")) for file in files))
    (options.out / "table.md").write_text(made, encoding="utf-8")
    print(made)


if __name__ == "__main__":
    main()
