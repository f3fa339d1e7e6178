"""The parts of settings: frozen, validated groups that are pytrees."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

import jax
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from envs.common.errors import UserError


class ConfigError(UserError):
    """Settings, or files that go with them, that cannot be used."""


_LARGEST = 3.4e38  # of float32, in round numbers
_SMALLEST = 1.2e-38


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys and is a JAX pytree with its floats as leaves."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans_as_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in (int, float):
            raise ValueError("should be a number")
        return value

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
