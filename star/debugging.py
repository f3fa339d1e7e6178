"""The checks of `star train --debug`: no operation makes a NaN, and arrays have their annotated shapes."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import jax
from jaxtyping import AbstractArray, install_import_hook

Function = TypeVar("Function", bound=Callable[..., Any])

_CHECKED = (
    "abstraction",
    "agent",
    "learners",
    "sgim",
)  # packages with annotated arrays; their sections may be imported


def turn_on() -> None:
    """Check shapes, and let JAX raise `FloatingPointError` at the first operation that makes a NaN."""
    check_shapes()
    jax.config.update("jax_debug_nans", True)


def check_shapes() -> None:
    """Check arrays against annotations in the modules that are imported from now on; costs time in tracing only."""
    install_import_hook([f"star.{name}" for name in _CHECKED], "star.debugging.shapes")


def shapes(function: Function) -> Function:
    """A type checker for jaxtyping that looks at JAX arrays alone: `TypeError` for one of another shape or type."""
    signature = inspect.signature(function)
    if function.__name__ == "__init__":  # pytrees are also made of other things, and with more axes
        return function

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            _check(name, value, signature.parameters[name].annotation)
        result = function(*args, **kwargs)
        _check("the result", result, signature.return_annotation)
        return result

    return checked  # type: ignore[return-value]


def _check(name: str, value: Any, hint: Any) -> None:
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    arrays = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, AbstractArray)]
    if arrays and isinstance(value, jax.Array) and not any(isinstance(value, kind) for kind in arrays):
        raise TypeError(f"{name} is {value.shape} of {value.dtype}, not {hint}")
