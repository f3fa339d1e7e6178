"""Code that users add from a file of their own, named `module:name`.

Configs and run folders may come from strangers, so a module is used only if its user has said so: typed its name on the
command line, or named it in `STAR_IMPORT` (several with commas between); programs call `trust`. An earlier import by
Python says nothing: it has imported `logging`, whose functions write files.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any, TypeVar

from envs.common.errors import UserError, where_raised

TRUSTED = "STAR_IMPORT"  # the environment variable; processes that are started inherit it
NAMED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")

Kind = TypeVar("Kind")


def is_plugin(name: object) -> bool:
    """True if `name` is text of the form `module:name`."""
    return isinstance(name, str) and NAMED.fullmatch(name) is not None


def trust(module: str) -> None:
    """Let the module be imported, here and in processes that are started from here."""
    os.environ[TRUSTED] = ",".join(dict.fromkeys([*trusted(), module]))


def check_trust(name: str) -> None:
    """Raise `UserError` in one line, if the module of `name` (`module:name`) must not be used."""
    module = name.partition(":")[0]
    if module not in trusted():
        raise UserError(
            f"only a file names it, so it is not imported; type --import {module}, or set {TRUSTED}={module}"
        )


def find(name: str, kind: type[Kind]) -> Kind:
    """The value that `name` (`module:name`) stands for; modules may lie in the current folder.

    Raises:
      UserError: in one line, if the module is not trusted, cannot be imported, or holds no such `kind`.
    """
    check_trust(name)
    module, _, attribute = name.partition(":")
    _look_here_too()
    try:
        holder = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever its author has done
        raise UserError(f"cannot be imported: {where_raised(error)}") from None
    found = getattr(holder, attribute, None)
    if found is None or not isinstance(found, kind):
        allowed = "" if kind is object else f"; allowed: a {kind.__module__}.{kind.__qualname__}"
        if found is None:
            near = difflib.get_close_matches(attribute, [one for one in vars(holder) if one[0] != "_"], n=1)
            meant = f" (did you mean {near[0]}?)" if near else ""
            raise UserError(
                f"{module} holds no {attribute}{meant}{allowed} ({getattr(holder, '__file__', 'built in')})"
            )
        raise UserError(f"is a {'class' if isinstance(found, type) else type(found).__name__}{allowed}")
    return found


def find_function(name: str, *, makes: str) -> Callable[..., Any]:
    """The function that `name` (`module:name`) stands for; `makes` says what it makes, as in "an environment".

    Raises:
      UserError: in one line that begins with `name`, as `find` does, or if it is no function.
    """
    try:
        found: Any = find(name, object)
    except UserError as error:
        raise UserError(f"{name}: {error}") from None
    try:
        inspect.signature(found)
    except (TypeError, ValueError):  # no function, or one in C
        raise UserError(f"{name}: is a {type(found).__name__}; allowed: a function that makes {makes}") from None
    return found


class Guarded:
    """A value of a user's own: an error in one of its parts becomes one line, a `UserError` that begins with `name`."""

    def __init__(self, value: Any, name: str) -> None:
        self._value, self._name = value, name

    def __getattr__(self, part: str) -> Any:
        """The same part of the value; a function of it is guarded, too."""
        if part.startswith("__"):
            raise AttributeError(part)
        found = self._called(part, getattr, self._value, part)
        if not callable(found) or isinstance(found, type):
            return found
        return wraps(found)(partial(self._called, part, found))

    def _called(self, part: str, function: Callable[..., Any], *args: Any, **more: Any) -> Any:
        """Call the function, which errors call `part`."""
        try:
            return function(*args, **more)
        except (Exception, SystemExit) as error:  # whatever its author has done
            if isinstance(error, UserError) or (function is getattr and isinstance(error, AttributeError)):
                raise
            raise UserError(f"{self._name}: {part} raises {where_raised(error)}") from error


def takes(function: Callable[..., Any], option: str) -> bool:
    """True if the function may be called with this keyword."""
    parameters = inspect.signature(function).parameters.values()
    return any(p.kind == p.VAR_KEYWORD or (p.name == option and p.kind != p.POSITIONAL_ONLY) for p in parameters)


def check_there(module: str) -> None:
    """Raise `UserError` in one line, if there is no such module; it is not imported."""
    _look_here_too()
    top = module.partition(".")[0]
    try:
        there = top != "__main__" and importlib.util.find_spec(top) is not None
    except ValueError:  # no name
        there = False
    if not there or not NAMED.fullmatch(f"{module}:x") or module.endswith(".py"):
        raise UserError(
            f"--import: {module!r} is no module here; allowed: a name that Python can import, as mine for mine.py"
        )


def _look_here_too() -> None:
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)


def trusted() -> list[str]:
    """The modules that are let in here."""
    return [name for name in os.environ.get(TRUSTED, "").split(",") if name]
