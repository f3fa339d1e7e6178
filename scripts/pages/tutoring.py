"""Draw the pictures of docs/tutoring.md into docs/images/: of one run that finds its graph, with seed 0.

python scripts/pages/tutoring.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from scripts.pages import charts
from star.config.loading import load
from star.training import trainer
from star.training.journal import Journal
from star.tutoring import figures


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        trainer.train(load("tutoring/sgim_graph_found"), run, quiet=True)
        tables = Journal.of(run, tables="skills").tables.read()
    last = tables[-1]
    names = [f"skill {i}" for i in range(len(last["level"]))]
    shares = {(child, parent): share for child, parent, _, share in last["found"]}
    found = figures.found_figure(names, shares)
    drawn = {"prerequisites": found, "tutor_skills": figures.skills_figure(tables)}
    drawn["tutor_graph"] = figures.graphs_figure(tables)
    for name, figure in drawn.items():
        charts.save(figure, name, dpi=90)


if __name__ == "__main__":
    main()
