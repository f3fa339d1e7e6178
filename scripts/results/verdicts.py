"""STAR beside other agents on the ant tasks: who is ahead, by Welch's intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from scripts.results.rows import Row
from star.report import statistics

FOLDERS = {"Ant Maze": "ant_maze", "Ant Maze Cam": "ant_maze_cam", "Ant Fall": "ant_fall", "labyrinth": "ant_labyrinth"}
AGENTS = {"STAR": "star", "GARA": "gara", "HIRO": "hiro", "HRAC": "hrac", "flat": "flat"}


class Verdict(NamedTuple):
    """STAR beside an agent in a task, by Welch's interval of the difference in success."""

    agent: str
    task: str
    ours: Row
    theirs: Row
    difference: tuple[float, float, float]

    @property
    def word(self) -> str:
        """`ahead` and `behind` where the interval leaves out 0."""
        _, low, high = self.difference
        return "ahead" if low > 0 else "behind" if high < 0 else "not told apart"

    @property
    def line(self) -> str:
        """A row of the table, marked if either row is of an older version."""
        mean, low, high = self.difference
        mark = self.theirs.mark or self.ours.mark
        told = f"{self.word} | {mean:+.2f} [{low:+.2f}, {high:+.2f}]"
        return f"| {self.agent}{mark}, {self.task} | {told} | {'/'.join(map(_budget, (self.ours, self.theirs)))} |"


def verdicts(rows: Mapping[str, Row]) -> list[Verdict]:
    """One for each task and rival that are measured."""
    found = []
    for task, folder in FOLDERS.items():
        ours = rows.get(f"{folder}/star")
        for agent, name in list(AGENTS.items())[1:]:
            theirs = rows.get(f"{folder}/{name}")
            if ours and theirs:
                found.append(Verdict(agent, task, ours, theirs, _difference(ours, theirs)))
    return found


def _budget(row: Row) -> str:
    """Seeds x million env steps of each."""
    return f"{len(row.report['seeds'])}x{row.report['env_steps_per_seed'] / 1e6:.1f}"


def _difference(ours: Row, theirs: Row) -> tuple[float, float, float]:
    episodes = min(row.report["seeds"][0]["episodes"] for row in (ours, theirs))
    found = statistics.difference({"": list(ours.scores)}, {"": list(theirs.scores)}, episodes=episodes)
    assert found is not None
    return found


def standing(found: Sequence[Verdict]) -> str:
    """The agents that STAR is not ahead of, with their tasks."""
    level: dict[str, list[str]] = {}
    for one in found:
        if one.word != "ahead":
            level.setdefault(one.agent, []).append(one.task)
    if not level:
        return "STAR is ahead of all agents that are measured, on every task."
    listed = "; ".join(f"{agent}: {', '.join(tasks)}" for agent, tasks in level.items())
    return f"**STAR is not ahead of** {listed}."


def unmeasured(rows: Mapping[str, Row]) -> str:
    """The agents without a row, with their tasks."""
    missing = {
        agent: [task for task, folder in FOLDERS.items() if f"{folder}/{name}" not in rows]
        for agent, name in AGENTS.items()
    }
    everywhere = len(FOLDERS)
    return "; ".join(
        agent if len(tasks) == everywhere else f"{agent} on {', '.join(tasks)}"
        for agent, tasks in missing.items()
        if tasks
    )
