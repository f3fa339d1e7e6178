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

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
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
    tasks = np.array([world.index(teacher.task or 0) for teacher in teachers] or [0])
    asked: dict[int, set[int]] = {}  # the tasks that the world's own teachers show so many times
    for teacher, task in zip(teachers, tasks.tolist(), strict=False):
        if teacher.source == "world" and teacher.kind != "procedure":
            asked.setdefault(teacher.demos, set()).add(task)
    own = {count: demonstrated(world, sorted(those), count, scale) for count, those in asked.items()}
    all_shown = [_demonstrations(teacher, world, own) for teacher in teachers] or [_nothing(world)]
    most = max(len(demos.lengths) for demos in all_shown)
    sequences, lengths, outcomes, pairs, subgoals = (
        np.stack([np.resize(leaf, (most, *leaf.shape[1:])) for leaf in leaves])
        for leaves in zip(*all_shown, strict=True)
    )
    outcomes = _scaled(outcomes, scale.lower[tasks, None], scale.width[tasks, None])
    subgoals = _scaled(subgoals, scale.lower[pairs], scale.width[pairs])
    counts = np.array([len(demos.lengths) for demos in all_shown])
    return Shown(*map(jnp.asarray, (sequences, lengths, outcomes, pairs, subgoals, counts)))


def _demonstrations(
    teacher: TeacherConfig, world: World, own: Mapping[int, Mapping[int, Demonstrations]]
) -> Demonstrations:
    """Those of a teacher; `own` are the world's, by their count and task."""
    if teacher.source == "world":
        if teacher.kind == "procedure":
            return _nothing(world)
        demos = own[teacher.demos][world.index(teacher.task or 0)]
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


def demonstrated(world: World, tasks: Sequence[int], count: int, scale: Scale) -> dict[int, Demonstrations]:
    """Demonstrations of each task by the world's own teacher: goals drawn evenly, of which reached ones count.

    Raises:
      UserError: in one line, if he reaches too few.
    """
    kept: dict[int, Demonstrations] = {}
    for turn in range(ROUNDS):
        for task, (goals, reached, demos) in _tried(world, tasks, TRIES * count, turn).items():
            reach = np.linalg.norm(np.ptp(world.benchmark(task), axis=0) / scale.width[task])
            apart = np.linalg.norm((demos.outcomes - goals) / scale.width[task], axis=-1)
            near = Demonstrations(*(leaf[reached & (apart < SKILFUL * reach)] for leaf in demos))
            together = zip(*([kept[task], near] if turn else [near]), strict=True)
            kept[task] = Demonstrations(*(np.concatenate(leaves)[:count] for leaves in together))
        if all(len(demos.lengths) == count for demos in kept.values()):
            return kept
    few = next(task for task in tasks if len(kept[task].lengths) < count)
    raise ConfigError(
        f"saht.teachers: the teacher of {world.names[few]} reaches {len(kept[few].lengths)} of "
        f"{ROUNDS * TRIES * count} goals; allowed: at least {count}, its demos"
    )


def _tried(
    world: World, tasks: Sequence[int], count: int, turn: int
) -> dict[int, tuple[np.ndarray, np.ndarray, Demonstrations]]:
    """Of each task goals [count, 4], which of them had an outcome, and what its teacher did for them.

    The programs of all tasks, and that which executes, compile side by side.
    """
    drawn = [_drawn(np.uint32(task), turn, world.lower[task], world.upper[task], count) for task in tasks]
    keys, goals = zip(*jax.device_get(drawn), strict=True)
    still = jnp.asarray(np.zeros((count, world.longest, world.primitive), np.float32))
    once = jnp.asarray(np.ones(count, np.int32))
    with ThreadPoolExecutor() as pool:
        compiles = pool.submit(world.execute, still, once, key=keys[0])
        done = [jax.device_get(one) for one in pool.map(world.demonstrate, tasks, goals)]
        compiles.result()
    tried = {}
    for task, key, goal, (sequences, lengths) in zip(tasks, keys, goals, done, strict=True):
        sequences = np.clip(sequences, -1.0, 1.0)
        found = jax.device_get(world.execute(sequences, lengths, key=key))
        demos = Demonstrations.plain(sequences, lengths, found.value[:, task])
        tried[task] = goal, found.reached[:, task], demos
    return tried


@partial(jax.jit, static_argnums=4)
def _drawn(task: Array, turn: Array, lower: Array, upper: Array, count: int) -> tuple[Array, Array]:
    """A key, and goals [count, 4] drawn evenly between bounds [4] with it."""
    first = modes.key(task)
    key = jnp.where(turn == 0, first, jax.random.fold_in(first, turn))
    return key, jax.random.uniform(key, (count, 4), minval=lower, maxval=upper)


@jax.jit
def _scaled(values: Array, lower: Array, width: Array) -> Array:
    return (values - lower) / width


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
