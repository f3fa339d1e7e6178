"""Give `star train` thousands of broken and odd configs, and see that each is trained or refused as promised.

    python scripts/checks/fuzz.py --configs 10000 --out results/soak/fuzz.json

A config is the smallest Point Maze, changed by hypothesis: in its values, its text, its bytes, the files it names or
the command line. It goes through `star.cli.main` in a folder of its own and must end in one of these ways:

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
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compilation is most of the time, as in tests/conftest.py.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1",
)
os.environ["WANDB_MODE"] = "disabled"

import hypothesis  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402
import yaml  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from envs import EnvError, arena  # noqa: E402
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

BASE: dict[str, Any] = yaml.safe_load(Path(__file__).with_name("smallest.yaml").read_text(encoding="utf-8"))
TEXT = yaml.safe_dump(BASE, sort_keys=False)
MAP = "11111\n1r001\n11101\n10001\n11111\n"
OPTIONS = (
    "goals", "start", "episode_length", "observe", "reward", "success_radius", "cell", "action_scale",
    "position_noise", "map",
)  # fmt: skip
KEYS = [key for key, _, _ in loading.fields(Config)] + [f"env.options.{name}" for name in OPTIONS]
SECTIONS = sorted({key.rsplit(".", n)[0] for key in KEYS for n in (1, 2)})
FLOATS = [key for key, default, _ in loading.fields(Config) if isinstance(default, float)]
ONLY_HOST = ("total_env_steps", "eval_every", "checkpoint_every", "keep_checkpoints", "sinks", "device")

ODD: list[Any] = [
    None, True, False, "", " ", "nan", "null", "~", "1e400", "1e-3", "0x10", "1:30", "on", "map", "auto", "{}", "[",
    0, -1, 1, 2, 3, 7, 64, 1024, -(2**31), 2**31 - 1, 2**31, 2**53 + 1, 2**63 - 1, 2**63, 10**12, 10**30, -(10**30),
    10**400, 0.0, -0.0, 0.5, 1.5, -1.5, 5e-324, 1e-300, 1e38, 1e39, 1e308, -1e308, float("inf"), float("-inf"),
    float("nan"), [], {}, [[]], [None], [0], [-1], [1e308], [2**63], [True], [1] * 1000, [10**9], [[1.0], [2.0]],
    [[], []], [[1e308], []], [[float("nan")], []], [[4.0] * 9, []], {"": 1}, {"period": 5}, {"a": {"b": {"c": 1}}},
    "\N{LIZARD}", "a\u0301", "\u202etxt", "\x00", "\x1b[31mred", "two\nlines", "[red]x[/]", "<script>", "$x$", "%s",
    "../../etc/passwd", "/dev/zero", "/dev/stdin", "/", ".", "a" * 10_000, "\ud800", b"bytes", b"\xff\xfe",
]  # fmt: skip

TRICKS = [
    "a: &a [x, x]\nb: &b [*a, *a]\ntutor: *b\n",
    "a: &a {x: 1}\nenv: {options: {<<: [*a, *a]}}\n",
    "commander: &c {period: 20}\ntutor: *c\n",
    "env: &e {options: *e}\n",
    "&a [*a]\n",
    "tutor: {<<: 5}\n",
    "tutor: {<<: {period: 10}, <<: {period: 5}}\n",
    "\n".join(["l0: &l0 [x]"] + [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 12)]),
    "\n".join(["l0: &l0 {x: 1}"] + [f"l{i}: &l{i} {{<<: [{', '.join([f'*l{i - 1}'] * 9)}]}}" for i in range(1, 12)]),
    "env: {options: " + "[" * 200 + "]" * 200 + "}\n",
    "env: {options: " + "{a: " * 2000 + "}" * 2000 + "}\n",
    "env:\n" + "".join(" " * i + "a:\n" for i in range(1, 500)),
    "- " * 5000,
    "trainer: {seed: " + "9" * 5000 + "}\n",
    "trainer: {seed: 0x" + "f" * 5000 + "}\n",
    "trainer: {seed: 0b" + "1" * 500 + "}\n",
    "trainer: {seed: 1_0}\n",
    "trainer: {seed: 2020-13-45}\n",
    "trainer: {seed: 2020-01-01}\n",
    "trainer: {seed: 190:20:30}\n",
    *[f"trainer: {{seed: !!{tag} {value}}}\n" for tag in ("int", "float", "bool", "timestamp", "binary", "null", "set",
      "omap", "pairs", "str", "seq", "map", "python/name:os.system", "python/object/apply:os.system") for value in
      ("''", "x", "'é'", "[a]", "{a: 1}", "[{a: 1}, {a: 1}]")],
    "trainer: {seed: =}\n",
    "trainer: {? [a, b] : 1}\n",
    "trainer: {? {a: b} : 1}\n",
    "trainer: {1: 2, 1: 3}\n",
    "trainer: {null: 2}\n",
    "? a\n? a\n",
    "trainer: {seed: |\n  1\n}\n",
    "---\ntrainer: {}\n---\ntrainer: {}\n",
    "%YAML 9.9\n---\ntrainer: {}\n",
    "%TAG ! tag:x,2000:\n---\ntrainer: !x {}\n",
    "trainer: {seed: \"\\x1b[31m\"}\n",
    "\"\\x1b[31m\": 1\n",
    "\"two\\nlines\": 1\n",
    "\"\\ud800\": 1\n",
    "\"\\u202e\": 1\n",
    "env: {name: \"point_maze\\0\"}\n",
    "env: {options: {map: \"\\0\"}}\n",
    "env: {options: {map: \"a\\ud800\"}}\n",
    "sgim: {teachers: [{name: a, kind: action, source: \"a\\0\"}]}\n",
    "sgim: {teachers: [{name: a, kind: action, source: \"/dev/zero\"}]}\n",
    "sgim: {teachers: [{name: a, kind: outcome, source: \"" + "x/" * 3000 + "\"}]}\n",
    "sgim: {teachers: [{nam: a}]}\n",
    "sgim: {teachers: {name: a}}\n",
    "tutor: {ppo: {hidden: {a: 1}}}\n",
    "\tcommander: {}\n",
    "commander:\n\tperiod: 5\n",
    "commander: {period: 5\n",
    "commander: {period: 5}}\n",
    "@x\n",
    "`x`\n",
    "'\n",
    "!<> x\n",
    "# only a comment",
    "\ufeffcommander: {}\n",
    "..." , "---", "null", "[]", "{}", "''", "5", "true",
]  # fmt: skip


MARKS = ["\t", "\x00", ": ", "- ", "{", "]", "&a ", "*a", "!!", "|"]
COMMANDS: list[list[str | None]] = [  # None: an odd value
    ["--seed", None], ["--seeds", None], ["--total-env-steps", None], ["--profile", None], ["--profile"],
    ["--with", None], ["--with", "config.yaml"], ["--with", "other.yaml"], ["--resume", None], ["--resume", "."],
    [None], ["--", None], ["--quiet", "--quiet"], ["--run-dir", None], ["--run-dir", "config.yaml"],
    ["--run-dir", "config.yaml/run"], ["--run-dir", "a/b/run"], ["--run-dir"], ["--run-dir", "x" * 300],
    ["--run-dir", "."], ["--help"], ["--", "--run-dir", "run"],
]  # fmt: skip
NPY = "{{'descr': '<f4', 'fortran_order': False, 'shape': ({},), }}"
SHAPES = ["3", "10**15", "100000000000000", "-1", "3, 10000000000", "0"]
FRAMED_MAP = "cell: 4\nmap: |\n" + "".join(f"  {row}\n" for row in MAP.split())
MAPS = ["maze.txt", "no.txt", ".", "/dev/zero", "/dev/null", "x" * 300, "demos.npz"]
SOURCES = ["map", "demos.npz", "maze.txt", "no.npz", ".", "/dev/zero", "x" * 300, ""]


@dataclasses.dataclass(frozen=True)
class Case:
    """A command line, and the files in its folder."""

    kind: str
    arguments: tuple[str, ...]
    files: dict[str, bytes]


def nested(values: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.recursive(
        values, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    )


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
HOSTILE = st.sampled_from(ODD) | st.sampled_from(ODD) | SCALARS | nested(SCALARS)
WORDS = st.text(max_size=12) | st.sampled_from(
    ["x", "trainer", "perod", "", "\N{LIZARD}", "\x1b[31m", "a\nb", "env.name", "x" * 3000, "__class__", "model_config"]
)


def plausible(key: str) -> st.SearchStrategy[Any]:
    """Values of the type of a setting, most of which it allows."""
    of = loading.type_of(key, Config)
    if of is float:
        return st.floats(0.01, 0.99) | st.floats(1e-6, 1e6) | st.sampled_from([0.0, 1.0, 1e-30, 1e30, 1e300])
    if of is bool:
        return st.booleans()
    if get_origin(of) is Literal:
        return st.sampled_from(get_args(of))
    return st.integers(-1, 40)


def changed(values: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    first, *rest = key.split(".", 1)
    below = values.get(first)
    new = changed(below if isinstance(below, dict) else {}, rest[0], value) if rest else value
    return values | {first: new}


def written(values: Any) -> bytes:
    """As YAML, unless it holds what YAML cannot."""
    try:
        return yaml.safe_dump(values, allow_unicode=True, sort_keys=False).encode("utf-8", "surrogatepass")
    except (yaml.YAMLError, ValueError):  # such as a whole number of thousands of digits
        return repr(values).encode("utf-8", "surrogatepass")


@st.composite
def of_values(draw: Callable, hostile: bool) -> Case:
    values = BASE
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from(KEYS if hostile else KEYS + 3 * FLOATS))
        values = changed(values, key, draw(HOSTILE if hostile else plausible(key)))
    return Case("hostile values" if hostile else "plausible values", (), {"config.yaml": written(values)})


@st.composite
def of_floats(draw: Callable) -> Case:
    values = BASE
    for _ in range(draw(st.integers(1, 6))):
        key = draw(st.sampled_from(FLOATS))
        values = changed(values, key, draw(plausible(key)))
    return Case("floats in range", (), {"config.yaml": written(values)})


@st.composite
def of_keys(draw: Callable) -> Case:
    """Sections that are something else, keys that there are not, keys given twice."""
    section, word, value = draw(st.sampled_from(SECTIONS)), draw(WORDS), draw(HOSTILE)
    lines = TEXT.splitlines(keepends=True)
    text = draw(st.sampled_from(["replaced", "unknown", "line twice", "section twice", "key dropped"]))
    if text == "replaced":
        return Case("keys", (), {"config.yaml": written(changed(BASE, section, value))})
    if text == "unknown":
        return Case("keys", (), {"config.yaml": written(changed(BASE, f"{section}.{word}", value))})
    at = draw(st.integers(0, len(lines) - 1))
    if text == "line twice":
        lines.insert(draw(st.integers(0, len(lines))), lines[at])
    elif text == "section twice":
        lines += [line for line in lines if line.startswith(("tutor", " "))][: draw(st.integers(1, 9))]
    else:
        del lines[at]
    return Case("keys", (), {"config.yaml": "".join(lines).encode()})


@st.composite
def of_text(draw: Callable) -> Case:
    text = draw(st.sampled_from([TEXT, TEXT, "", MAP])) + draw(st.sampled_from(["", "\n"] + TRICKS + TRICKS))
    for _ in range(draw(st.integers(0, 3))):
        begin, end = sorted(draw(st.tuples(*[st.integers(0, len(text))] * 2)))
        end = min(end, begin + draw(st.integers(0, 30)))
        inserted = draw(st.text(max_size=5) | st.sampled_from(MARKS))
        text = text[:begin] + inserted + text[end:]
    return Case("text", (), {"config.yaml": text.encode("utf-8", "surrogatepass")})


@st.composite
def of_bytes(draw: Callable) -> Case:
    encoding = draw(st.sampled_from(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "latin-1", "utf-7", "cp037"]))
    data = (TEXT + draw(st.sampled_from(["", "# \xe9\n"]))).encode(encoding)
    junk, at = draw(st.binary(max_size=20)), draw(st.integers(0, len(data)))
    mixed = [data, junk, data[:at], data[:at] + junk + data[at:], data * 200, b"\0" * 50, b"#" * 2_000_000]
    return Case("bytes", (), {"config.yaml": draw(st.sampled_from(mixed))})


def argument(value: Any) -> str:
    """A value as a word of the command line, which holds no zero byte."""
    word = value if isinstance(value, str) else written(value).decode("utf-8", "replace").removesuffix("...\n").strip()
    return word.replace("\0", "")


@st.composite
def of_overrides(draw: Callable) -> Case:
    words: list[str] = []
    for _ in range(draw(st.integers(1, 3))):
        key = draw(st.sampled_from(KEYS + SECTIONS) | WORDS.map(lambda word: f"trainer.{argument(word)}"))
        value = argument(draw(HOSTILE | plausible(key)))
        words += draw(st.sampled_from([[f"--{key}", value], [f"--{key}={value}"], [f"--{key}"], [f"-{key}", value]]))
    return Case("overrides", tuple(words), {"config.yaml": TEXT.encode()})


@st.composite
def of_arguments(draw: Callable) -> Case:
    command, odd = draw(st.sampled_from(COMMANDS)), argument(draw(HOSTILE))
    if "--run-dir" in command:  # nothing may be written elsewhere
        odd = odd.replace("/", "_")
    words = [odd if word is None else word for word in command]
    other = draw(st.sampled_from(TRICKS)).encode("utf-8", "surrogatepass")
    return Case("arguments", tuple(words), {"config.yaml": TEXT.encode(), "other.yaml": other})


@st.composite
def of_files(draw: Callable) -> Case:
    """Maps and demonstrations that a config names."""
    at, word = draw(st.integers(0, len(MAP))), draw(st.text("01rgBD#x \n:\t\N{LIZARD}", max_size=4))
    text = MAP[:at] + word + MAP[at + draw(st.integers(0, 3)) :]
    text = draw(st.sampled_from([text, text * 30, f"map: |\n  {text}", FRAMED_MAP, *TRICKS]))
    kind = draw(st.sampled_from(["action", "outcome", "decomposition"]))
    teacher = {"name": "a", "kind": kind, "source": draw(st.sampled_from(SOURCES))}
    named = draw(
        st.sampled_from([("env.options.map", draw(st.sampled_from([text, *MAPS]))), ("sgim.teachers", [teacher])])
    )
    files = {"maze.txt": text.encode("utf-8", "surrogatepass"), "demos.npz": draw(archives())}
    return Case("files", (), {"config.yaml": written(changed(BASE, *named)), **files})


@st.composite
def archives(draw: Callable) -> bytes:
    """Broken and odd .npz files."""
    header = NPY.format(draw(st.sampled_from(SHAPES))).encode()
    claimed = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 12
    pickled = io.BytesIO()
    np.save(pickled, np.array([{}], object), allow_pickle=True)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for name in draw(st.lists(st.sampled_from(["starts", "env", "format", "x", "../up"]), max_size=4, unique=True)):
            file.writestr(f"{name}.npy", draw(st.sampled_from([claimed, pickled.getvalue(), b"", b"\0" * 100_000])))
    whole = archive.getvalue()
    return draw(st.sampled_from([whole, whole[: len(whole) // 2], claimed, pickled.getvalue(), b"", b"PK\x03\x04"]))


CASES = st.one_of(
    of_values(hostile=True), of_values(hostile=True), of_values(hostile=False), of_floats(), of_keys(), of_text(),
    of_bytes(), of_overrides(), of_arguments(), of_files(),
)  # fmt: skip


class _Late(BaseException):
    """The time is over."""


class _Untrained(BaseException):
    """Accepted, but too large for this script to train, or a structure too many."""


@dataclasses.dataclass
class Trial:
    """What became of a case: one of `FINE`, or else what is wrong; and what was said."""

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
    for _, level, decisions in program.config.learners():
        rollouts = program.experiment.spec.episode_length // agent.tutor.period
        if level.learner == "td3":
            updates += rollouts * level.td3.updates_per_rollout * level.td3.batch_size
        else:
            updates += rollouts * level.ppo.passes * decisions * config.num_envs
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
