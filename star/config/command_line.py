"""Command lines of `star` that let in the modules which are let in here (`envs.common.plugins`)."""

from __future__ import annotations

import shlex

from envs.common.plugins import trusted


def of(*words: object) -> str:
    """`star` with these words, to be typed in a shell, and with the modules that it lets in here."""
    imports = [word for module in trusted() for word in ("--import", module)]
    return shlex.join(["star", *map(str, words), *imports])
