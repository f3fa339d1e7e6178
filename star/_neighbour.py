"""The package `envs` comes with this one, under a name that a folder beside a user's script may have, too."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

_COMMANDS = ("-m", "star")  # how Python calls itself while it looks for `python -m star`, and the command's own script


def check() -> None:
    """Raise `ImportError` in one line if another `envs` is imported instead; a command prints it and ends with 2."""
    spec = find_spec("envs")
    if spec is None or spec.origin is None:
        return
    found, ours = Path(spec.origin), Path(__file__).resolve().parents[1] / "envs"
    if found.resolve().parent == ours:
        return
    place = found.parent if found.name == "__init__.py" else found
    line = f"{found}: is imported as envs, in the place of {ours}; rename {place}, or work in another folder"
    if Path(sys.argv[0]).name in _COMMANDS:
        print(f"error: {line}", file=sys.stderr)
        raise SystemExit(2)
    raise ImportError(line)
