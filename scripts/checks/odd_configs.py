"""Broken and odd configs, command lines and files for `star train`, as strategies of hypothesis.

The smallest Point Maze is changed: in its values, its text, its bytes, the files it names or the command line.
"""

from __future__ import annotations

import dataclasses
import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import numpy as np
import yaml
from hypothesis import strategies as st

from star.agent.sections import Config
from star.config import loading

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
CODE = ["subprocess:check_output", "json:loads", "nobody:make"]  # as a stranger may name it
HOSTILE = st.sampled_from(ODD) | st.sampled_from(ODD + CODE) | SCALARS | nested(SCALARS)
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
