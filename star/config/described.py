"""The description of a setting: type, range or choices, unit, default and one sentence.

All of it is read from the field itself, so that the range which is shown is the one that is checked.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from star.config.section import Section

EACH = "[]"  # after the key of a list of sections: one of them


@dataclass(frozen=True)
class Setting:
    """One setting of a section, by its dotted key."""

    key: str
    field: FieldInfo

    @property
    def default(self) -> Any:
        """Its default; that of a section of a user's own is empty."""
        return {} if isinstance(self.field.default, Section) else self.field.default

    @property
    def about(self) -> str:
        """The sentence."""
        return self.field.description or ""

    @property
    def unit(self) -> str | None:
        """Of its numbers: "" where they have none, None where nothing is said of it."""
        return self._extra("unit")

    @property
    def choices(self) -> list[str]:
        """All that it may be, in words, if they can be told."""
        return _choices(self.field.annotation)

    @property
    def allowed(self) -> str:
        """Its type, with the range or the choices, in words."""
        words = _words(self.field.annotation, self.field.metadata)
        more = self._extra("allowed")
        return f"{words}: {more}" if more else words

    @property
    def line(self) -> str:
        """All of it but the key."""
        default = "none" if self.field.is_required() else json.dumps(self.default)
        facts = "; ".join(filter(None, (self.allowed, self.unit, f"default {default}")))
        return f"{self.about} [{facts}]"

    def _extra(self, name: str) -> Any:
        extra = self.field.json_schema_extra
        return extra.get(name) if isinstance(extra, dict) else None


def settings(section: type[Section], prefix: str = "") -> Iterator[Setting]:
    """All settings of a section and of those in it; lists of sections are followed by the keys of one of them."""
    for name, field in section.model_fields.items():
        inner: Any = field.annotation
        items = get_args(inner)
        if _is_section(inner):
            yield from settings(inner, f"{prefix}{name}.")
            continue
        yield Setting(f"{prefix}{name}", field)
        if items and _is_section(items[0]):
            yield from settings(items[0], f"{prefix}{name}{EACH}.")


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Section) and bool(annotation.model_fields)


def _words(annotation: Any, checks: Sequence[Any]) -> str:
    """A type with its checks, as pydantic keeps them, in words."""
    origin, items = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        own = [one for check in items[1:] for one in (check.metadata if isinstance(check, FieldInfo) else [check])]
        return _words(items[0], [*checks, *own])
    if origin in (Union, UnionType):
        inner = [_words(item, checks) for item in items if item is not NoneType]
        return ", ".join(inner) + ", or null" * (NoneType in items)
    if origin is Literal:
        return f"one of {', '.join(_choices(annotation))}"
    if origin is tuple:
        return f"list{_length(checks)}, each {_words(items[0], [])}"
    if annotation is bool:
        return " or ".join(_choices(annotation))
    if annotation is int:
        return f"whole number{_whole_range(checks)}"
    if annotation is float:
        return f"number{_range(checks)}"
    if annotation is str:
        pattern = _bound(checks, "pattern")
        return "text" if pattern is None else f"text like {pattern}"
    return "mapping"


def _choices(annotation: Any) -> list[str]:
    """Those of a `Literal` and of a bool, as YAML spells them."""
    items = (True, False) if annotation is bool else get_args(annotation) if get_origin(annotation) is Literal else ()
    return [item if isinstance(item, str) else json.dumps(item) for item in items]


def _bound(checks: Sequence[Any], name: str) -> Any:
    return next((found for check in checks if (found := getattr(check, name, None)) is not None), None)


def _range(checks: Sequence[Any]) -> str:
    """` from 0, below 1`, or nothing."""
    low, above, high, below = (_bound(checks, name) for name in ("ge", "gt", "le", "lt"))
    if low is not None and high is not None:
        return f" from {low:g} to {high:g}"
    words = {"above": above, "from": low, "at most": high, "below": below}
    parts = [f"{word} {bound:g}" for word, bound in words.items() if bound is not None]
    return f" {', '.join(parts)}" if parts else ""


def _whole_range(checks: Sequence[Any]) -> str:
    """` from 1 to 12`, both included, or nothing."""
    ge, gt, le, lt = (_bound(checks, name) for name in ("ge", "gt", "le", "lt"))
    low = ge if gt is None else gt + 1
    high = le if lt is None else lt - 1
    parts = [f"{word} {_count(bound)}" for word, bound in (("from", low), ("to", high)) if bound is not None]
    return f" {' '.join(parts)}" if parts else ""


def _count(number: int) -> str:
    power = math.log2(number + 1) if number > 2**20 else 0.5
    return f"2^{power:g} - 1" if power.is_integer() else f"{number:,}"


def _length(checks: Sequence[Any]) -> str:
    least, most = (_bound(checks, name) for name in ("min_length", "max_length"))
    parts = [f"{word} {bound}" for word, bound in (("at least", least), ("at most", most)) if bound]
    return f" of {' and '.join(parts)}" if parts else ""
