"""The parts of settings: frozen, validated groups that are pytrees."""

from __future__ import annotations

import types
from collections.abc import Iterable
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import jax
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticKnownError

from envs.common.errors import UserError


class ConfigError(UserError):
    """Settings, or files that go with them, that cannot be used."""


_LARGEST = 3.4e38  # of float32, in round numbers
_SMALLEST = 1.2e-38
_ERRORS: dict[type, Any] = {bool: "bool_type", int: "int_type", float: "float_type", str: "string_type"}  # pydantic's


class Group(BaseModel):
    """A frozen group of values that refuses unknown keys, and values of another type: `"1"` is text, 1 is not true."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_other_types(cls, value: Any, info: ValidationInfo) -> Any:
        _check_type(value, cls.model_fields[str(info.field_name)].annotation)
        return value


class Section(Group):
    """A group of settings that is a JAX pytree with its floats as leaves."""

    @field_validator("*", mode="after")
    @classmethod
    def _refuse_what_float32_cannot_hold(cls, value: Any) -> Any:
        if isinstance(value, float) and abs(value) > _LARGEST:
            raise ValueError(f"should lie between {-_LARGEST:.3g} and {_LARGEST:.3g}")
        if isinstance(value, float) and 0 < abs(value) < _SMALLEST:
            raise ValueError(f"should be 0 or at least {_SMALLEST:.3g}: float32 makes 0 of it")
        return value

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        jax.tree_util.register_pytree_with_keys(cls, _flatten, lambda aux, leaves: _unflatten(cls, aux, leaves))


def setting(default: Any, about: str, *, unit: str | None = None, allowed: str | None = None, **checks: Any) -> Any:
    """A setting of a section: all that is checked of it, and all that `star settings` says of it, in one place.

    Args:
      default: its value where none is given; `...` for none.
      about: one plain sentence.
      unit: that of its numbers; "" where they have none.
      allowed: what text or mappings are allowed, in words, where a check cannot tell.
      checks: as of pydantic's `Field`, such as `gt=0`. Types tell more: `Literal`, `Positive`.
    """
    return Field(default, description=about, json_schema_extra={"unit": unit, "allowed": allowed}, **checks)


def _check_type(value: Any, annotation: Any) -> None:
    """Raise pydantic's error for a number, text or boolean that pydantic would make another of; see YAML 1.2."""
    parts = get_args(annotation)
    if get_origin(annotation) in (Union, types.UnionType) and isinstance(value, list | tuple):
        for one in parts:
            _check_type(value, one)
    if get_origin(annotation) is tuple and isinstance(value, list | tuple):
        for one in value:
            _check_type(one, parts[0])
    elif get_origin(annotation) is tuple and get_origin(parts[0]) is Literal:
        raise ValueError(f"should be a list of {_either(get_args(parts[0]))}")
    allowed = _scalars(annotation)
    if type(value) not in (bool, int, float, str) or not allowed or type(value) in allowed:
        return
    if allowed & {int, float} and (type(value) in (int, float) or not _is_number(value)):
        return  # pydantic says it better
    literal = next((one for one in (annotation, *parts) if get_origin(one) is Literal), None)
    if literal is not None:
        raise PydanticKnownError("literal_error", {"expected": _either(get_args(literal))})
    raise PydanticKnownError(next(error for kind, error in _ERRORS.items() if kind in allowed))


def _either(choices: Iterable[Any]) -> str:
    """The choices as pydantic lists them, `'a', 'b' or 'c'`."""
    *first, last = map(repr, choices)
    return " or ".join(filter(None, [", ".join(first), last]))


def _is_number(value: Any) -> bool:
    """True if Python makes a number of it."""
    try:
        float(value)
    except ValueError:
        return False
    return True


def _scalars(annotation: Any) -> set[type]:
    """The types of numbers, text and booleans that an annotation allows; none if it may be anything else than null."""
    if get_origin(annotation) is Annotated:
        return _scalars(get_args(annotation)[0])
    if get_origin(annotation) is Literal:
        return {type(one) for one in get_args(annotation)}
    if get_origin(annotation) in (Union, types.UnionType):
        found = [_scalars(one) for one in get_args(annotation) if one is not type(None)]
        return set().union(*found) if all(found) else set()
    return {annotation} if annotation in _ERRORS else set()


def _is_leaf_field(cls: type[Section], name: str) -> bool:
    annotation = cls.model_fields[name].annotation
    return annotation is float or (isinstance(annotation, type) and issubclass(annotation, Section))


def _flatten(section: Section) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    cls = type(section)
    leaves = [(jax.tree_util.GetAttrKey(n), getattr(section, n)) for n in cls.model_fields if _is_leaf_field(cls, n)]
    static = tuple((n, getattr(section, n)) for n in cls.model_fields if not _is_leaf_field(cls, n))
    return leaves, static


def _unflatten(cls: type[Section], static: tuple[Any, ...], leaves: Iterable[Any]) -> Section:
    names = [n for n in cls.model_fields if _is_leaf_field(cls, n)]
    return cls.model_construct(**dict(zip(names, leaves, strict=True)), **dict(static))


# Upper bounds are far above what is of use. They keep whole numbers within those of a device, loops and the
# programs that are compiled of them finite, and what is allocated within what `star.training.memory_budget` can add up.
Positive = Annotated[int, Field(gt=0, lt=2**31)]
Batch = Annotated[int, Field(gt=0, le=2**20)]
Repeats = Annotated[int, Field(gt=0, le=100_000)]
Hidden = Annotated[tuple[Annotated[int, Field(gt=0, le=2**14)], ...], Field(max_length=16)]
