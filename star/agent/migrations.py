"""Conversion of checkpoints of older formats: from each format to the next one.

Whoever changes what is saved adds one to `FORMAT`, a row to `TO_NEXT` and, under `tests/data`, a run of the old format.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from star.abstraction.passages import PLANES, Tries
from star.config.kinds import Arrays, Migration
from star.learners.sections import TD3Config

FORMAT = 9  # since greedy episodes see the regions that the last epoch was played in


def _count_for_both_aims(arrays: Arrays) -> Arrays:
    """The Commander's counts [seeds, ...] for either aim [seeds, 2, ...]: nobody knows any more which it was."""
    counts = ("commander/model/led", "commander/model/lost")
    return {name: np.stack([x, x], axis=1) if name in counts else x for name, x in arrays.items()}


def _returns_as_they_are(arrays: Arrays) -> Arrays:
    """PPO's critics spoke of returns as they are: mean 0, deviation 1."""
    new: Arrays = {}
    for name, x in arrays.items():
        level, learnt, _ = name.partition("/params/log_std")
        if learnt:
            seeds = len(x)
            new |= {
                f"{level}/returns/mean": np.zeros(seeds, x.dtype),
                f"{level}/returns/variance": np.ones(seeds, x.dtype),
            }
    return arrays | new


def _observations_as_they_are(arrays: Arrays) -> Arrays:
    """TD3 saw observations and rewards as they are: statistics that say so weigh as much as a million transitions.

    The unit of rewards is 1 with the default discount.
    """
    new: Arrays = {}
    square = 1 - TD3Config().discount ** 2
    for name, x in arrays.items():
        level, learnt, _ = name.partition("/target/actor/params/Dense_0/kernel")
        if learnt:
            seeds, size = x.shape[:2]
            new |= {
                f"{level}/normalizer/mean": np.zeros((seeds, size), x.dtype),
                f"{level}/normalizer/variance": np.ones((seeds, size), x.dtype),
                f"{level}/normalizer/count": np.full(seeds, 1e6, x.dtype),
                f"{level}/rewards/mean": np.zeros((seeds, 1), x.dtype),
                f"{level}/rewards/variance": np.full((seeds, 1), square, x.dtype),
                f"{level}/rewards/count": np.full(seeds, 1e6, x.dtype),
            }
    return arrays | new


def _no_values_of_practice(arrays: Arrays) -> Arrays:
    """The Commander had a second table of values, for environments that practised to reach random regions."""
    return {name: x for name, x in arrays.items() if name != "commander/model/reach"}


def _nothing_tried(arrays: Arrays) -> Arrays:
    """Each epoch forgot how agents had tried to reach goals in their own region."""
    lower = arrays["abstraction/lower"]
    none = np.zeros((*lower.shape, PLANES - 1), np.float32)
    return arrays | {f"graph/tries/{count.name}": none for count in dataclasses.fields(Tries)}


def _cuts_at_once(arrays: Arrays) -> Arrays:
    """Cuts were seen at once by greedy episodes too: what is upcoming has come."""
    parts = ("commander", "abstraction", "graph", "sgim")
    return arrays | {f"upcoming/{name}": x for name, x in arrays.items() if name.partition("/")[0] in parts}


TO_NEXT: Mapping[int, Migration] = {
    2: Migration(),  # the same, in other files and without checksums
    3: Migration(arrays=_count_for_both_aims),
    4: Migration(arrays=_returns_as_they_are),
    5: Migration(arrays=_observations_as_they_are),
    6: Migration(arrays=_no_values_of_practice),
    7: Migration(arrays=_nothing_tried),
    8: Migration(arrays=_cuts_at_once),
}
