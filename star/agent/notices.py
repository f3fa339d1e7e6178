"""Needs of a run, in one line each: room for regions, or new ground.

Drawn from rows of metrics alone, so that a run says it while it goes on, and the report afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

PATIENCE = 10  # epochs without new ground
ENOUGH = 0.5  # success_final of agents that need none
KEYS = ("refinement/table_full", "commander/ground", "eval/success_final")
_SHARE = 0.95  # of the most ground in an epoch: what is less than that beyond it is luck
_EVALUATIONS = 3


def notices(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Notices from the rows of one seed so far, by their subject; the rows have `env_steps` and those of `KEYS`."""
    found = {}
    full = next((row for row in rows if row.get("refinement/table_full") == 1), None)
    if full is not None:
        found["room"] = (
            f"the table of regions is full since env step {full['env_steps']:,}; abstraction.max_regions makes room"
        )
    success = [row["eval/success_final"] for row in rows if row.get("eval/success_final") is not None]
    ground = [row["commander/ground"] for row in rows if row.get("commander/ground") is not None]
    if len(success) >= _EVALUATIONS and max(success[-_EVALUATIONS:]) < ENOUGH and len(ground) == len(rows):
        enough = _SHARE * max(ground)
        since = next(i for i, share in enumerate(ground) if share >= enough)
        if len(rows) - 1 - since >= PATIENCE:
            found["frontier"] = (
                f"no new ground since env step {rows[since]['env_steps']:,}, and success_final is below {ENOUGH:g}"
            )
    return found
