"""Give `star train` thousands of broken and odd configs, and see that each is trained or refused as promised.

    python scripts/checks/fuzz.py --configs 10000 --out results/soak/fuzz.json

Each of the cases that scripts/checks/odd_configs.py makes goes through `star.cli.main` in a folder of its own, and must
end in one of these ways:

* trained for one epoch, with exit code 0 and nothing new in the folder but the run;
* trained for one epoch and stopped with exit code 3 and one line, because of numbers that are no longer finite;
* refused with exit code 2, one printable line on stderr and nothing new in the folder.

Anything else is a failure: a traceback, other lines, a file left behind, more than `--limit` seconds. The exit code is
then 1. A config that is accepted but has a structure of its own must be compiled, which takes a minute; after
`--structures` of these such configs are built only, and counted apart, as are those too large to train here.
The file of results is written every hundred configs; the same command goes on with it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import faulthandler
import gc
import io
import itertools
import json
import os
import resource
import shlex
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compilation is most of the time, as in tests/conftest.py.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1")
os.environ["WANDB_MODE"] = "disabled"

import hypothesis  # noqa: E402
import jax  # noqa: E402

from envs import EnvError, arena  # noqa: E402
from scripts.checks.odd_configs import BASE, CASES, Case  # noqa: E402
from star import cli
from star.agent.sections import Config  # noqa: E402
from star.config import loading
from star.training import program as programs  # noqa: E402
from star.training import provenance  # noqa: E402

FINE = ("trained", "stopped", "built", "refused", "helped")
CHUNK = 100  # configs of one seed of hypothesis
MOST_WORK = 100_000  # env steps and sampled transitions of an epoch and its evaluation
MOST_HELD = 8  # programs at a time
MEMORY = 12 * 2**30  # bytes of addresses

ONLY_HOST = ("total_env_steps", "eval_every", "checkpoint_every", "keep_checkpoints", "sinks", "device")


class _Late(BaseException):
    """The time is over."""


class _Untrained(BaseException):
    """Accepted, but too large for this script to train, or a structure too many."""


@dataclasses.dataclass
class Trial:
    """The end of a case: one of `FINE`, or else the fault; and its last line."""

    ended: str
    line: str
    seconds: float


class Shared:
    """`star.training.program.build`, with programs shared by configs of one structure, and epochs cut to one."""

    def __init__(self, structures: int) -> None:
        self.left = structures
        self.known: dict[str, programs.Program] = {}
        """The latest used comes last."""
        self._build = programs.build

    def __call__(self, config: Config) -> programs.Program:
        """The program of `config`; raises what building it does."""
        key = self._key(config)
        program = self.known.pop(key, None) if key else None
        if program is not None:
            self.known[str(key)] = program
        else:
            program = self._build(config)
            if key and self.left > 0 and _work(program) <= MOST_WORK:
                self.left -= 1
                self.known[key] = program
                self._forget()
            else:
                program = dataclasses.replace(program, functions=_never(program.functions))
        resolved = program.experiment.resolve(config)
        once = resolved.trainer.model_copy(
            update={"total_env_steps": min(resolved.trainer.total_env_steps, program.steps_per_epoch)}
        )
        return dataclasses.replace(
            program, config=resolved.model_copy(update={"trainer": once}), hyper=resolved.hyper()
        )

    def _forget(self) -> None:
        """Let go of the program that was not used for longest: a process may map so many pieces of code only."""
        if len(self.known) > MOST_HELD:
            del self.known[next(iter(self.known))]
            gc.collect()

    def _key(self, config: Config) -> str | None:
        """None for what depends on files, and is not shared."""
        if any(teacher.source != "map" for teacher in config.sgim.teachers):
            return None
        values = json.loads(programs.structure(config))
        try:
            if "map" in config.env.options:
                values["env"]["options"]["map"] = arena.load(config.env.options["map"])
        except (EnvError, TypeError, AttributeError):
            return None
        values["trainer"] = {k: v for k, v in values["trainer"].items() if k not in ONLY_HOST}
        return json.dumps(values, sort_keys=True)


def _never(functions: programs.Functions) -> programs.Functions:
    """The functions, with an `init` that can be traced but not run."""

    def init(agent: Any, keys: Any) -> Any:
        if isinstance(jax.tree.leaves(keys)[0], jax.core.Tracer):
            return functions.init(agent, keys)
        raise _Untrained

    return dataclasses.replace(functions, init=init)


def _work(program: programs.Program) -> int:
    config, agent = program.config.trainer, program.hyper
    steps = (config.num_envs + config.eval_episodes) * program.experiment.spec.episode_length
    updates = agent.forward_model.updates_per_epoch * agent.forward_model.batch_size
    for _, level, rollout in program.config.learners():
        rollouts = program.experiment.spec.episode_length // agent.tutor.period
        if level.learner == "td3":
            updates += rollouts * level.td3.updates_per_rollout * level.td3.batch_size
        else:
            updates += rollouts * level.ppo.passes * rollout.size
    widest = max(_widths(program.config.model_dump()), default=0)
    return config.num_seeds * (steps + updates) * max(widest // 128, 1)


def _widths(values: Any) -> Iterator[int]:
    """All widths of networks."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from value if key == "hidden" else _widths(value)


@contextlib.contextmanager
def _limited(seconds: int) -> Iterator[None]:
    def late(*_: object) -> None:
        raise _Late

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    faulthandler.dump_traceback_later(2 * seconds, exit=True)  # where no signal is handled
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def run(case: Case, *, limit: int) -> Trial:
    """Train a case in a folder of its own."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name)
        for file, data in case.files.items():
            (folder / file).write_bytes(data)
        os.chdir(folder)
        began = time.monotonic()
        try:
            with _limited(limit):
                ended, line = _judged(case, folder)
        finally:
            os.chdir(here)
        return Trial(ended, line, time.monotonic() - began)


def _judged(case: Case, folder: Path) -> tuple[str, str]:
    out, err = io.StringIO(), io.StringIO()
    place = () if "--run-dir" in case.arguments or "--resume" in case.arguments else ("--run-dir", "run")
    config = () if "--resume" in case.arguments else ("config.yaml",)
    words = ["train", *config, *place, "--quiet", *case.arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = cli.main(words)
    except _Untrained:
        return "built", ""
    except _Late:
        return "hang", ""
    except SystemExit as asked:
        return ("helped", "") if asked.code == 0 and _is_untouched(case, folder) else ("exit", str(asked.code))
    except BaseException:
        return "traceback", traceback.format_exc()
    said = err.getvalue()
    line = said.removesuffix("\n")
    begin = {2: "error: ", 3: "stopped: not finite "}.get(code, "")
    if begin and not (line.startswith(begin) and line.isprintable() and said.endswith("\n")):
        return "not one line", said
    if code == 2:
        return ("refused", line) if _is_untouched(case, folder) else ("file left behind", line)
    if code not in (0, 3):
        return f"exit code {code}", said
    new = [path for path in folder.iterdir() if path.name not in case.files]
    if ("--resume", ".") in itertools.pairwise(case.arguments):
        new = [folder]  # what it holds could be a run that was interrupted before its first checkpoint
    written = [file.read_text().count("\n") for path in new for file in path.rglob("metrics.jsonl")]
    if not (len(new) == 1 and written and written[0]):
        return "no run, or more", str(new)
    return "stopped" if code else "trained", said


def _is_untouched(case: Case, folder: Path) -> bool:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == case.files and all(
        path.is_file() for path in folder.iterdir()
    )


def fuzz(count: int, seed: int, *, limit: int, tell: Callable[[Case, Trial], None]) -> None:
    """Run the cases that hypothesis makes of a seed."""

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(CASES)
    def each(case: Case) -> None:
        tell(case, run(case, limit=limit))

    with warnings.catch_warnings():  # threads of what ran before may draw random numbers while a case is made
        warnings.filterwarnings(
            "ignore", "Do not use the `random` module", hypothesis.errors.HypothesisDeprecationWarning
        )
        each()


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--configs", type=int, default=10_000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--structures", type=int, default=40, help="programs to compile at most")
    parser.add_argument("--limit", type=int, default=600, metavar="S", help="for one config, compilation included")
    parser.add_argument("--out", type=Path, default=Path("results/soak/fuzz.json"), metavar="FILE")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    programs.build = shared = Shared(options.structures + 1)
    shared(loading.parse(BASE))

    found: dict[str, Any] = {"seed": options.seed, "chunks": 0, "configs": 0, "wall_s": 0.0}
    found |= {"ended": {}, "kinds": {}, "slowest_s": {}, "failures": []}
    if options.out.exists():
        found = json.loads(options.out.read_text(encoding="utf-8"))
        if found["seed"] != options.seed:
            parser.error(f"{options.out} is of seed {found['seed']}")

    about = {k: v for k, v in provenance.here().items() if k in ("time", "commit", "device", "versions")}
    about["command"] = shlex.join(["python", "scripts/checks/fuzz.py", *sys.argv[1:]])

    def tell(case: Case, trial: Trial) -> None:
        found["configs"] += 1
        found["ended"][trial.ended] = found["ended"].get(trial.ended, 0) + 1
        of = found["kinds"].setdefault(case.kind, {})
        of[trial.ended] = of.get(trial.ended, 0) + 1
        found["slowest_s"][trial.ended] = round(max(found["slowest_s"].get(trial.ended, 0.0), trial.seconds), 1)
        if trial.ended not in FINE:
            failure = {"ended": trial.ended, "said": trial.line[-3000:], "kind": case.kind, "arguments": case.arguments}
            failure |= {"files": {name: repr(data[:3000]) for name, data in case.files.items()}}
            found["failures"].append(failure)
            print(json.dumps(failure), file=sys.stderr, flush=True)

    while found["configs"] < options.configs:
        began = time.monotonic()
        fuzz(CHUNK, options.seed * 1_000_003 + found["chunks"], limit=options.limit, tell=tell)
        found["chunks"] += 1  # of which hypothesis may have made fewer configs than it could
        found["wall_s"] = round(found["wall_s"] + time.monotonic() - began, 1)
        found["structures"] = max(found.get("structures", 0), options.structures + 1 - shared.left)
        found |= about
        options.out.parent.mkdir(parents=True, exist_ok=True)
        partial = options.out.with_suffix(".partial")
        partial.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        partial.replace(options.out)
        print(f"{found['configs']:,} configs: {found['ended']}", flush=True)
    return 1 if found["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
