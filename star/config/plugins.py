"""What users add from a file of their own, named `module:name`.

Configs and run folders may come from strangers, so a module is imported only if its user has said so: typed its name on
the command line, named it in `STAR_IMPORT` (several with commas between), or imported it before.
"""

from __future__ import annotations

import importlib
import os
import re
import shlex
import sys
from pathlib import Path
from typing import TypeVar

from star.config.section import ConfigError

TRUSTED = "STAR_IMPORT"  # the environment variable; processes that are started inherit it
NAMED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")

Kind = TypeVar("Kind")


def is_plugin(name: object) -> bool:
    """Whether `name` is text of the form `module:name`."""
    return isinstance(name, str) and NAMED.fullmatch(name) is not None


def trust(module: str) -> None:
    """Let the module be imported, here and in processes that are started from here."""
    os.environ[TRUSTED] = ",".join(dict.fromkeys([*_trusted(), module]))


def command(*words: object) -> str:
    """`star` with these words, to be typed in a shell, and with the modules that it lets in here."""
    imports = [word for module in _trusted() for word in ("--import", module)]
    return shlex.join(["star", *map(str, words), *imports])


def check_trust(name: str) -> None:
    """Raise `UserError` in one line, if the module of `name` (`module:name`) must not be imported."""
    module = name.partition(":")[0]
    if module not in sys.modules and module not in _trusted():
        raise ConfigError(
            f"only a file names it, so it is not imported; type --import {module}, or set {TRUSTED}={module}"
        )


def find(name: str, kind: type[Kind]) -> Kind:
    """The value that `name` (`module:name`) stands for; modules may lie in the current folder.

    Raises:
      UserError: in one line, if the module is not trusted, cannot be imported, or holds no such `kind`.
    """
    check_trust(name)
    module, _, attribute = name.partition(":")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.append(here)
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except Exception as error:  # whatever its author has done
        raise ConfigError(f"cannot be imported: {type(error).__name__}: {' '.join(str(error).split())}") from None
    if found is None or not isinstance(found, kind):
        allowed = "" if kind is object else f"; allowed: a {kind.__module__}.{kind.__qualname__}"
        if found is None:
            raise ConfigError(f"{module} holds no {attribute}{allowed}")
        raise ConfigError(f"is a {'class' if isinstance(found, type) else type(found).__name__}{allowed}")
    return found


def _trusted() -> list[str]:
    return [name for name in os.environ.get(TRUSTED, "").split(",") if name]
