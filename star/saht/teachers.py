"""Teachers as data: the sequences that they show with their outcomes, and the file that these may come from.

A file is an `.npz` (numpy.savez) with these arrays and no others:

    format      []             whole number, 1
    world       []             text, the name of the world
    tasks       [N]            text, the task that each demonstration is of
    sequences   [N, L, p]      numbers in [-1, 1]
    lengths     [N]            whole numbers from 1 to L
    outcomes    [N, 4]         in the outcome space of the task, then 0
    pairs       [N, 2]         whole numbers: the tasks of the procedure that it was made of, or -1
    subgoals    [N, 2, 4]      in the outcome spaces of these tasks, then 0

The last two are there together or not at all. With them a file shows procedures too, to learners with any body.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from envs.common import files, modes
from envs.common.errors import shown
from envs.worlds import Task, World
from star.config.section import ConfigError
from star.saht.memory import Scale
from star.saht.sections import TeacherConfig
from star.sgim import teachers as sgim_teachers

FORMAT = 1
SKILFUL = 0.05  # a teacher shows goals that he reaches up to this share of the diagonal of the evaluation's goals
TRIES, ROUNDS = 64, 64  # goals that a teacher tries at once for each that he shows, and how often at most
_NAMES = ("format", "world", "tasks", "sequences", "lengths", "outcomes")
_PROCEDURES = ("pairs", "subgoals")


class Demonstrations(NamedTuple):
    """N demonstrations of one task, on the host."""

    sequences: Float[np.ndarray, "N L p"]
    lengths: Int[np.ndarray, "N"]
    outcomes: Float[np.ndarray, "N 4"]
    pairs: Int[np.ndarray, "N 2"]
    """Tasks of the procedures that they were made of; -1 if they were not."""
    subgoals: Float[np.ndarray, "N 2 4"]

    @classmethod
    def plain(cls, sequences: np.ndarray, lengths: np.ndarray, outcomes: np.ndarray) -> Demonstrations:
        """Those that are no procedures."""
        n = len(lengths)
        return cls(sequences, lengths, outcomes, np.full((n, 2), -1, np.int32), np.zeros((n, 2, 4), np.float32))


class Shown(struct.PyTreeNode):
    """The demonstrations of T teachers, up to D each; procedural ones of the world itself show none."""

    sequences: Float[Array, "T D L p"]
    lengths: Int[Array, "T D"]
    outcomes: Float[Array, "T D 4"]
    """Scaled."""
    pairs: Int[Array, "T D 2"]
    subgoals: Float[Array, "T D 2 4"]
    """Scaled."""
    counts: Int[Array, "T"]


def expanded(teachers: Sequence[TeacherConfig], world: World) -> tuple[TeacherConfig, ...]:
    """The same with a name and a task each, and the checksums of their files.

    Raises:
      UserError: in one line, if there is no such task, nobody can show it, or a name is given twice.
    """
    found: list[TeacherConfig] = []
    for number, teacher in enumerate(teachers):
        where = f"saht.teachers.{number}"
        able = [task.name for task in world.tasks if teacher.source != "world" or _can(task, teacher.kind)]
        if teacher.task is None and not able:
            raise ConfigError(f"{where}.kind: no task of {world.name} has a teacher of kind {teacher.kind}")
        if teacher.task is not None and teacher.task not in able:
            known = f"allowed: {', '.join(able) or 'none'}"
            raise ConfigError(
                f"{where}.task: nobody shows {shown(teacher.task)} as {teacher.kind} in {world.name}; {known}"
            )
        for task in able if teacher.task is None else [teacher.task]:
            own: dict[str, str | None] = {"task": task, "name": teacher.name or f"{teacher.kind}_{task}"}
            if teacher.source != "world" and teacher.sha256 is None:
                own["sha256"] = sgim_teachers.checksum(teacher.source)
            found.append(teacher.model_copy(update=own))
    names = [teacher.name for teacher in found]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"saht.teachers: {name} is given twice; allowed: each name once")
    return tuple(found)


def shown_by(teachers: Sequence[TeacherConfig], world: World, scale: Scale) -> Shown:
    """Their demonstrations, scaled; raises `UserError` in one line if a file is wrong."""
    all_shown = [_demonstrations(teacher, world, scale) for teacher in teachers]
    most = max((len(demos.lengths) for demos in all_shown), default=1)

    def stacked(leaves: Sequence[np.ndarray]) -> Array:
        return jnp.stack([jnp.asarray(np.resize(leaf, (most, *leaf.shape[1:]))) for leaf in leaves])

    if not all_shown:
        all_shown = [_nothing(world)]
    sequences, lengths, outcomes, pairs, subgoals = (stacked(leaves) for leaves in zip(*all_shown, strict=True))
    tasks = np.array([world.index(teacher.task or 0) for teacher in teachers] or [0])
    outcomes = (outcomes - scale.lower[tasks, None]) / scale.width[tasks, None]
    subgoals = (subgoals - jnp.asarray(scale.lower)[pairs]) / jnp.asarray(scale.width)[pairs]
    counts = jnp.array([len(demos.lengths) for demos in all_shown])
    return Shown(sequences, lengths, outcomes, pairs, subgoals, counts)


def _demonstrations(teacher: TeacherConfig, world: World, scale: Scale) -> Demonstrations:
    if teacher.source == "world":
        if teacher.kind == "procedure":
            return _nothing(world)
        demos = demonstrated(world, world.index(teacher.task or 0), teacher.demos, scale)
    else:
        demos = load(Path(teacher.source), world, teacher.task or "", sha256=teacher.sha256)
    if teacher.kind == "procedure":
        made = demos.pairs[:, 0] >= 0
        if not made.any():
            raise ConfigError(f"{teacher.source}: shows no procedure of {teacher.task}")
        return Demonstrations(*(leaf[made] for leaf in demos))
    if teacher.flaw == "repetitive":
        return Demonstrations(*(leaf[:1] for leaf in demos))
    if teacher.flaw == "other_body":
        return demos._replace(sequences=np.roll(demos.sequences, 1, axis=-1))
    return demos


def _nothing(world: World) -> Demonstrations:
    sequences = np.zeros((1, world.longest, world.primitive), np.float32)
    return Demonstrations.plain(sequences, np.ones(1, np.int32), np.zeros((1, 4), np.float32))


def demonstrated(world: World, task: int, count: int, scale: Scale) -> Demonstrations:
    """Demonstrations of the world's own teacher without noise: goals drawn evenly, of which reached ones count.

    Raises:
      UserError: in one line, if he reaches too few.
    """
    lower, upper = jnp.asarray(world.lower)[task], jnp.asarray(world.upper)[task]
    reach = np.linalg.norm(np.ptp(world.benchmark(task), axis=0) / scale.width[task])
    kept: list[tuple[np.ndarray, ...]] = []
    for turn in range(ROUNDS):
        key = modes.key(task) if turn == 0 else jax.random.fold_in(modes.key(task), turn)
        goals = jax.random.uniform(key, (TRIES * count, 4), minval=lower, maxval=upper)
        sequences, lengths = world.demonstrate(task, goals)
        found = world.execute(jnp.clip(sequences, -1.0, 1.0), lengths, key=key)
        apart = jnp.linalg.norm((found.value[:, task] - goals) / scale.width[task], axis=-1)
        near = np.asarray(found.reached[:, task] & (apart < SKILFUL * reach))
        shown = jnp.clip(sequences, -1.0, 1.0), lengths, found.value[:, task]
        kept.append(tuple(np.asarray(leaf)[near] for leaf in shown))
        together = [np.concatenate(leaves)[:count] for leaves in zip(*kept, strict=True)]
        if len(together[0]) == count:
            return Demonstrations.plain(*together)
    raise ConfigError(
        f"saht.teachers: the teacher of {world.names[task]} reaches {len(together[0])} of {ROUNDS * TRIES * count} "
        f"goals; allowed: at least {count}, its demos"
    )


def save(path: Path, world: World, tasks: Sequence[str], demos: Demonstrations) -> None:
    """Write demonstrations of these tasks [N]; an existing file is replaced. Raises `UserError`."""
    arrays: dict[str, Any] = {"format": FORMAT, "world": world.name, "tasks": np.asarray(tasks)} | demos._asdict()
    with files.whole(path) as partial:
        np.savez_compressed(partial, **arrays)


def load(path: Path, world: World, task: str, *, sha256: str | None = None) -> Demonstrations:
    """Those of a task in a file.

    Raises:
      UserError: in one line, if there is no such file, it is malformed, made in another world, has none of the task, or
        another checksum than `sha256`.
    """
    arrays = sgim_teachers.read(path)
    if sha256 is not None and files.sha256(path) != sha256:
        raise ConfigError(f"{path}: is not the file that the run began with; its SHA-256 was {sha256}")
    try:
        _check(arrays, world)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    mine = arrays["tasks"] == task
    if not mine.any():
        there = ", ".join(dict.fromkeys(map(str, arrays["tasks"])))
        raise ConfigError(f"{path}: shows nothing of {task}; it holds {there}")
    found = Demonstrations.plain(
        arrays["sequences"][mine].astype(np.float32),
        arrays["lengths"][mine].astype(np.int32),
        arrays["outcomes"][mine].astype(np.float32),
    )
    own = {name: arrays[name][mine].astype(getattr(found, name).dtype) for name in _PROCEDURES if name in arrays}
    return found._replace(**own)


def _check(arrays: dict[str, np.ndarray], world: World) -> None:
    """Raise `ValueError` unless the arrays are demonstrations in this world."""
    wanted = _NAMES + _PROCEDURES * any(name in arrays for name in _PROCEDURES)
    for name in (*wanted, *arrays):
        if name not in arrays:
            raise ValueError(f"holds no {name}; is it a file of demonstrations in a world?")
        if name not in wanted:
            raise ValueError(f"holds an unknown array {name!r}; allowed: {', '.join(_NAMES + _PROCEDURES)}")
    if arrays["format"].shape or arrays["format"].dtype.kind not in "iu" or arrays["format"] != FORMAT:
        raise ValueError(f"format is not {FORMAT}, the one that this version reads")
    if str(arrays["world"]) != world.name:
        raise ValueError(f"holds demonstrations in {str(arrays['world'])!r}, not in {world.name!r}")
    n = len(np.atleast_1d(arrays["tasks"]))
    shapes = {"tasks": (n,), "sequences": (n, world.longest, world.primitive), "lengths": (n,), "outcomes": (n, 4)}
    shapes |= {"pairs": (n, 2), "subgoals": (n, 2, 4)}
    kinds = {"tasks": "U", "sequences": "f", "lengths": "iu", "outcomes": "f", "pairs": "iu", "subgoals": "f"}
    for name in wanted[2:]:
        array, shape = arrays[name], shapes[name]
        if array.shape != shape or array.dtype.kind not in kinds[name]:
            raise ValueError(
                f"{name} is {array.dtype}{list(array.shape)}; allowed: {list(shape)} of kind {kinds[name]}"
            )
    limits = {"sequences": (-1, 1), "lengths": (1, world.longest), "outcomes": (-np.inf, np.inf)}
    limits |= {"pairs": (-1, len(world.tasks) - 1), "subgoals": (-np.inf, np.inf)}
    for name in wanted[3:]:
        low, high = limits[name]
        bad = ~(np.isfinite(arrays[name]) & (arrays[name] >= low) & (arrays[name] <= high))
        if bad.any():
            where = np.argwhere(bad)[0]
            allowed = f"{low:g} to {high:g}" if np.isfinite(low) else "finite numbers"
            raise ValueError(f"{name}{where.tolist()} is {arrays[name][tuple(where)]:g}; allowed: {allowed}")


def _can(task: Task, kind: str) -> bool:
    """True if the world itself can show a task so."""
    return (task.decompose if kind == "procedure" else task.demonstrate) is not None
