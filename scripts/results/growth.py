"""Draw how the abstraction of a run grew, as the figures of the thesis do: the regions at some moments, side by side.

    python scripts/results/growth.py RUN --at 1e6 2e6 3e6 [--seed 0] [--out FILE.png]

The last panel is the end of the run. Without --at these are the quarters of the run. Regions are coloured by how often
the Commander chose them of late.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from star.agent import environment, figures
from star.config.loading import load_run
from star.training.figures import save
from star.training.journal import Journal


def main() -> None:
    """Write the figure and print where it is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--at", type=float, nargs="+", help="env steps")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()

    rows = Journal.of(options.run, tables="regions").tables.read()
    rows = [row for row in rows if options.seed in (None, row["seed"])]
    if not rows:
        parser.error(f"{options.run}: holds no regions.jsonl with rows of the seed asked for")
    walls = environment.make(load_run(options.run, {"env.engine": "auto"}), "test").walls
    out = options.out or options.run / "figures" / "growth.png"
    moments = options.at and [*options.at, np.inf]
    save(figures.growth_figure(regions=rows, walls=np.asarray(walls), moments=moments), out)
    print(out)


if __name__ == "__main__":
    main()
