"""What is wrong, said to a person in one line."""

from __future__ import annotations

import math
from typing import Any


class UserError(ValueError):
    """What a person can mend. The message is one line: the key or path, the value, what is allowed.

    The command line prints it and ends with exit code 2.
    """


class Notice(UserWarning):
    """What a person should know though nothing is refused. The message is one line; the command line prints it."""


def shown(value: Any, limit: int = 60) -> str:
    """A value that a user gave, as YAML spells it where Python would not, on one line and cut short."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = "nan" if isinstance(value, float) and math.isnan(value) else repr(value)
    except ValueError:  # Python does not write whole numbers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= limit else text[: limit - 3] + "..."
