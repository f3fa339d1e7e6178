"""Teachers as data: what they demonstrate, where it comes from, and the file it is kept in.

A demonstration leads from a start to an outcome: by a route, and by the actions of its teacher if he shows them. A
learner asks for the one `nearest` to what it wants and makes the outcome its own goal (emulation), pursues the
waypoints one after another (decomposition), or repeats the actions (mimicry).

A file of demonstrations is an `.npz` (numpy.savez) with these arrays and no others:

    format      []                  whole number, 1
    env         []                  text, the name of the task
    starts      [N, d]              where each begins, in the d abstract dimensions (m)
    outcomes    [N, d]              where it ends
    waypoints   [N, L, d]           the route without its start; the outcome, repeated, fills it up
    lengths     [N]                 whole numbers, the env steps of each, from 1 to T - 1
    states      [N, T, state]       the state before each env step, then the last one, repeated
    actions     [N, T, action]      what was done in each env step, in [-1, 1], then anything

The last three are there together or not at all: a teacher may show no actions.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from envs import routes
from envs.arena import FREE, GOAL, ROBOT
from envs.common import files, reading
from envs.common.errors import UserError
from envs.common.files import nearest_file
from star.config.section import ConfigError
from star.spec import Spec

FORMAT = 1  # of files
ENDINGS = (".npz",)
BEYOND = 0.25  # how far out of the space a file's points may be, as a share of its extent
SAME = 1e-3  # m between two points that are meant to be one
STANDING = 0.5  # height of a body above the floor, in m, as in the goals of Ant Fall
MAX_ARRAYS = 16  # in a file
MAX_BYTES = 4 * 2**30  # of all arrays of a file
MAX_ENDS = 128  # cells of a maze between which routes are shown


class Demonstrations(struct.PyTreeNode):
    """N demonstrations, in the d abstract dimensions (m). `states`, `actions` and `lengths` are None without actions.

    Waypoints leave out the start; the outcome, repeated, fills them up to L. A trajectory has `lengths[n]` env steps,
    from 1 to T - 1: `actions[n, t]` was done in `states[n, t]`, and `states[n, lengths[n]]`, repeated, is its end.
    """

    starts: Float[Array, "N d"]
    outcomes: Float[Array, "N d"]
    waypoints: Float[Array, "N L d"]
    states: Float[Array, "N T state"] | None = None
    actions: Float[Array, "N T act"] | None = None
    lengths: Int[Array, "N"] | None = None


def nearest(demos: Demonstrations, start: Float[Array, "*B d"] | None, goal: Float[Array, "*B d"]) -> Int[Array, "*B"]:
    """The demonstration that is nearest: by the squared distances of its start and its outcome, summed.

    Without `start` the outcome alone counts. Of several it is the first.
    """
    squared = _squared(goal, demos.outcomes)
    if start is not None:
        squared += _squared(start, demos.starts)
    return jnp.argmin(squared, axis=-1)


def shortest_paths(env: Any) -> Demonstrations:
    """Routes from every free cell of the map of `env` to every one that can be reached from it, itself included.

    They lead from centre to centre; waypoints are the centres where a shortest way turns (`envs.routes`), at `STANDING`
    above the floor. Of a map with more than `MAX_ENDS` free cells as many serve, evenly spread, and the robot's.
    """
    arena = env.arena
    free = list(arena.cells(FREE + ROBOT + GOAL))
    spread = np.linspace(0, len(free) - 1, min(len(free), MAX_ENDS)).astype(int)
    ends = {free[i] for i in spread} | {arena.origin}
    shown = [
        (arena.centre(start), way)
        for start in sorted(ends)
        for way in routes.routes(arena, start, ends, env.switch).values()
    ]
    longest = max(len(way) for _, way in shown)
    height = arena.floor_height + STANDING

    def abstract(points: list) -> Array:
        flat = np.asarray(points, np.float32)
        whole = np.concatenate([flat, np.full((*flat.shape[:-1], 1), height, np.float32)], axis=-1)
        return jnp.asarray(whole[..., np.asarray(env.abstract_indices)])

    return Demonstrations(
        starts=abstract([start for start, _ in shown]),
        outcomes=abstract([way[-1] for _, way in shown]),
        waypoints=abstract([way + [way[-1]] * (longest - len(way)) for _, way in shown]),
    )


def repetitive(demos: Demonstrations) -> Demonstrations:
    """A poor teacher: it always shows the same, the demonstration that leads farthest."""
    farthest = jnp.argmax(jnp.sum(jnp.square(demos.outcomes - demos.starts), axis=-1))
    return jax.tree.map(lambda x: x[farthest][None], demos)


def wrong_half(demos: Demonstrations, goal: Float[Array, "d"]) -> Demonstrations:
    """A poor teacher: it knows only the half of the outcomes that is farther from `goal`, the one that matters."""
    order = jnp.argsort(jnp.sum(jnp.square(demos.outcomes - goal), axis=-1))
    return jax.tree.map(lambda x: x[order[len(order) // 2 :]], demos)


def other_body(demos: Demonstrations) -> Demonstrations:
    """A poor teacher: each actuator does what the one before it should; routes are those of the mirrored maze.

    The mirror is halfway along the first dimension of all starts and outcomes, which stay as they are.
    """
    ends = jnp.concatenate([demos.starts, demos.outcomes])[:, 0]
    mirrored = demos.waypoints.at[..., 0].set(ends.min() + ends.max() - demos.waypoints[..., 0])
    arrived = (demos.waypoints == demos.outcomes[:, None]).all(axis=-1, keepdims=True)
    return demos.replace(
        waypoints=jnp.where(arrived, demos.waypoints, mirrored),
        actions=None if demos.actions is None else jnp.roll(demos.actions, 1, axis=-1),
    )


def save(path: Path, demos: Demonstrations, *, env: str, force: bool = False) -> None:
    """Write demonstrations in the task named `env`; an existing file is replaced only with `force`.

    Raises:
      UserError: in one line, if it cannot be written.
    """
    check_place(path, force=force)
    arrays: dict[str, Any] = {"format": FORMAT, "env": env}
    arrays |= {name: np.asarray(value) for name, value in vars(demos).items() if value is not None}
    with files.whole(path) as partial:
        np.savez_compressed(partial, **arrays)


def check_place(path: Path, *, force: bool = False) -> None:
    """Raise `UserError` in one line if `save` could not write `path`, or would replace it without `force`."""
    files.check(path, ENDINGS, force=force)


def load(path: Path, *, env: str, spec: Spec, sha256: str | None = None) -> Demonstrations:
    """Read demonstrations for the task named `env`.

    Raises:
      UserError: in one line, if there is no such file, it is malformed, made for something else, or has another
        checksum than `sha256`.
    """
    arrays = read(path)
    if sha256 is not None and files.sha256(path) != sha256:
        raise ConfigError(f"{path}: is not the file that the run began with; its SHA-256 was {sha256}")
    try:
        _check_about(arrays.pop("format", None), arrays.pop("env", None), env)
        _check_names(arrays)
        _check_shapes(arrays, {"d": len(spec.abstract_indices), "state": spec.state_dim, "action": spec.action_size})
        with np.errstate(over="ignore"):
            arrays = {k: v if k == "lengths" else v.astype(np.float32) for k, v in arrays.items()}
        _check_values(arrays, spec)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    return Demonstrations(**{k: jnp.asarray(v, jnp.int32 if k == "lengths" else None) for k, v in arrays.items()})


def checksum(source: str) -> str | None:
    """The SHA-256 of a teacher's file; None if there is none to read, which is told when its lessons are needed."""
    try:
        reading.check_regular(Path(source))
        return files.sha256(Path(source))
    except (OSError, ValueError):
        return None


_SHAPES = {
    "starts": ("N", "d"),
    "outcomes": ("N", "d"),
    "waypoints": ("N", "L", "d"),
    "states": ("N", "T", "state"),
    "actions": ("N", "T", "action"),
    "lengths": ("N",),
}
_TRAJECTORIES = ("states", "actions", "lengths")


def read(path: Path) -> dict[str, np.ndarray]:
    """The arrays in the file `path`; raises `UserError` in one line if it is no plain .npz of a moderate size."""
    try:
        reading.check_regular(path)
        with zipfile.ZipFile(path) as archive:
            _check_sizes(archive)
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            return {name: np.asarray(found[name]) for name in found.files}
    except UserError as error:
        raise ConfigError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file{nearest_file(path, ENDINGS)}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception:  # NumPy raises nearly anything for a file that is not what it seems
        raise ConfigError(f"{path}: is not an .npz of plain arrays") from None


def _check_sizes(archive: zipfile.ZipFile) -> None:
    """Raise `UserError` for what would take much memory to read: it can be written in a few bytes."""
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise ConfigError(f"holds {len(members)} arrays; allowed: up to {MAX_ARRAYS}")
    total = sum(member.file_size for member in members)
    if total > MAX_BYTES:
        raise ConfigError(f"holds {total / 2**30:.1f} GiB; allowed: up to {MAX_BYTES / 2**30:g} GiB")
    for member in members:
        with archive.open(member) as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
        if math.prod(shape) * dtype.itemsize > member.file_size:
            raise ConfigError(f"{member.filename} is shorter than it claims")


def _check_about(number: np.ndarray | None, name: np.ndarray | None, env: str) -> None:
    if number is None or name is None:
        raise ValueError(f"holds no {'format' if number is None else 'env'}; is it a file of demonstrations?")
    if number.shape or number.dtype.kind not in "iu" or number < 1:
        raise ValueError(f"format is not a whole number from 1 to {FORMAT}")
    if number > FORMAT:
        raise ValueError(f"format {number} is newer than {FORMAT}, the newest that this version reads")
    if name.shape or name.dtype.kind != "U":
        raise ValueError("env is not the name of a task")
    if str(name) != env:
        raise ValueError(f"holds demonstrations in {str(name)!r}, not in {env!r}")


def _check_names(arrays: dict[str, np.ndarray]) -> None:
    for name in arrays:
        if name not in _SHAPES:
            raise ValueError(f"holds an unknown array {name!r}; allowed: format, env, {', '.join(_SHAPES)}")
    shows_actions = any(name in arrays for name in _TRAJECTORIES)
    for name in _SHAPES:
        if name not in arrays and (shows_actions or name not in _TRAJECTORIES):
            raise ValueError(f"holds no {name}")


def _check_shapes(arrays: dict[str, np.ndarray], sizes: dict[str, int]) -> None:
    """`sizes` are those that are known; N, L and T are those of the first array that has them."""
    for name, axes in _SHAPES.items():
        if name not in arrays:
            continue
        array, whole = arrays[name], name == "lengths"
        if array.dtype.kind not in ("iu" if whole else "f"):
            raise ValueError(f"{name} is {array.dtype}; allowed: {'whole' if whole else 'floating-point'} numbers")
        allowed = [sizes.get(axis, axis) for axis in axes]
        fits = array.ndim == len(axes) and all(
            sizes.setdefault(axis, size) == size for axis, size in zip(axes, array.shape, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} has the shape {_listed(array.shape)}; allowed: {_listed(allowed)}")
        if not array.size:
            raise ValueError(f"{name} has the shape {_listed(array.shape)}: nothing is demonstrated")


def _check_values(arrays: dict[str, np.ndarray], spec: Spec) -> None:
    for name, array in arrays.items():
        _refuse(~np.isfinite(array), name, array, "finite numbers")
    lower, upper = np.asarray(spec.space)
    beyond = BEYOND * (upper - lower)
    lower, upper = lower - beyond, upper + beyond
    for name in ("starts", "outcomes", "waypoints"):
        bounds = f"{_listed(lower)} to {_listed(upper)}, around the task's space"
        _refuse((arrays[name] < lower) | (arrays[name] > upper), name, arrays[name], bounds)
    last = arrays["waypoints"][:, -1]
    astray = np.abs(last - arrays["outcomes"]).max(axis=-1) > SAME
    if astray.any():
        raise ValueError(f"waypoints{_listed([astray.argmax()])} do not end with its outcome")
    if "lengths" in arrays:
        actions, lengths, most = arrays["actions"], arrays["lengths"], arrays["states"].shape[1] - 1
        _refuse((lengths < 1) | (lengths > most), "lengths", lengths, f"1 to {most}, one below the number of states")
        _refuse(np.abs(actions) > 1, "actions", actions, "-1 to 1")


def _refuse(bad: np.ndarray, name: str, array: np.ndarray, allowed: str) -> None:
    if bad.any():
        where = np.argwhere(bad)[0]
        raise ValueError(f"{name}{_listed(where)} is {array[tuple(where)]:g}; allowed: {allowed}")


def _listed(values: Iterable[Any]) -> str:
    return f"[{', '.join(f'{value:g}' if isinstance(value, float) else str(value) for value in values)}]"


def _squared(points: Float[Array, "*B d"], others: Float[Array, "N d"]) -> Float[Array, "*B N"]:
    """Squared distances, summed one dimension after another: no array [*B, N, d] is made."""
    return sum((jnp.square(points[..., None, i] - others[:, i]) for i in range(others.shape[-1])), jnp.zeros(()))
