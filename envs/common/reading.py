"""Files that may come from strangers: read whole if they are small, as plain data and nothing else."""

from __future__ import annotations

import copy
import errno
import re
import stat
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

MAX_CHARACTERS = 1_000_000  # of a file
MAX_NODES = 20_000  # of a document with all its aliases written out
MAX_DEPTH = 32


def check_regular(path: Path) -> None:
    """Raise `OSError` for what is no regular file: a pipe or a device may never end."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "Not a regular file")


def text(path: Path) -> str:
    """The content of a file of UTF-8 text.

    Raises:
      OSError: if it cannot be read, is no regular file, or is too large.
      UnicodeDecodeError: if it is not UTF-8.
    """
    try:
        check_regular(path)
        with path.open(encoding="utf-8-sig") as file:
            found = file.read(MAX_CHARACTERS + 1)
    except ValueError as error:
        if isinstance(error, UnicodeDecodeError):
            raise
        raise FileNotFoundError(errno.ENOENT, "No file has such a name") from None  # a zero byte, a lone surrogate
    if len(found) > MAX_CHARACTERS:
        raise OSError(errno.EFBIG, f"More than {MAX_CHARACTERS:,} characters")
    return found


def plain(text: str) -> Any:
    """The values of the YAML document `text`: dictionaries, lists, text, numbers and bytes.

    They are those of YAML 1.2: `010` is ten and `1e-4` is a number, `1:30`, `2024-01-02` and `yes` are text.

    Raises:
      yaml.YAMLError: also for a key given twice, and for what is nested too deep or grows too large by its aliases.
    """
    return copy.deepcopy(_parsed(text))


@lru_cache(maxsize=64)
def _parsed(text: str) -> Any:
    """As `plain`; a command reads the file of a run several times."""
    try:
        return yaml.load(text, _Plain)  # noqa: S506 - a SafeLoader
    except yaml.YAMLError:
        raise
    except RecursionError:
        raise _error(f"nested more than {MAX_DEPTH} deep") from None
    except Exception as error:  # PyYAML raises nearly anything for a tag whose text is not of its kind
        raise _error(" ".join(str(error).split()) or "a tag does not fit its text") from None


def problem(error: yaml.YAMLError) -> str:
    """The error in a few words, without its place."""
    return getattr(error, "problem", None) or getattr(error, "reason", None) or "bad input"


class _Plain(yaml.SafeLoader):
    """YAML's safe loader, but bounded, and a key given twice is an error instead of a silent choice of the last."""

    def get_single_node(self) -> yaml.Node | None:
        node = super().get_single_node()
        if node is not None:
            _measure(node, {})
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, str) and key in seen:
                raise _error(f"{key} is given twice", key_node.start_mark)
            seen.add(key if isinstance(key, str) else id(key_node))
        return super().construct_mapping(node, deep)


_INTEGER = ("tag:yaml.org,2002:int", re.compile(r"[-+]?(?:0b[01_]+|0o[0-7_]+|0x[0-9a-fA-F_]+|[0-9][0-9_]*)$"))
_FLOAT = (
    "tag:yaml.org,2002:float",
    re.compile(
        r"[-+]?(?:(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|\.(?:nan|NaN|NAN)$"
    ),
)
_BOOLEAN = ("tag:yaml.org,2002:bool", re.compile(r"true|True|TRUE|false|False|FALSE"))
_OLD = (_INTEGER[0], _FLOAT[0], _BOOLEAN[0], "tag:yaml.org,2002:timestamp")
_Plain.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag not in _OLD]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _tag, _pattern in (_INTEGER, _FLOAT):
    _Plain.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))
_Plain.add_implicit_resolver(_BOOLEAN[0], _BOOLEAN[1], list("tTfF"))


class _Writer(yaml.SafeDumper):
    """Puts quotes around text that any version of YAML would read as something else."""


for _tag, _pattern in (_INTEGER, _FLOAT):
    _Writer.add_implicit_resolver(_tag, _pattern, list("-+.0123456789"))


def written(values: Any) -> str:
    """Dictionaries, lists, text and numbers as a YAML document, which `plain` reads."""
    return yaml.dump(values, Dumper=_Writer, sort_keys=False)


def _measure(node: yaml.Node, known: dict[int, tuple[int, int] | None]) -> tuple[int, int]:
    """(nodes, depth) of `node` with its aliases written out; `known` are those of other nodes, None of those above."""
    if id(node) in known:
        measured = known[id(node)]
        if measured is None:
            raise _error("an alias lies inside of what it stands for", node.start_mark)
        return measured
    known[id(node)] = None
    count, depth = 1, 0
    for part in node.value if isinstance(node, yaml.CollectionNode) else ():
        for child in part if isinstance(part, tuple) else (part,):
            nodes, below = _measure(child, known)
            count, depth = count + nodes, max(depth, below + 1)
    if depth > MAX_DEPTH:
        raise _error(f"nested more than {MAX_DEPTH} deep", node.start_mark)
    if count > MAX_NODES:
        raise _error(f"more than {MAX_NODES:,} values, aliases written out", node.start_mark)
    known[id(node)] = count, depth
    return count, depth


def _whole(loader: _Plain, node: yaml.ScalarNode) -> int:
    digits = str(loader.construct_scalar(node)).replace("_", "")
    return int(digits) if digits.lstrip("+-").isdecimal() else int(digits, 0)


_Plain.add_constructor(_INTEGER[0], _whole)


def _error(problem: str, mark: Any = None) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)
