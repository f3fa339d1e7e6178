"""Tune an agent on a task by successive halving, with the same budget for every agent.

    python scripts/tune.py TASK AGENT [--out FILE.json] [--runs FOLDER] [--env-steps 4e6 8e6] [-- SETTINGS]

The four configurations of AGENT in scripts/tune.yaml are trained with seeds 10 and 11 for 4 M env steps each; the best
two again with seeds 12 to 14 for 8 M, from the beginning. The better of these is chosen. AGENT is a name of
scripts/results/reproduce.py, such as hiro+td3_tutor; SETTINGS are laid over all configurations.

The measure is the mean over the seeds of success_any in `--episodes` greedy episodes on training goals: on those behind
walls, as straight ahead tells nothing of a maze; on Ant Fall on all of them. Test goals do not count.

Every program that has ended is in FILE.json (results/tuning/TASK/AGENT.json): scores, seeds, env steps, seconds,
command, commit and device. The same command goes on where it was interrupted, from the last checkpoint if `--runs` is
still there. A complete tuning is shown again and never written over.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import yaml

from envs.common import files
from envs.common.errors import UserError
from scripts.results import reproduce
from star.config.loading import load, read_file

CONFIGURATIONS = Path(__file__).with_suffix(".yaml")
BEHIND, ALL = "success_behind_walls", "success_any"
NOT_FINITE = 3  # exit code of `star train`


class Stage(NamedTuple):
    """So many configurations, each with these seeds side by side for so many env steps."""

    configurations: int
    seeds: tuple[int, ...]
    env_steps: int


STAGES = (Stage(4, (10, 11), 4_000_000), Stage(2, (12, 13, 14), 8_000_000))


def refuse(line: str) -> NoReturn:
    """End with exit code 2."""
    print(f"error: {line}", file=sys.stderr)
    raise SystemExit(2)


def plan(options: argparse.Namespace, shared: Mapping[str, Any]) -> dict[str, Any]:
    """The tuning: all that must be equal for it to go on; raises `UserError` for bad settings."""
    known = read_file(CONFIGURATIONS)
    if options.agent not in known:
        refuse(f"{options.agent}: has no configurations in {CONFIGURATIONS.name}; known are {', '.join(known)}")
    layers = reproduce.layer(options.agent)[1::2]
    for settings in known[options.agent].values():
        load(f"configs/{options.task}.yaml", {**settings, **shared}, layers=layers)
    stages = [one._replace(env_steps=steps) for one, steps in zip(STAGES, options.env_steps, strict=True)]
    return {
        "task": options.task,
        "agent": options.agent,
        "signal": options.signal or (ALL if options.task.startswith("ant_fall") else BEHIND),
        "episodes": options.episodes,
        "settings": dict(shared),
        "configurations": known[options.agent],
        "stages": [one._asdict() | {"seeds": list(one.seeds)} for one in stages],
    }


def words(settings: Mapping[str, Any]) -> list[str]:
    """Dotted settings as arguments of `star train`."""
    return [word for key, value in settings.items() for word in (f"--{key}", json.dumps(value).strip('"'))]


def opened(path: Path, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The tuning in `path`, or a new one."""
    if not path.exists():
        return {**wanted, "programs": [], "chosen": None}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        other = next((key for key in wanted if found[key] != wanted[key]), None)
    except (OSError, ValueError, KeyError, TypeError):
        refuse(f"{path}: is no tuning; choose another --out")
    if other is not None:
        refuse(f"{path}: is another tuning, with {other} {found[other]}, not {wanted[other]}; choose another --out")
    return found


def due(tuning: Mapping[str, Any], stage: int) -> list[str]:
    """Names of the configurations of a stage: all, or the best of the stage before; of equal ones the first."""
    count = tuning["stages"][stage]["configurations"]
    if stage == 0:
        return list(tuning["configurations"])[:count]
    before = {one["configuration"]: one["score"] for one in tuning["programs"] if one["stage"] == stage - 1}
    return sorted(due(tuning, stage - 1), key=lambda name: -before[name])[:count]


def trained(
    tuning: Mapping[str, Any], stage: int, name: str, options: argparse.Namespace, measure: Any = reproduce.measure
) -> dict[str, Any]:
    """A program of the tuning: trained, or gone on with, and evaluated. One that broke is worth 0."""
    one = tuning["stages"][stage]
    settings = {**tuning["configurations"][name], **tuning["settings"], "trainer.total_env_steps": one["env_steps"]}
    program = {"stage": stage, "configuration": name, "seeds": one["seeds"]}
    try:
        found = measure(tuning["task"], tuning["agent"], one["seeds"], options, words(settings), goals=("train",))
    except subprocess.CalledProcessError as error:
        if error.returncode == NOT_FINITE:
            return program | {"score": 0.0, "broke": "not finite", "command": shlex.join(map(str, error.cmd))}
        print(f"stopped: `star` ended with {error.returncode}; the same command goes on", file=sys.stderr)
        raise SystemExit(error.returncode) from None
    scores = [seed[tuning["signal"]] for seed in found["evaluated"]]
    if None in scores:
        refuse(f"--signal: no training goal of {tuning['task']} is behind a wall; allowed: {ALL}")
    last = found["rows"][-1]
    return program | {
        "score": float(np.mean(scores)),
        "scores": scores,
        "success_any": [seed["success_any"] for seed in found["evaluated"]],
        "env_steps": last["env_steps"],
        "seconds": round(last["wall_s"], 1),
        "run": found["run"],
    }


def tune(tuning: dict[str, Any], path: Path, options: argparse.Namespace, measure: Any = reproduce.measure) -> None:
    """Train what is missing of a tuning and write it down after each program."""
    began, work = time.monotonic(), 0.0
    costs = [one["configurations"] * len(one["seeds"]) * one["env_steps"] for one in tuning["stages"]]
    left = sum(costs) - sum(
        costs[one["stage"]] / tuning["stages"][one["stage"]]["configurations"] for one in tuning["programs"]
    )
    for stage, one in enumerate(tuning["stages"]):
        for name in due(tuning, stage):
            if any((old["stage"], old["configuration"]) == (stage, name) for old in tuning["programs"]):
                continue
            print(f"stage {stage + 1}: {name}, seeds {one['seeds']}, {one['env_steps']:,} env steps", flush=True)
            tuning["programs"].append(trained(tuning, stage, name, options, measure))
            write(tuning, path)
            cost = costs[stage] / one["configurations"]
            work, left = work + cost, left - cost
            rest = left * (time.monotonic() - began) / work
            print(f"  {tuning['signal']} {tuning['programs'][-1]['score']:.3f}; about {rest:,.0f} s left", flush=True)
    last = len(tuning["stages"]) - 1
    final = [one for one in tuning["programs"] if one["stage"] == last]
    tuning["chosen"] = max(final, key=lambda one: one["score"])["configuration"]
    write(tuning, path)


def write(tuning: Mapping[str, Any], path: Path) -> None:
    """All of it at once, so that a machine may be lost at any moment."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with files.whole(path) as partial:
        partial.write_text(json.dumps(tuning, indent=1) + "\n", encoding="utf-8")


def table(tuning: Mapping[str, Any]) -> str:
    """The programs as Markdown, and what was chosen."""
    lines = ["| configuration | env steps | seeds | score | each seed | seconds |", "|---|---|---|---|---|---|"]
    for one in tuning["programs"]:
        steps, seeds = tuning["stages"][one["stage"]]["env_steps"], f"{one['seeds'][0]} to {one['seeds'][-1]}"
        each = " ".join(f"{score:.2f}" for score in one.get("scores", ())) or one["broke"]
        cells = [one["configuration"], f"{steps:,}", seeds, f"{one['score']:.3f}", each, one.get("seconds", "")]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    chosen = tuning["chosen"]
    return "\n".join([*lines, f"chosen: {chosen} {tuning['configurations'][chosen]}"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Tune, and print what was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("task", metavar="TASK")
    parser.add_argument("agent", metavar="AGENT")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--runs", type=Path, default=Path("runs/tune"))
    parser.add_argument(
        "--env-steps",
        type=lambda word: int(float(word)),
        nargs=len(STAGES),
        default=[one.env_steps for one in STAGES],
        help="of each seed, in each stage",
    )
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--signal", choices=(BEHIND, ALL))
    parser.add_argument("--commit", help="what to record where there is no git")
    given = list(sys.argv[1:] if arguments is None else arguments)
    end = given.index("--") if "--" in given else len(given)
    options = parser.parse_args(given[:end])
    options.runs = options.runs.resolve()
    if not (reproduce.ROOT / "configs" / f"{options.task}.yaml").is_file():
        refuse(f"configs/{options.task}.yaml: no such file")
    path = options.out or reproduce.ROOT / "results" / "tuning" / options.task / f"{options.agent}.json"
    keys = given[end + 1 :]
    if len(keys) % 2:
        refuse(f"{keys[-1]}: needs a value")
    shared = {key.removeprefix("--"): yaml.safe_load(value) for key, value in zip(keys[::2], keys[1::2], strict=True)}
    try:
        tuning = opened(path, plan(options, shared))
        if tuning["chosen"] is None:
            tune(tuning, path, options)
    except (UserError, OSError) as error:
        refuse(" ".join(str(error).split()))
    print(table(tuning))


if __name__ == "__main__":
    main()
