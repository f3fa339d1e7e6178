"""Checkpoints: whole runs on disk, each a folder `checkpoints/<env_steps>/` that appears whole or not at all.

    state/       the arrays, as orbax writes them
    about.json   format, env_steps, the first measure, config, and what wrote it: commit, device, python, versions
    SHA256SUMS   checksums of all other files, as `sha256sum --check` reads them

They are written to a hidden folder, flushed to the disk, and renamed. orbax renames too, but flushes nothing and knows
no checksums; as these must be inside before the name appears, the rename is done here. A checkpoint that is not what
was written is `Damaged`. The latest few are kept and, besides, the one with the best evaluation.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.common import files
from star import devices
from star._quiet import ocp
from star.config import agents, kinds
from star.config.kinds import About, Arrays, Kind, Measure
from star.config.loading import DEFAULT, parse
from star.config.run import RunConfig
from star.config.section import ConfigError
from star.training import program as programs
from star.training import provenance
from star.training.compatibility import check_compatible
from star.training.glibc import memory_given_back
from star.training.program import Program
from star.training.state import assembled, leaf_name, plain, with_keys

SUMS = "SHA256SUMS"
_ABOUT = "about.json"
_MERGED = "manifest.ocdbt"  # of orbax, once all that was written is found
_WRITING, _LEAVING = ".partial", ".removed"  # hidden folders that a process which was killed may leave
_ASIDE = ".damaged"
_CHUNK = 2**24  # bytes of an array that are compressed as one: by default 2 GiB, so that few cores would compress


class Damaged(ConfigError):
    """A checkpoint is not what was written."""


class Checkpoints:
    """The checkpoints of one run directory. Only the process that trains there may save or set aside."""

    def __init__(self, run_dir: Path, *, keep: int = 3) -> None:
        self._path = run_dir / "checkpoints"
        self._keep = keep
        self._arrays: ocp.Checkpointer | None = None

    def save(self, env_steps: int, state: Any, config: RunConfig, *, score: float | None) -> None:
        """Write `state` as `checkpoints/<env_steps>`; `score`, the latest evaluation's first measure, decides the best.

        Raises `UserError` if that cannot be done; what was there before still is. Several processes call this alike;
        each writes its share of the arrays, the first one the rest.
        """
        kind = kinds.of(config)
        about = {"format": kind.format, "env_steps": env_steps, kind.measures[0].name: score}
        about |= provenance.here(devices=config.trainer.devices)
        target, writing = self._path / str(env_steps), self._path / f".{env_steps}{_WRITING}"
        try:
            if devices.first():
                self._path.mkdir(parents=True, exist_ok=True)
                self._clean()
                writing.mkdir()
            devices.wait("there is a folder to write to")
            arrays = plain(state)
            chunked = jax.tree.map(lambda _: ocp.SaveArgs(chunk_byte_size=_CHUNK), arrays)
            with memory_given_back():
                self._open().save(writing.absolute() / "state", args=ocp.args.StandardSave(arrays, chunked))
            if devices.first():
                if not (writing / "state" / _MERGED).exists():  # orbax would only have warned
                    raise OSError(errno.EIO, "orbax has not put its parts together")
                text = json.dumps(about | {"config": config.model_dump(mode="json")}, indent=1)
                (writing / _ABOUT).write_text(text + "\n", encoding="utf-8")
                (writing / SUMS).write_text(_sums(writing), encoding="utf-8")
                for path in (*writing.rglob("*"), writing):
                    files.sync(path)
                self._remove(target)
                os.rename(writing, target)
                files.sync(self._path)
                self._retire(env_steps, kind.measures[0])
            devices.wait("the checkpoint is there")
        except (OSError, ValueError, RuntimeError) as error:  # of all these kinds are those of the library that writes
            shutil.rmtree(writing, ignore_errors=True)
            raise ConfigError(f"{target}: cannot be written: {_cause(error)}; earlier ones are intact") from None

    def steps(self) -> list[int]:
        """Env steps of the checkpoints on disk, oldest first."""
        if not self._path.is_dir():
            return []
        return sorted(int(entry.name) for entry in self._path.iterdir() if entry.name.isdecimal())

    def best(self) -> int:
        """Env steps of the one with the best evaluation, the latest of equals; `Damaged` if one does not tell."""
        steps = self.steps()
        measure = self._kind(steps[-1]).measures[0]
        return best({step: measure.rank(self._score(step, measure)) for step in steps})

    def check(self, step: int) -> None:
        """Raise `Damaged` unless the checkpoint has the files that were written, byte for byte.

        Nothing is known of those of format 2, which had no checksums.
        """
        path = self._path / str(step)
        if _older(path).exists():
            return
        try:
            expected, found = (path / SUMS).read_text(encoding="utf-8"), _sums(path)
        except FileNotFoundError:
            raise Damaged(f"{path}: is damaged: {SUMS} is missing") from None
        except (OSError, ValueError) as error:
            raise Damaged(f"{path}: is damaged: {_cause(error)}") from None
        if expected != found:
            was, now = (
                dict(line.split("  ", 1)[::-1] for line in text.splitlines() if "  " in line)
                for text in (expected, found)
            )
            wrong = [name for name in sorted(was | now) if was.get(name) != now.get(name)] or [SUMS]
            fault = "is missing" if wrong[0] in was.keys() - now.keys() else f"differs from {SUMS}"
            others = f", and {len(wrong) - 1} more are wrong" if len(wrong) > 1 else ""
            raise Damaged(f"{path}: is damaged: {wrong[0]} {fault}{others}")

    def set_aside(self, step: int) -> Path:
        """Rename a damaged checkpoint, so that it is none any more; it is removed once its step is saved again."""
        aside = self._aside(step)
        if not devices.first():
            return aside
        try:
            self._clean()
            self._remove(aside)
            os.rename(self._path / str(step), aside)
        except OSError as error:
            raise ConfigError(f"{aside}: cannot be written: {error.strerror}") from None
        return aside

    def config(self, step: int) -> Any:
        """The configuration inside a checkpoint."""
        about = self._kind(step).migrated(self._about(step))
        return parse(about["config"], source=str(self._path / str(step)), kept=True)

    def restore(self, step: int, example: Any) -> Any:
        """The state saved at `step`, whatever devices it was saved on.

        `example` (arrays or their shapes) gives the structure it must have, and the devices: else the first one here.
        """
        here = devices.everywhere(None)

        def written(like: Any) -> jax.ShapeDtypeStruct:
            leaf = jax.eval_shape(plain, like)
            return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=getattr(like, "sharding", None) or here)

        template = jax.tree.map(written, example)
        path, number = self._path / str(step), self._about(step)["format"]
        hook, sys.unraisablehook = sys.unraisablehook, partial(_report, sys.unraisablehook)
        try:
            kind = self._kind(step)
            if number == kind.format:
                saved = self._read(path, template)
            else:
                saved = assembled(kind.migrated_arrays(self.arrays(step), number), template)
        except (OSError, ValueError, KeyError, TypeError) as error:  # the hook stays, for reads that end after this
            raise Damaged(f"{path}: is damaged, or not a checkpoint of this configuration: {_reason(error)}") from None
        sys.unraisablehook = hook
        return with_keys(saved, example)

    def arrays(self, step: int) -> Arrays:
        """All that is saved at `step` by its name, such as `tutor/params/...`, as its format has it."""
        path = self._path / str(step)
        here = devices.everywhere(None)
        saved = self._open().metadata(path.absolute() / "state").item_metadata.tree
        template = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=here), saved)
        leaves, _ = jax.tree_util.tree_flatten_with_path(self._read(path, template))
        return {leaf_name(place): np.asarray(leaf) for place, leaf in leaves}

    def close(self) -> None:
        """Release orbax's threads."""
        if self._arrays is not None:
            self._arrays.close()
            self._arrays = None

    def _open(self) -> ocp.Checkpointer:
        if self._arrays is None:
            self._arrays = ocp.Checkpointer(ocp.StandardCheckpointHandler())
        return self._arrays

    def _read(self, path: Path, template: Any) -> Any:
        return self._open().restore(path.absolute() / "state", args=ocp.args.StandardRestore(template))

    def _about(self, step: int) -> About:
        """A checkpoint's words about itself, in its own format; raises `UserError` if that is none we read."""
        path = self._path / str(step)
        try:
            about = json.loads((_older(path) if _older(path).exists() else path / _ABOUT).read_text(encoding="utf-8"))
            number, _ = about["format"], about["config"].get
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise Damaged(f"{path}: is damaged, its config cannot be read: {_reason(error)}") from None
        kind = _kind(about)
        if isinstance(number, int) and number > kind.format:
            raise ConfigError(
                f"{path}: checkpoint format {number} is newer than {kind.format}, which this version reads"
            )
        if not kind.readable(number):
            raise ConfigError(
                f"{path}: checkpoint format {number} is none that this version reads, up to {kind.format}"
            )
        return about

    def _kind(self, step: int) -> Kind:
        return _kind(self._about(step))

    def _score(self, step: int, measure: Measure) -> float | None:
        """The measure noted with a checkpoint; raises `Damaged` if it cannot be read."""
        path = self._path / str(step)
        noted = path / "metrics" / "metrics" if _older(path).exists() else path / _ABOUT
        try:
            score = json.loads(noted.read_text(encoding="utf-8"))[measure.name]
            return None if score is None else float(score)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Damaged(f"{path}: is damaged, its {measure.name} cannot be read: {_cause(error)}") from None

    def _aside(self, step: int) -> Path:
        return self._path / f"{step}{_ASIDE}"

    def _retire(self, saved: int, measure: Measure) -> None:
        """Delete what `saved` makes superfluous."""
        self._remove(self._aside(saved))
        ranks: dict[int, float] = {}
        for step in self.steps():
            ranks[step] = measure.rank(None)
            with contextlib.suppress(Damaged):
                ranks[step] = measure.rank(self._score(step, measure))
        for step in ranks.keys() - kept(ranks, latest=self._keep):
            self._remove(self._path / str(step))

    def _remove(self, path: Path) -> None:
        """Delete a checkpoint: its name goes first, so that no half of it is ever one."""
        if path.exists():
            leaving = path.with_name(f".{path.name}{_LEAVING}")
            os.rename(path, leaving)
            shutil.rmtree(leaving)

    def _clean(self) -> None:
        """Delete what a process that was killed had not finished."""
        for entry in self._path.iterdir():
            if entry.name.startswith(".") and entry.name.endswith((_WRITING, _LEAVING)):
                shutil.rmtree(entry)


def best(ranks: Mapping[int, float]) -> int:
    """The step with the highest rank, the latest of equals."""
    return max(ranks, key=lambda step: (ranks[step], step))


def kept(ranks: Mapping[int, float], *, latest: int) -> set[int]:
    """The steps whose checkpoints stay: the `latest` ones, and the best."""
    return {*sorted(ranks)[-latest:], best(ranks)}


def newest(checkpoints: Checkpoints) -> tuple[int, dict[int, Damaged]]:
    """Env steps of the newest checkpoint that is not damaged, and what is wrong with each that is newer.

    Raises `Damaged` if there is none.
    """
    wrong: dict[int, Damaged] = {}
    for step in reversed(checkpoints.steps()):
        try:
            checkpoints.check(step)
            return step, wrong
        except Damaged as error:
            wrong[step] = error
    raise Damaged(f"{next(iter(wrong.values()))}, and there is no other that is not")


def load_state(program: Program, run_dir: Path, wanted: str) -> tuple[int, Any]:
    """(env steps, state of all seeds) of a checkpoint of `run_dir`: "last", "best" or its env steps."""
    with opened(run_dir) as checkpoints:
        step = choose(checkpoints, run_dir, wanted)
        return step, restore(program, checkpoints, step, source=run_dir)


@contextlib.contextmanager
def opened(run_dir: Path) -> Iterator[Checkpoints]:
    """The checkpoints of a run, closed again at the end."""
    checkpoints = Checkpoints(run_dir)
    try:
        yield checkpoints
    finally:
        checkpoints.close()


def choose(checkpoints: Checkpoints, run_dir: Path, wanted: str) -> int:
    """Env steps of the checkpoint of `run_dir` that a user wants: "last", "best" or its env steps.

    If the last one is damaged, that is said on stderr, and it is the one before it. Any other raises `Damaged` then.
    """
    steps = checkpoints.steps()
    if not steps:
        raise ConfigError(f"{run_dir}: holds no checkpoint")
    if wanted == "last":
        step, wrong = newest(checkpoints)
        for error in wrong.values():
            print(f"warning: {error}; instead of it, this is of {step:,} env steps", file=sys.stderr)
        return step
    if wanted == "best":
        step = checkpoints.best()
    elif wanted.isdecimal() and int(wanted) in steps:
        step = int(wanted)
    else:
        raise ConfigError(f"--checkpoint: {wanted!r} is not among last, best, {', '.join(map(str, steps))}")
    checkpoints.check(step)
    return step


def restore(program: Program, checkpoints: Checkpoints, step: int, *, source: Path) -> Any:
    """The state of all seeds in the checkpoint at `step`; raises `UserError` if it is none of `program`."""
    check_compatible(checkpoints.config(step), program.config, source=source)
    return checkpoints.restore(step, program.example())


def load_agent(
    config: RunConfig, run_dir: Path, *, checkpoint: str, agent: int | None, seed: int
) -> tuple[Program, Any, jax.Array]:
    """The agent of seed `agent` (None: the first) in a checkpoint of `run_dir`, and the key of its episodes.

    `seed` is the one that a user chose for the evaluation.
    """
    program = programs.build(config)
    number = agent_number(program.seeds, run_dir, agent)
    _, states = load_state(program, run_dir, checkpoint)
    key = program.evaluation_keys(seed, stream=programs.AFTERWARDS)[number]
    return program, of_one(states, number), key


@jax.jit
def of_one(states: Any, number: int) -> Any:
    """The state of the agent of that number; in one program, since to index leaf by leaf compiles one for each."""
    return jax.tree.map(lambda leaf: leaf[number], states)


def agent_number(seeds: Sequence[int], run_dir: Path, agent: int | None) -> int:
    """Index of the seed `agent` (None: the first) among the `seeds` of `run_dir`; raises `UserError` if it is none."""
    if agent is None:
        return 0
    if agent not in seeds:
        raise ConfigError(f"--seed: {agent} is not among those of {agents.told(run_dir)}: {', '.join(map(str, seeds))}")
    return seeds.index(agent)


def _kind(about: About) -> Kind:
    """That of the experiment which a checkpoint is of; raises `UserError` if it cannot be had."""
    return kinds.find(about["config"].get("experiment", DEFAULT))


def _reason(error: Exception) -> str:
    if "Requested shape" in str(error):
        return "its arrays have other shapes than this agent's, as if the environment had other sizes now"
    return " ".join(str(error).split())[:160]


def _report(hook: Callable[[Any], Any], failure: Any) -> None:
    """Tell `hook` of a failure in the background, unless it is that of a read that outlived a failed restore."""
    if "Event loop is closed" not in str(failure.exc_value):
        hook(failure)


def _older(path: Path) -> Path:
    """Paths in a checkpoint of format 2 of the parts of today's `about.json`."""
    return path / "config" / "metadata"


def _sums(path: Path) -> str:
    """The output of `sha256sum` for all files below `path` but its `SHA256SUMS`, in the order of their names."""

    def line(entry: Path) -> str:
        return f"{files.sha256(entry)}  {entry.relative_to(path).as_posix()}\n"

    with ThreadPoolExecutor() as pool:  # hashing large files is work for all cores
        return "".join(pool.map(line, sorted(x for x in path.rglob("*") if x.is_file() and x != path / SUMS)))


def _cause(error: Exception) -> str:
    """Why something could not be read or written, in a few words; libraries hide the system's in their own."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    known = (os.strerror(number) for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EFBIG))
    return next((text for text in known if text in str(error)), _reason(error))
