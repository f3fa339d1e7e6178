"""Values as people pass them, in the types that YAML has."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """`value` with Python's numbers for those of NumPy and JAX, text for paths, lists for arrays and tuples.

    All else stays as it is.
    """
    if hasattr(value, "__array__"):
        return np.asarray(value).tolist()
    if isinstance(value, PurePath):
        return str(value)
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value
