"""Claims about learners: found and wanted numbers over seeds, and the table that says which hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from star.report.statistics import stratified


class Claim(NamedTuple):
    """A claim, the finding, and True if it holds."""

    row: str
    """The letter of the claim on its page."""
    text: str
    value: float
    low: float
    high: float
    wanted: str
    holds: bool


def mean(row: str, text: str, sample: np.ndarray, wanted: str, passes: Callable[[float], bool]) -> Claim:
    """A claim about the mean of a sample."""
    value, low, high = stratified([sample], lambda x: x.mean())
    return Claim(row, text, float(value), float(low), float(high), wanted, passes(float(value)))


def ratio(
    row: str, text: str, one: np.ndarray, other: np.ndarray, wanted: str, passes: Callable[[float], bool]
) -> Claim:
    """A claim about the ratio of two means."""
    value, low, high = stratified([one, other], lambda x, y: x.mean() / y.mean())
    return Claim(row, text, float(value), float(low), float(high), wanted, passes(float(value)))


def less(row: str, text: str, one: np.ndarray, other: np.ndarray) -> Claim:
    """A claim that the mean of `one` is less than that of `other`."""
    value, low, high = stratified([one, other], lambda x, y: x.mean() - y.mean())
    return Claim(row, text, float(value), float(low), float(high), "below 0, interval too", bool(high < 0))


def shown(sample: np.ndarray, digits: int = 3) -> str:
    """`mean [low, high]` over seeds."""
    value, low, high = stratified([sample], lambda x: x.mean())
    return f"{value:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def told(claims: Sequence[Claim]) -> list[str]:
    """The lines of their table, in Markdown."""
    lines = ["| | claim | found | wanted | |", "|---|---|---|---|---|"]
    for one in claims:
        lines.append(
            f"| {one.row} | {one.text} | {one.value:.3f} [{one.low:.3f}, {one.high:.3f}] | {one.wanted} "
            f"| {'holds' if one.holds else '**failed**'} |"
        )
    return lines
