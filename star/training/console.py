"""The view of a run that goes on: a live view on a terminal, plain lines elsewhere."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress import ProgressColumn, Task
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from star.config.kinds import Kind, Measure
from star.training.experiment import Experiment
from star.training.journal import mean

Row = Mapping[str, Any]

_RECENT = 5  # how many of each part of a run make the estimate of the time left
_COMPILED = ("epoch", "evaluation")
_REDRAWN_PER_S = 2
_WIDTH = 90  # columns at most
_DEVICE_MEMORY = (("", "in_use"), ("peak_", "in_use"), ("", "limit"))
_BARS = "▁▂▃▄▅▆▇█"


class Stopwatch:
    """Durations of the parts of a run: "epoch", "evaluation", "checkpoint". The first of each takes longer."""

    def __init__(self, *, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._took: dict[str, list[float]] = {}
        self._part, self._since = "", now()

    @contextmanager
    def measure(self, part: str) -> Iterator[None]:
        """Time what is done inside."""
        self._part, self._since = part, self._now()
        try:
            yield
            self._took.setdefault(part, []).append(self._now() - self._since)
        finally:
            self._part = ""

    def last(self, part: str) -> float:
        """Seconds that the last of these took."""
        return self._took[part][-1]

    def expected(self, *parts: str) -> float:
        """Seconds that these parts will take if each does as the last did; without end if one was never timed."""
        return sum(self._took[part][-1] if part in self._took else float("inf") for part in parts)

    def compiling(self) -> float | None:
        """Seconds since the part that compiles now began, if one does."""
        first = self._part in _COMPILED and self._part not in self._took
        return self._now() - self._since if first else None

    def left(self, parts: Mapping[str, int]) -> float | None:
        """Seconds that so many of each part will take, as the latest did, if that is known of the epochs.

        The first of each, which may compile, says nothing of the others.
        """
        if len(self._took.get("epoch", ())) < 2:
            return None
        usual = {part: np.mean(took[1:][-_RECENT:]) for part, took in self._took.items() if len(took) > 1}
        return float(sum(count * usual.get(part, 0.0) for part, count in parts.items()))


class Display:
    """A live view on a terminal, one line per evaluation elsewhere, and nothing of either with `quiet`."""

    def __init__(
        self,
        console: Console,
        stopwatch: Stopwatch,
        *,
        experiment: Experiment,
        kind: Kind,
        title: str = "",
        total: int,
        done: int,
        quiet: bool = False,
    ) -> None:
        self._console, self._stopwatch, self._title, self._quiet = console, stopwatch, title, quiet
        self._experiment, self._kind = experiment, kind
        self._env_steps, self._total = done, total
        self._rows: Sequence[Row] = ()
        self._measured: dict[Measure, list[float]] = {measure: [] for measure in kind.measures}
        self._left_s: float | None = None
        self._counted_at = time.monotonic()
        self._stopping = False
        self._live = Live(console=console, get_renderable=self._view, refresh_per_second=_REDRAWN_PER_S)
        self._shown = console.is_terminal and not quiet

    def __enter__(self) -> Self:
        if self._shown:
            self._live.start()
        elif not self._quiet:
            self.say("compiling; then a line for each evaluation")
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._live.stop()

    def update(self, env_steps: int, rows: Sequence[Row], *, left_s: float | None) -> None:
        """Show the rows of one epoch, one per seed, and the seconds left if they are known."""
        self._env_steps, self._rows, self._left_s, self._counted_at = env_steps, rows, left_s, time.monotonic()
        for measure, values in self._measured.items():
            value = mean(rows, measure.key)
            if value is not None:
                values.append(value)
        if mean(rows, self._kind.measures[0].key) is not None and not self._quiet and not self._console.is_terminal:
            self.say(self._line())

    def say(self, line: str, *, style: str | None = None) -> None:
        """Print one line, above the view if there is one; from any thread."""
        self._console.print(line, style=style, highlight=False, markup=False, soft_wrap=True)

    def note(self, line: str) -> None:
        """Print one line that people want to know, unless they want quiet."""
        if not self._quiet:
            self.say(f"note: {line}")

    def warn(self, line: str) -> None:
        """Print one line that is worth notice, quiet or not."""
        self.say(f"warning: {line}", style="yellow")

    def stop(self) -> None:
        """Tell that the run ends after this epoch."""
        self._stopping = True

    def _line(self) -> str:
        parts = [f"{self._rows[0]['env_steps_per_s']:,.0f} {self._kind.unit}/s"]
        parts += [
            f"{measure.name} {_worded(measure, values[-1])}" for measure, values in self._measured.items() if values
        ]
        parts += [f"{name} {text}" for name, text in self._experiment.facts(self._rows).items()]
        if self._left_s is not None:
            parts.append(f"{self._left_s:.0f} s left")
        return f"{self._env_steps:,} / {self._total:,} {self._kind.unit}  " + "  ".join(parts)

    def _view(self) -> RenderableType:
        """The view as it is now."""
        facts = Table.grid(padding=(0, 2))
        facts.add_column(style="dim", no_wrap=True, min_width=10)
        facts.add_column(no_wrap=True, overflow="ellipsis")
        for name, value in self._facts():
            facts.add_row(name, value)
        parts = [self._head(), Text(""), facts]
        if self._rows:
            parts += [Text(""), _levels(self._rows, self._kind.levels)] if self._kind.levels else []
        width = min(_WIDTH, self._console.width)
        return Panel(Group(*parts), title=self._title, title_align="left", box=box.ROUNDED, width=width)

    def _head(self) -> RenderableType:
        """The current activity, its progress and remaining time."""
        seconds = self._stopwatch.compiling()
        if self._stopping:
            state, end = "stopping", "after this epoch"
        elif seconds is not None:
            state, end = "compiling", clock(seconds)
        else:
            state, end = "training", ""
            if self._left_s is not None:
                end = clock(max(self._left_s - (time.monotonic() - self._counted_at), 0.0)) + " left"
        head = Table.grid(expand=True, padding=(0, 1))
        head.add_column(no_wrap=True, min_width=9)
        head.add_column(ratio=1)
        head.add_column(no_wrap=True, justify="right")
        bar = ProgressBar(total=self._total, completed=self._env_steps)
        head.add_row(state, bar, f"{self._env_steps / self._total:.0%}  {end}".rstrip())
        return head

    def _facts(self) -> Iterator[tuple[str, str]]:
        speed = f", {self._rows[0]['env_steps_per_s']:,.0f}/s" if self._rows else ""
        yield self._kind.unit, f"{self._env_steps:,} of {self._total:,}{speed}"
        bars = "utf" in self._console.encoding
        for measure, values in self._measured.items():
            if values:
                line = f" {sparkline(values, share=measure.episodes is not None)}" if bars else ""
                yield measure.name.replace("_", " "), f"{_worded(measure, values[-1])}{line}"
        if self._rows:
            yield from self._experiment.facts(self._rows).items()
        yield "memory", memory()


def _worded(measure: Measure, value: float) -> str:
    return f"{value:.2f}" if measure.episodes else f"{value:.4g}"


def sparkline(values: Sequence[float], *, share: bool = True, width: int = 12) -> str:
    """Values as bars in the order of time, `width` of them at most, each the mean of as many values.

    The lowest bar is 0 and the highest 1 for a `share`, else the least and the greatest of the values.
    """
    numbers = np.nan_to_num(np.asarray(values, float))
    if not share:
        numbers = (numbers - numbers.min()) / max(float(np.ptp(numbers)), 1e-12)
    parts = np.array_split(np.clip(numbers, 0, 1), min(width, len(numbers)))
    return "".join(_BARS[min(int(part.mean() * len(_BARS)), len(_BARS) - 1)] for part in parts)


class Elapsed(ProgressColumn):
    """In a bar: how long the task has done what it does since `task.fields["since"]`, if that is not None."""

    def __init__(self, *, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now

    def render(self, task: Task) -> Text:
        """The time as `clock` has it."""
        since = task.fields["since"]
        return Text("" if since is None else clock(self._now() - since))


def clock(seconds: float) -> str:
    """Seconds as m:ss, or h:mm:ss from an hour on."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def memory() -> str:
    """The memory in use: of the first device, or of this process where the device does not tell."""
    found = jax.local_devices()[0].memory_stats() or {}
    if "bytes_in_use" in found:
        used, peak, limit = (found.get(f"{name}bytes_{end}", 0) / 2**30 for name, end in _DEVICE_MEMORY)
        return f"device {used:.1f} of {limit:.1f} GiB, peak {peak:.1f}"
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return f"host {pages * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB, peak {peak:.1f}"


def _levels(rows: Sequence[Row], levels: Mapping[str, Sequence[str | None]]) -> Table:
    """Reward and losses of the levels that there are."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim", pad_edge=False)
    table.add_column("level", style="dim", no_wrap=True)
    for name in ("reward", "actor loss", "critic loss"):
        table.add_column(name, justify="right", no_wrap=True)
    for level, keys in levels.items():
        values = [None if key is None else mean(rows, key) for key in keys]
        if any(value is not None for value in values):
            table.add_row(level, *("" if value is None else f"{value:.3g}" for value in values))
    return table
