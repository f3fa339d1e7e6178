"""Check that a run survives kills and damaged checkpoints, and half an hour without growth of memory.

    python scripts/checks/soak.py kills [--kills 100] [--damages 20] [--out results/soak/kills_cpu.json]
    python scripts/checks/soak.py memory configs/ant_maze.yaml [--minutes 30] [--out FILE] [--section.key VALUE ...]

`kills` trains a tiny Point Maze on the CPU, kills it with SIGKILL at random moments (every second time while it writes
a checkpoint) and resumes it, until it ends; then again, until there were enough kills. Each end has to be that of a
run which nobody killed: all arrays of the last checkpoint bit for bit, and all rows of metrics.jsonl and regions.jsonl
but their wall-clock. After that the newest checkpoint is truncated, a bit of it flipped, or half of its files deleted,
and every resume has to go on from the one before. Exits with 1 if anything of that fails.

`memory` trains and measures the memory of the first device and of this process every few seconds. `growth` compares the
last minute with the first one after `--settle` minutes. Results are JSON, printed and written to `--out`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from scripts.processes import importing
from star.cli.words import split_settings
from star.config.loading import load
from star.training import provenance, trainer
from star.training.checkpoint import Checkpoints
from star.training.journal import Journal
from star.training.signals import leave

ROOT = Path(__file__).parents[2]
TIMES = ("wall_s", "env_steps_per_s")
KINDS = ("truncated", "bit flipped", "half deleted")
EPOCHS = 40
SETTINGS = {
    "env.engine": "jax",
    "env.options.episode_length": 60,
    "commander.period": 20,
    "tutor.unroll": 3,
    "tutor.ppo.hidden": [8],
    "controller.ppo.hidden": [8],
    "abstraction.max_regions": 8,
    "abstraction.cuts": [[8.0], [8.0]],
    "forward_model.hidden": [8],
    "forward_model.buffer_size": 256,
    "forward_model.batch_size": 8,
    "refinement.min_transitions": 1,
    "refinement.min_visits": 1,
    "refinement.depth": 1,
    "refinement.pairs_per_epoch": 1,
    "trainer.num_envs": 4,
    "trainer.num_seeds": 2,
    "trainer.total_env_steps": EPOCHS * 4 * 60,
    "trainer.eval_every": 2,
    "trainer.eval_episodes": 3,
    "trainer.checkpoint_every": 1,
    "trainer.device": "cpu",
}


class Soak:
    """Runs of one experiment in a folder, and the chance that decides when they are killed."""

    def __init__(self, folder: Path, *, seed: int) -> None:
        self.folder = folder
        self.chance = random.Random(seed)
        cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "jax"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        self._environment = os.environ | cache | {"JAX_PLATFORMS": "cpu"} | importing(ROOT)

    def start(self, run: Path) -> subprocess.Popen:
        """Begin the run, or go on with it, as a job of a cluster would."""
        settings = [word for key, value in SETTINGS.items() for word in (f"--{key}", json.dumps(value))]
        begin = [str(ROOT / "configs" / "point_maze.yaml"), *settings, "--run-dir", str(run)]
        how = ["--resume", str(run)] if (run / "config.yaml").exists() else begin
        with run.with_suffix(".err").open("w") as err:
            command = [sys.executable, "-m", "star", "train", *how, "--quiet"]
            return subprocess.Popen(command, env=self._environment, stdout=subprocess.DEVNULL, stderr=err)

    def finish(self, run: Path) -> None:
        """Train to the end; SystemExit if that fails."""
        process = self.start(run)
        if process.wait() != 0:
            raise SystemExit(f"error: a resume failed: {said(run)}")

    def killed(self, run: Path, *, when: Callable[[], bool], then_s: float = 0.0) -> bool:
        """Train until `when` holds and at most `then_s` longer; whether it was killed then and had not ended."""
        process = self.start(run)
        while process.poll() is None and not when():
            time.sleep(0.001)
        until = time.monotonic() + self.chance.uniform(0.0, then_s)
        while process.poll() is None and time.monotonic() < until:
            time.sleep(0.001)
        process.kill()
        code = process.wait()
        if code not in (0, -signal.SIGKILL):
            raise SystemExit(f"error: a resume failed: {said(run)}")
        return code != 0


def said(run: Path) -> str:
    """Stderr of the latest process of `run`."""
    return run.with_suffix(".err").read_text()


def unfinished(run: Path) -> set[tuple[str, int]]:
    """The checkpoints of `run` that are being written, or were when it was killed, by name and time of the folder."""
    found = set()
    for path in (run / "checkpoints").glob(".*.partial"):
        with contextlib.suppress(FileNotFoundError):
            found.add((path.name, path.stat().st_mtime_ns))
    return found


def steps(run: Path) -> list[int]:
    """Env steps of the checkpoints of `run`."""
    return Checkpoints(run).steps()


def end(run: Path) -> dict[str, Any]:
    """The parts that have to be the same whether or not a run was killed."""
    checkpoints, journal = Checkpoints(run), Journal.of(run, tables="regions")
    last = checkpoints.steps()[-1]
    checkpoints.check(last)
    arrays = {name: (x.dtype.str, x.shape, x.tobytes()) for name, x in checkpoints.arrays(last).items()}
    checkpoints.close()
    rows = [{k: v for k, v in row.items() if k not in TIMES} for row in journal.metrics.read()]
    return {"env_steps": last, "arrays": arrays, "metrics": rows, "regions": journal.tables.read()}


def differs(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """In what two ends differ."""
    found = [name for name in one["arrays"] | other["arrays"] if one["arrays"].get(name) != other["arrays"].get(name)]
    return found + [part for part in ("env_steps", "metrics", "regions") if one[part] != other[part]]


def damage(path: Path, kind: str, chance: random.Random) -> str:
    """Damage the checkpoint at `path`: the files concerned."""
    files = sorted(entry for entry in path.rglob("*") if entry.is_file())
    if kind == "half deleted":
        gone = chance.sample(files, len(files) // 2)
        for file in gone:
            file.unlink()
        return f"{len(gone)} of {len(files)} files"
    file = chance.choice([file for file in files if file.stat().st_size])
    data = bytearray(file.read_bytes())
    if kind == "truncated":
        file.write_bytes(data[: chance.randrange(len(data))])
    else:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        file.write_bytes(data)
    return str(file.relative_to(path))


def kills(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Kill, damage and compare."""
    soak = Soak(folder, seed=options.seed)
    soak.finish(folder / "reference")
    expected = end(folder / "reference")
    began = time.monotonic()
    soak.finish(folder / "again")  # compiled: how long a run takes that nobody kills
    took = time.monotonic() - began
    report: dict[str, Any] = {"epochs": EPOCHS, "uninterrupted_s": round(took, 1), "kills": 0, "kills_while_writing": 0}
    report |= {"kills_before_the_first_checkpoint": 0, "kills_before_config_yaml": 0, "damages": 0, "damaged": []}
    report |= {"resumed_from_the_one_before": 0, "runs_compared": 0, "differences": []}

    def compare(run: Path) -> None:
        report["runs_compared"] += 1
        report["differences"] += differs(expected, end(run))
        print(f"{run.name}: ended, differences {report['differences']}", flush=True)
        shutil.rmtree(run)

    compare(folder / "again")
    while report["kills"] < options.kills:
        run = folder / f"killed-{report['runs_compared']}"
        left = unfinished(run)
        while report["kills"] < options.kills and kill(soak, run, took, writing=report["kills"] % 2 == 0):
            report["kills"] += 1
            left, before = unfinished(run), left
            report["kills_while_writing"] += bool(left - before)
            report["kills_before_the_first_checkpoint"] += not steps(run)
            report["kills_before_config_yaml"] += not (run / "config.yaml").exists()
            print(f"{run.name}: kill {report['kills']}, checkpoints {steps(run)}", flush=True)
        soak.finish(run)
        compare(run)
    while report["damages"] < options.damages:
        run = folder / f"damaged-{report['runs_compared']}"
        while report["damages"] < options.damages:
            if len(steps(run)) < 2:
                soak.killed(run, when=lambda run=run: len(steps(run)) >= 2, then_s=0.5 * took)
            if steps(run)[-1] >= expected["env_steps"]:
                break
            one = damage_and_resume(soak, run, KINDS[report["damages"] % len(KINDS)], then_s=0.3 * took)
            report["damages"] += 1
            report["damaged"].append(one)
            report["resumed_from_the_one_before"] += one["said"] and one["resumed_from"] == one["before"]
            print(f"{run.name}: damage {report['damages']}, {one}", flush=True)
        soak.finish(run)
        compare(run)
    return report


def kill(soak: Soak, run: Path, took: float, *, writing: bool) -> bool:
    """Go on with `run` and kill it at a random moment, if `writing` at one when a checkpoint is being written."""
    until, left = time.monotonic() + soak.chance.uniform(0.0, 1.1 * took), unfinished(run)

    def now() -> bool:
        return time.monotonic() > until and (not writing or bool(unfinished(run) - left))

    return soak.killed(run, when=now, then_s=0.05 if writing else 0.0)


def damage_and_resume(soak: Soak, run: Path, kind: str, *, then_s: float) -> dict[str, Any]:
    """Damage the newest checkpoint of `run` and go on with it for at most `then_s` seconds."""
    *_, before, newest = steps(run)
    what = damage(run / "checkpoints" / str(newest), kind, soak.chance)
    began = Journal.of(run, tables="regions").provenance
    times = len(began.read())
    soak.killed(run, when=lambda: len(began.read()) > times, then_s=then_s)
    return {
        "kind": kind,
        "what": what,
        "newest": newest,
        "before": before,
        "resumed_from": began.read()[-1]["env_steps"],
        "said": "is damaged" in said(run) and f"goes on from {before:,} env steps" in said(run),
    }


def memory(options: argparse.Namespace, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Train for so many minutes and watch the memory."""
    config = load(options.config, dict(settings) | {"trainer.total_env_steps": 10**15})
    samples: list[dict[str, float]] = []
    over = threading.Event()

    def watch(began: float) -> None:
        while not over.wait(options.every):
            samples.append({"s": round(time.monotonic() - began, 1)} | in_use())
            if len(samples) % max(round(60 / options.every), 1) == 0:
                print(samples[-1], flush=True)
            if samples[-1]["s"] > 60 * options.minutes:
                os.kill(os.getpid(), signal.SIGTERM)
                return

    thread = threading.Thread(target=watch, args=(time.monotonic(),), daemon=True)
    with tempfile.TemporaryDirectory() as folder:
        thread.start()
        try:
            result = trainer.train(config, Path(folder) / "run", quiet=True)
        finally:
            over.set()
            thread.join()
    return {
        "config": str(options.config),
        "env_steps": result.env_steps,
        "growth": growth(samples, settle_s=60 * options.settle),
        "samples": samples,
    }


def in_use() -> dict[str, float]:
    """Memory in MiB: of the first device in use and at its peak, if it tells, and resident of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    found = {"host_mib": pages * os.sysconf("SC_PAGE_SIZE") / 2**20}
    told = jax.local_devices()[0].memory_stats() or {}
    for key, name in (("bytes_in_use", "device_mib"), ("peak_bytes_in_use", "device_peak_mib")):
        if key in told:
            found[name] = told[key] / 2**20
    return {name: round(value, 1) for name, value in found.items()}


def growth(samples: Sequence[Mapping[str, float]], *, settle_s: float) -> dict[str, Any]:
    """Of each kind of memory the highest value in the minute after `settle_s` and in the last minute, and the growth.

    Empty if the samples do not reach so far.
    """
    end = samples[-1]["s"] if samples else 0.0
    first = [one for one in samples if settle_s <= one["s"] < settle_s + 60]
    last = [one for one in samples if one["s"] >= max(end - 60, settle_s)]
    if not first:
        return {}
    found = {}
    for name in [name for name in first[0] if name.endswith("_mib")]:
        before, after = (max(one[name] for one in part) for part in (first, last))
        found[name] = {"before": before, "after": after, "growth": round(after - before, 1)}
    return found


def main() -> None:
    words, settings = split_settings(sys.argv[1:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("kills")
    one.add_argument("--kills", type=int, default=100)
    one.add_argument("--damages", type=int, default=20)
    one.add_argument("--seed", type=int, default=0, help="of the moments and of the damage")
    two = commands.add_parser("memory")
    two.add_argument("config", type=Path)
    two.add_argument("--minutes", type=float, default=30.0)
    two.add_argument("--settle", type=float, default=5.0, help="minutes after which memory should not grow")
    two.add_argument("--every", type=float, default=5.0, help="seconds between samples")
    for command in (one, two):
        command.add_argument("--out", type=Path)
        command.add_argument("--commit", help="what to record where there is no git")
    options = parser.parse_args(words)
    if options.command == "kills":
        with tempfile.TemporaryDirectory() as folder:
            report = kills(options, Path(folder))
        failed = bool(report["differences"]) or report["resumed_from_the_one_before"] < report["damages"]
    else:
        report, failed = memory(options, settings), False
    made = provenance.here() | ({"commit": options.commit} if options.commit else {})
    command = shlex.join(["python", "scripts/checks/soak.py", *sys.argv[1:]])
    text = json.dumps({"command": command} | made | report, indent=1)
    print(text)
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(text + "\n", encoding="utf-8")
    sys.exit(leave(int(failed)))


if __name__ == "__main__":
    main()
