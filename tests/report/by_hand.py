"""Rows of runs, written by hand: nothing is trained."""

import json

CUTS = [0.0, 8.0, 12.0, 16.0]


def lines(path, rows):
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def metrics(epochs, seeds, *, every=2, success=lambda seed, epoch: 0.5, **others):
    """Rows of an epoch of 100 env steps and 2 s each."""
    rows = []
    for epoch in range(1, epochs + 1):
        for seed in seeds:
            row = {"seed": seed, "controller/actor_loss": seed + epoch, "abstraction/regions": 2}
            if epoch % every == 0:
                row |= {f"eval/{name}": success(seed, epoch) for name in ("success_any", "success_final", "distance")}
            rows.append(row | others | {"env_steps": 100 * epoch, "wall_s": 2.0 * epoch, "env_steps_per_s": 50 + epoch})
    return rows


def strip(number, *, old=False):
    """Regions from the left to the right wall of the Point Maze, cut at the first `number` of CUTS along y."""
    edges = [-4.0, *CUTS[:number], 20.0]
    count = len(edges) - 1
    row = {
        "lower": [[-4.0, edge] for edge in edges[:-1]],
        "upper": [[20.0, edge] for edge in edges[1:]],
        "chosen": [float(i + 1) for i in range(count)],
    }
    known = {"value": [i / count for i in range(count)], "target": [min(i + 1, count - 1) for i in range(count)]}
    edges = {"reaches": [[i, i + 1] for i in range(count - 1)], "misses": [], "goal": [0.0, 16.0]}
    return row if old else row | known | edges
