"""Make docs/results.md, its charts, and the tables of README and docs/hardware.md from the JSON files in results/.

    python scripts/results/page.py            write the page, its charts and the table
    python scripts/results/page.py --digests  first ask how all rows with a digest would learn today

A row is a JSON of scripts/results/reproduce.py. Today's digests are kept in results/digests.json, with the commit that
they are of. A row without a digest, or with another than today's, is marked as of an older version.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from scripts.pages import charts
from scripts.results import digest, jaxgcrl
from scripts.results.rows import DIGESTS, MARK, RESULTS, Row, evaluations, read
from scripts.results.verdicts import AGENTS, FOLDERS, standing, unmeasured, verdicts

ROOT = Path(__file__).parents[2]
BEGIN, END = "<!-- made by scripts/results/page.py -->", "<!-- made until here -->"

# The name of a task, the row that answers for it, and the published success (arXiv 2401.09870).
TASKS = (
    ("Ant Maze", "ant_maze/one_by_one/star", ".84"),
    ("Ant Maze Cam", "ant_maze_cam/one_by_one/star", ".74"),
    ("Ant Fall", "ant_fall/one_by_one/star", ".31"),
    ("labyrinth, 112 m", "ant_labyrinth/star", ""),
    ("Ant Maze, no GPU", "ant_maze_cpu/star", ""),
    ("Ant Fall, no GPU", "ant_fall_cpu/star", ""),
    ("Point Maze, no GPU", "point_maze/star", ""),
)
REFINED = {
    "labyrinth": "ant_labyrinth",
    "big maze": "ant_big_maze",
    "four rooms": "ant_4rooms",
    "sparse Ant Maze": "ant_maze_sparse",
    "hardest maze": "ant_hardest_maze",
    "Point Maze, wrong boxes": "point_maze/wrong_boxes",
}
PARTS = {
    "STAR": "star",
    "grid of 6 x 6": "grid",
    "no reachability mask": "no_mask",
    "cuts at random": "random_cuts",
    "reached regions": "reached_regions",
    "no refinement": "no_refinement",
}

LAST = """## Other learners

[SGIM](sgim.md#what-it-does-there), [SGIM-SAHT](saht.md) and [tutors of students](tutoring.md) have pages of their own.

## Measure a row again

```bash
python scripts/results/reproduce.py ant_maze/one_by_one/star ant_labyrinth/gara  # GPU
python scripts/results/page.py --digests
```

The first goes on where it was interrupted. A row holds seeds, command, commit, device, versions and
[learning digest](glossary.md#measurement). `results/README.md` lists all raw figures. Earlier ones are in the
[notebook](notebook/results.md).
"""


def table(rows: Mapping[str, Row]) -> str:
    """Five narrow columns: what STAR reaches in each task, how soon, and on what."""
    lines = ["| task | success | published | to .9 | on |", "|---|---|---|---|---|"]
    for task, path, published in TASKS:
        if row := rows.get(path):
            seeds = row.report["seeds"]
            on = f"{_device(row)}, {len(seeds)} seed{'s' * (len(seeds) > 1)}"
            lines.append(f"| {task}{row.mark} | {_success(row)} | {published} | {_soon(row)} | {on} |")
    return "\n".join(lines) + "\n"


def _success(row: Row) -> str:
    mean, low, high = (_share(x) for x in row.interval)
    return f"**{mean}** [{low}, {high}]"


def _share(value: float) -> str:
    return f"{value:.2f}".removeprefix("0")


def _device(row: Row) -> str:
    device = row.report["runs"][-1]["device"]
    return "2 CPU cores" if device.startswith("CPU") else re.sub(r"^NVIDIA (\w+).*", r"\1", device)


def _soon(row: Row) -> str:
    """Median of the training seconds to success .9."""
    times = [seed.get("training_seconds_to_level") for seed in row.report["seeds"]]
    middle = float(np.median([np.inf if time is None else time for time in times]))
    return f"{middle:.0f} s" if np.isfinite(middle) else "not noted" if "level" not in row.report else "never"


def hardware(rows: Mapping[str, Row]) -> str:
    """A table of what trains on what, and how fast."""
    lines = ["| task | on | env steps/s | env steps a seed | seeds | minutes |", "|---|---|---|---|---|---|"]
    for task, path, _ in TASKS:
        if row := rows.get(path):
            speed = float(np.median([run["env_steps_per_s"] for run in row.report["runs"]]))
            steps, seeds = row.report["env_steps_per_seed"], len(row.report["seeds"])
            told = (f"{speed / 1e6:.2f} M", f"{steps / 1e6:.1f} M", str(seeds), f"{steps * seeds / speed / 60:.1f}")
            lines.append(f"| {task}{row.mark} | {_device(row)} | {' | '.join(told)} |")
    return "\n".join(lines) + "\n"


def page(rows: Mapping[str, Row]) -> str:
    """The text of docs/results.md."""
    shown = list(dict.fromkeys(path for chart in charted(rows).values() for path in chart))
    shown += [path for _, path, _ in TASKS if path in rows and path not in shown]
    older = sum(not rows[path].today for path in shown)
    missing, found = unmeasured(rows), verdicts(rows)
    return f"""# Results

{BEGIN}

{standing(found)}

Made from `results/`. {_age(older, len(shown))}

## Success and time

{table(rows)}
* *success*: share of greedy episodes that reach the test goal, mean over seeds with a
  [95 % interval](evaluation.md#intervals). Each seed plays 100 or 200 episodes with starts unseen in training.
* *published*: the same in the [paper](https://arxiv.org/abs/2401.09870), after 10 to 13 hours of training.
* *to .9*: median over seeds of the seconds of training to a success of .9, without compilation and evaluation.
* Seeds of the first three tasks trained one by one, others side by side.

## Beside other agents

![Success of STAR and other agents on four ant tasks](images/results_agents.png)

| STAR beside | STAR is | difference in success | seeds x M env steps |
|---|---|---|---|
{chr(10).join(one.line for one in found)}

Bars are means over seeds, lines 95 % intervals, Welch's for differences. Seeds train side by side, unlike those above.
GARA here is STAR without its Tutor, with a longer horizon and no
[tilt penalty](notebook/departures.md#tutor-and-controller).
{f"Not measured: {missing}." if missing else ""}

![Success of STAR and GARA over env steps](images/results_curves.png)

Curves are means over seeds; bands hold all seeds.

{jaxgcrl.section(rows)}## Worth of refinement

![Success with and without refinement in six mazes](images/results_refinement.png)

The last pair starts from four boxes that follow no wall. If the first boxes follow the walls, refinement changes
[nothing](notebook/results.md#what-each-part-is-worth).

![Success in the labyrinth as parts of STAR are left out](images/results_parts.png)

The variants of the labyrinth are older, without tilt penalty, after 61 M env steps. STAR had 90 M; of their age it had
.87. A grid of 6 x 6, the only size tried, learns [faster](notebook/results.md#what-each-part-is-worth).

{LAST}"""


def _age(older: int, count: int) -> str:
    if not older:
        return "All rows are of the agent of today."
    which = "All rows are" if older == count else f"{older} of {count} rows are"
    return f"{which} **of an older version** ({MARK}, on pairs if one row is): no learning digest of today."


def charted(rows: Mapping[str, Row]) -> dict[str, list[str]]:
    """The rows in each chart that are there."""
    wanted = {
        "agents": [f"{folder}/{name}" for folder in FOLDERS.values() for name in AGENTS.values()],
        "refinement": [f"{folder}/{name}" for folder in REFINED.values() for name in ("star", "no_refinement")],
        "parts": [f"ant_labyrinth/{name}" for name in PARTS.values()],
    }
    there = {chart: [path for path in paths if path in rows] for chart, paths in wanted.items()}
    return there | {"jaxgcrl": jaxgcrl.paths(rows)}


def bars(rows: Mapping[str, Row], groups: Sequence[str], names: Mapping[str, str], paths: Any) -> Figure:
    """Bars of success for each of `groups`, one for each of `names` (label: what `paths` takes after the group)."""
    figure = Figure(figsize=(8.2, 2.9), layout="constrained")
    axis = figure.subplots()
    names = {label: name for label, name in names.items() if any(paths(group, name) in rows for group in groups)}
    width = 0.8 / len(names)
    for number, (label, name) in enumerate(names.items()):
        places, middles, spans = [], [], []
        for place, group in enumerate(groups):
            if row := rows.get(paths(group, name)):
                mean, low, high = row.interval
                places.append(place + (number - (len(names) - 1) / 2) * width)
                middles.append(mean)
                spans.append((mean - low, high - mean))
                if mean < 0.005:  # a bar that nobody would see
                    axis.annotate("0", (places[-1], 0.01), ha="center")
        axis.bar(places, middles, width, yerr=np.transpose(spans) if spans else None, capsize=2, label=label)
    axis.set_xticks(range(len(groups)), [textwrap.fill(group, 13) for group in groups])
    axis.set(ylabel="success", ylim=(0, 1.05))
    axis.grid(axis="y", alpha=0.3)
    axis.set_axisbelow(True)
    if len(names) > 1:
        figure.legend(*axis.get_legend_handles_labels(), loc="outside right center")
    return figure


def curves(results: Path) -> Figure:
    """Success of STAR and GARA over env steps in four tasks: mean and range of the seeds."""
    figure = Figure(figsize=(8.2, 2.6), layout="constrained")
    axes = figure.subplots(1, len(FOLDERS), sharey=True)
    for axis, (task, folder) in zip(axes, FOLDERS.items(), strict=True):
        for number, (label, name) in enumerate(list(AGENTS.items())[:2]):
            mine = evaluations(results / folder / name)
            charts.band(axis, mine, "eval/success_any", color=f"C{number}", label=label)
        axis.set(title=task, ylim=(-0.02, 1.02))
    axes[0].set_ylabel("success")
    figure.supxlabel("million env steps of each seed", fontsize="medium")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center")
    return figure


def drawn(rows: Mapping[str, Row], results: Path = RESULTS) -> dict[str, Figure]:
    """The charts of the page."""

    def refined(group: str, name: str) -> str:
        return f"{REFINED[group]}/{name}"

    pair = {"refined": "star", "not refined": "no_refinement"}
    return {
        "results_agents": bars(rows, list(FOLDERS), AGENTS, lambda task, name: f"{FOLDERS[task]}/{name}"),
        "results_curves": curves(results),
        "results_refinement": bars(rows, list(REFINED), pair, refined),
        "results_parts": bars(rows, list(PARTS), {"": ""}, lambda part, _: f"ant_labyrinth/{PARTS[part]}"),
    } | ({"results_jaxgcrl": jaxgcrl.curves(results)} if jaxgcrl.paths(rows) else {})


def sources(rows: Mapping[str, Row], results: Path = RESULTS) -> str:
    """A hash of all figures that the charts show; each chart carries it."""
    shown = {path: list(map(float, rows[path].scores)) for paths in charted(rows).values() for path in paths}
    told = hashlib.sha256(json.dumps(shown, sort_keys=True).encode())
    drawn = [f"{folder}/{name}" for folder in FOLDERS.values() for name in list(AGENTS.values())[:2]]
    for path in drawn + jaxgcrl.paths(rows):
        told.update(json.dumps(evaluations(results / path)).encode())
    return told.hexdigest()[:16]


def with_table(text: str, made: str) -> str:
    """A page with another table between its two marks."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{made}{END}{rest.split(END)[1]}"


def tables(rows: Mapping[str, Row]) -> dict[str, str]:
    """The tables of other pages."""
    return {"README.md": table(rows), "docs/hardware.md": hardware(rows)}


def renew(rows: Mapping[str, Row]) -> None:
    """Write today's digests of all rows that have one."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, check=True, capture_output=True, text=True
    )
    found: dict[str, Any] = {"commit": commit.stdout.strip(), "rows": {}}
    for path, row in rows.items():
        if any("digest" in run for run in row.report["runs"]):
            found["rows"][path] = digest.of(row.report["runs"][-1]["command"])
            print(f"{path}: {found['rows'][path]}", flush=True)
    DIGESTS.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Write the page, its charts and the tables of other pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--digests", action="store_true", help="renew results/digests.json: a minute a row")
    options = parser.parse_args()
    if options.digests:
        renew(read())
    rows = read()
    (ROOT / "docs" / "results.md").write_text(page(rows), encoding="utf-8")
    for name, made in tables(rows).items():
        text = (ROOT / name).read_text(encoding="utf-8")
        (ROOT / name).write_text(with_table(text, made), encoding="utf-8")
    for name, figure in drawn(rows).items():
        charts.save(figure, name, dpi=80, of=sources(rows))


if __name__ == "__main__":
    main()
