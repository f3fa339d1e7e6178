"""How checkpoints of older formats become what this version reads: from each format to the next one.

Whoever changes what is saved adds one to `FORMAT`, a row to `TO_NEXT` and, under `tests/data`, a run of the old format.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

FORMAT = 4  # since aiming at a goal is counted apart from aiming at its region

About = dict[str, Any]
"""What a checkpoint says of itself: `format`, `config` (nested, as in `config.yaml`), `success_final` and the rest."""
Arrays = dict[str, np.ndarray]
"""A `TrainState` by the names of its leaves, such as `tutor/params/actor/...`; the leading axis is that of seeds."""


@dataclass(frozen=True)
class Migration:
    """From one format to the next: its description and its arrays. `format` itself is counted on by `migrated`."""

    about: Callable[[About], About] = lambda about: about
    arrays: Callable[[Arrays], Arrays] = lambda arrays: arrays


def _count_for_both_aims(arrays: Arrays) -> Arrays:
    """The Commander's counts [seeds, ...] for either aim [seeds, 2, ...]: nobody knows any more which it was."""
    counts = ("commander/model/led", "commander/model/lost")
    return {name: np.stack([x, x], axis=1) if name in counts else x for name, x in arrays.items()}


TO_NEXT: Mapping[int, Migration] = {
    2: Migration(),  # the same, in other files and without checksums
    3: Migration(arrays=_count_for_both_aims),
}


def readable(number: Any) -> bool:
    """Whether checkpoints of the format `number` can be read."""
    return number == FORMAT or number in TO_NEXT


def migrated(about: About) -> About:
    """`about` as of `FORMAT`."""
    for number in range(about["format"], FORMAT):
        about = TO_NEXT[number].about(about) | {"format": number + 1}
    return about


def migrated_arrays(arrays: Arrays, number: int) -> Arrays:
    """`arrays` of the format `number` as of `FORMAT`."""
    for each in range(number, FORMAT):
        arrays = TO_NEXT[each].arrays(arrays)
    return arrays
