"""The map in the report: how the regions of a run grew over the walls of its maze, as values that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from envs.arena import ROBOT
from star.agent import environment
from star.agent.region_rows import flat
from star.agent.sections import Config
from star.report.page import short

Row = Mapping[str, Any]


def growth_map(config: Config, rows: Sequence[Row], seeds: Sequence[int], *, most: int) -> dict[str, Any]:
    """The abstraction of every seed as it grew, over the walls, at as many moments as hold `most` regions together.

    `boxes` are corners [x, y, .., x, y, ..] that `frames` name by index, so that a region that stays takes little
    room. `chosen`, `visited` and `drawn` are shares in %, other tables are as in `regions.jsonl`.
    """
    config = config.model_copy(update={"env": config.env.model_copy(update={"engine": "auto"})})
    env = environment.make(config, "test")
    arena = env.arena
    robots = [] if arena is None else arena.centres(ROBOT).tolist()
    boxes: dict[tuple[float | None, ...], int] = {}
    frames: dict[int, list[dict[str, Any]]] = {seed: [] for seed in seeds}
    for row in _fewer(rows, most):
        if row["seed"] in frames:
            frames[row["seed"]].append(_frame(row, boxes))
    return {
        "axes": ["xyz"[i] if i < 3 else f"state {i}" for i in env.abstract_indices],
        "walls": np.round(env.walls, 3).tolist(),
        "chasms": [] if arena is None else np.round(arena.chasms(), 3).tolist(),
        "start": robots[0] if len(robots) == 1 else None,
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
    lower, upper = flat(row["lower"]), flat(row["upper"], height=1.0)
    corners = (tuple(short([*low, *high])) for low, high in zip(lower, upper, strict=True))
    kept = ("env_steps", "goal", "target", "reaches", "misses")
    frame = {key: row[key] for key in kept if key in row}
    frame["box"] = [boxes.setdefault(box, len(boxes)) for box in corners]
    for key in ("chosen", "visited", "drawn"):
        if key in row:
            frame[key] = short(100 * np.asarray(row[key]) / max(sum(row[key]), 1e-9))
    return frame | {key: short(row[key]) for key in ("value", "competence") if key in row}
